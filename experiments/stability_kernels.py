"""The kernels that `experiments.stability` sweeps: as functions of arrays, as float64 twins, and their inputs.

A `*_twin` is the kernel's value once more in NumPy, written independently.  Inputs stay away from kinks (cell walls,
equal pixels): there a gradient jumps, and no precision helps.  What runs in bfloat16 does so in the float32 run only.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from skimage.metrics import structural_similarity

from spnr_jax.kernels import cameras, compositing, losses, metrics, sampling, voxels
from spnr_jax.kernels.records import Camera
from spnr_jax.model_config import SamplingConfig

Rng = np.random.Generator
RAYS = 64


def unit(x):
    """Vectors of length 1."""
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def view_rays(cam_to_world, intrinsics):
    """Directions of a 16 x 16 image."""
    return cameras.camera_rays(Camera(cam_to_world=cam_to_world, intrinsics=intrinsics, height=16, width=16)).directions


def view_rays_twin(cam_to_world, intrinsics):
    """Pinhole."""
    at = np.arange(16) + 0.5 - 8
    x, y = np.meshgrid(at / intrinsics[0, 0], -at / intrinsics[1, 1])
    return (unit(np.stack([x, y, -np.ones_like(x)], -1) @ cam_to_world[:, :3].T),)


def view(rng: Rng, value: float):
    """A turned camera of that field of view in radians."""
    focal = 8 / np.tan(value / 2)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return np.concatenate([turn, np.ones((3, 1))], 1), np.array([[focal, 0, 8], [0, focal, 8], [0, 0, 1.0]])


def box(origins, directions):
    """Entry, length inside and hit."""
    near, far, hit = cameras.intersect_box(origins, directions)
    return near, far - near, hit.astype(origins.dtype)


def box_twin(origins, directions):
    """The slab method."""
    a, b = (-1 - origins) / directions, (1 - origins) / directions
    near, far = np.maximum(np.minimum(a, b).max(-1), 0), np.maximum(a, b).min(-1)
    hit = far > near
    return np.where(hit, near, 0), np.where(hit, far - near, 0), hit


def box_at_distance(rng: Rng, value: float):
    """Rays from a sphere around the box towards its inner half."""
    origins = unit(rng.normal(size=(RAYS, 3))) * value
    return origins, unit(rng.uniform(-0.5, 0.5, (RAYS, 3)) - origins)


def box_with_thin_component(rng: Rng, value: float):
    """Rays into the box with an x component of the given size."""
    thin = value * rng.choice([-1, 1], RAYS) * rng.uniform(0.5, 1, RAYS)
    directions = np.stack([thin, rng.uniform(-0.2, 0.2, RAYS), -np.ones(RAYS)], -1)
    return np.stack([*rng.uniform(-0.4, 0.4, (2, RAYS)), np.full(RAYS, 3.0)], -1), unit(directions)


def stratified(near, far, num_samples=64):
    """Middles and edges."""
    return sampling.stratified(None, near, far, num_samples)


def stratified_twin(near, far, num_samples=64):
    """The same by one formula."""
    near, span = near[:, None], (far - near)[:, None]
    return near + span * (np.arange(num_samples) + 0.5) / num_samples, near + span * np.arange(
        num_samples + 1
    ) / num_samples


def near_and_far(rng: Rng, size: float = 1.0):
    """Intervals between half and two sizes."""
    return size * rng.uniform(0.5, 1, RAYS), size * rng.uniform(1.5, 2, RAYS)


def importance(edges, weights):
    """Samples at the middles of 128 strata."""
    return sampling.importance(None, edges, weights, 128)


def share_below(arguments, outputs):
    """Share of the padded mass below each sample: what a sample is meant to hit, so its error is in probability."""
    edges, weights = (np.float64(x) for x in arguments)
    mass = weights + SamplingConfig().padding
    cdf = np.cumsum(mass / mass.sum(-1, keepdims=True), -1)
    rows = (np.interp(x, e, [0, *c]) for x, e, c in zip(np.float64(outputs[0]), edges, cdf, strict=True))
    return [np.stack(list(rows))]


def step_function(rng: Rng, n: int, size: float = 1.0):
    """Edges of n bins of about equal width along four rays, and weights of a size."""
    widths = rng.uniform(0.5, 1.5, (4, n))
    edges = 2 + 3 * np.concatenate([np.zeros((4, 1)), np.cumsum(widths, -1) / widths.sum(-1, keepdims=True)], -1)
    return edges, size * rng.uniform(0, 1, (4, n))


def one_hit(rng: Rng, value: float):
    """All weight in one of 62 bins."""
    return step_function(rng, 62)[0], value * np.eye(62)[rng.integers(0, 62, 4)]


def weights_twin(density, delta):
    """Beer and Lambert."""
    tau = density * delta
    through = np.cumsum(tau, -1)
    return np.exp(-(through - tau)) * -np.expm1(-tau), np.exp(-through[:, -1])


def weights_bf16(density, delta):
    """Compositing weights if they were computed in bfloat16."""
    low = jnp.bfloat16 if density.dtype == jnp.float32 else density.dtype
    return tuple(x.astype(density.dtype) for x in compositing.volume_weights(density.astype(low), delta.astype(low)))


def layers(rng: Rng, n: int, depth: float = 3.0):
    """Densities of about that optical depth in all."""
    return depth * rng.uniform(0.01, 2, (RAYS, n)), rng.uniform(0.5, 1.5, (RAYS, n)) / n


def shares(rng: Rng, n: int):
    """Weights that add up to 0.9."""
    weights = rng.uniform(0.1, 1, (RAYS, n))
    return 0.9 * weights / weights.sum(-1, keepdims=True)


def composite(weights, values):
    """On white."""
    return compositing.composite(weights, values, 1.0)


def composite_twin(weights, values):
    """Sum and rest."""
    return ((weights[..., None] * values).sum(-2) + 1 - weights.sum(-1)[:, None],)


def colours(rng: Rng, n: int, size: float = 1.0):
    """Weights and colours up to a size."""
    return shares(rng, n), size * rng.uniform(0, 1, (RAYS, n, 3))


def depth_twin(weights, distances, far):
    """Sum and rest."""
    return ((weights * distances).sum(-1) + (1 - weights.sum(-1)) * far,)


def along(rng: Rng, n: int, size: float = 1.0):
    """Weights and distances between 2 and 3 sizes."""
    return shares(rng, n), size * np.sort(rng.uniform(2, 3, (RAYS, n))), np.full(RAYS, 3.0 * size)


def cells(rng: Rng, n: int, resolution: int):
    """Positions well inside voxels, away from their walls and centres' planes."""
    cell = rng.integers(0, resolution, (n, 3)) + rng.choice([0.25, 0.75], (n, 3)) + rng.uniform(-0.2, 0.2, (n, 3))
    return cell * 2 / resolution - 1


def points(rng: Rng, n: int, resolution: int, size: float = 1.0):
    """Features up to a size, positions, and a volume of zeros that says the resolution."""
    return size * rng.uniform(0, 1, (n, 1)), cells(rng, n, resolution), np.zeros((resolution,) * 3)


def scatter(features, positions, like):
    """Mean and occupancy."""
    mask = jnp.ones(positions.shape[:-1], bool)
    return voxels.scatter_mean(jax.lax.stop_gradient(positions), features, mask, len(like))


def scatter_twin(features, positions, like):
    """np.add.at."""
    cell = tuple(np.floor((positions + 1) * len(like) / 2).astype(int).T[::-1])
    total, count = np.zeros((*like.shape, features.shape[-1])), like.copy()
    np.add.at(total, cell, features)
    np.add.at(count, cell, 1)
    return total / np.maximum(count, 1)[..., None], np.minimum(count, 1)


def trilinear_twin(volume, positions):
    """Blend axis by axis."""
    n = len(volume)
    grid = np.clip((positions + 1) * n / 2 - 0.5, 0, n - 1)
    low = np.minimum(np.floor(grid), n - 2).astype(int)
    t, (x, y, z) = grid - low, low.T
    a, b, c = (t[:, i, None] for i in range(3))
    planes = [[volume[z + k, y + j, x] * (1 - a) + volume[z + k, y + j, x + 1] * a for j in (0, 1)] for k in (0, 1)]
    rows = [p[0] * (1 - b) + p[1] * b for p in planes]
    return (rows[0] * (1 - c) + rows[1] * c,)


def lookup(rng: Rng, resolution: int, size: float = 1.0):
    """A random volume and places in it."""
    return size * rng.normal(size=(*[resolution] * 3, 2)), cells(rng, 500, resolution)


def l1_twin(image, reference):
    """Mean absolute difference."""
    return (np.mean(np.abs(image - reference)),)


def apart(rng: Rng, value: float):
    """Two images of that size, nowhere equal."""
    image = rng.normal(size=(64, 64, 3))
    return value * image, value * (image + rng.uniform(0.1, 1, image.shape))


def adversarial(real, fake):
    """Losses of the generator and of the discriminator."""
    return losses.generator_adversarial(fake), losses.discriminator_adversarial(real, fake)


def adversarial_twin(real, fake):
    """Mean softplus."""
    of_fake, of_real, undone = (np.mean(np.logaddexp(0, x)) for x in (-fake, -real, fake))
    return of_fake, of_real + undone


def r1(image, kernel):
    """Penalty of the discriminator (image . kernel)^2 / 2."""
    return losses.r1(lambda x: 0.5 * jnp.einsum("bhwc,hwc->b", x, kernel, precision="highest") ** 2, image)


def r1_twin(image, kernel):
    """Half the mean of |(image . kernel) kernel|^2."""
    return (0.5 * np.mean(np.einsum("bhwc,hwc->b", image, kernel) ** 2 * np.sum(kernel**2)),)


def penalised(rng: Rng, value: float):
    """An image and the kernel of a discriminator whose gradient has about that size."""
    return rng.uniform(0.5, 1, (2, 8, 8, 3)), np.sqrt(value) * rng.uniform(0.05, 0.1, (8, 8, 3))


def off_grey(rng: Rng, value: float):
    """Images brighter than grey by about that much, and grey."""
    grey = np.full((2, 24, 24, 3), 0.5)
    return grey + value * rng.uniform(0.5, 1, grey.shape), grey


def psnr_twin(image, reference):
    """Decibel, at most 100."""
    return (-10 * np.log10(np.maximum(np.mean((image - reference) ** 2, (1, 2, 3)), 1e-10)),)


def conditional_psnr(image, reference):
    """Over the left half."""
    mask = jnp.broadcast_to(jnp.arange(image.shape[2]) < image.shape[2] // 2, image.shape[:-1])
    return metrics.conditional_psnr(image, reference, mask)


def conditional_psnr_twin(image, reference):
    """PSNR of the left half."""
    return psnr_twin(*(x[:, :, : x.shape[2] // 2] for x in (image, reference)))


def textures(rng: Rng, contrast: float, brightness: float = 0.5):
    """Two images of random texture."""
    return tuple(brightness + contrast * rng.uniform(-1, 1, (2, 24, 24, 3)) for _ in range(2))


def ssim_twin(image, reference):
    """scikit-image."""
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    score = partial(structural_similarity, data_range=1.0, channel_axis=-1, **settings)
    return (np.array([score(a, b) for a, b in zip(image, reference, strict=True)]),)
