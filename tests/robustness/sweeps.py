"""Which kernel is swept along which axis, and the domain in which float32 keeps its budget (docs/lab/stability.md).

Inputs stay away from kinks (cell walls, equal pixels): there a gradient jumps, and no precision helps.  A twin is the
kernel's value in float64 NumPy, mostly the plain loops of tests/support/reference.py.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from skimage.metrics import structural_similarity
from support import reference

from spnr_jax.config import AS_TRAINED, PaperConfig, SamplingConfig
from spnr_jax.kernels import cameras, compositing, losses, metrics, sampling, voxels
from spnr_jax.kernels.records import Camera, Rays, Scene
from spnr_jax.method import inference, paper_method
from spnr_jax.nn.normalization import BatchNorm, GroupNorm

RAYS = 16


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """A kernel along an axis: its domain from `low` to `high`, its inputs at a value, and what it is compared with."""

    kernel: str
    axis: str
    low: float
    usual: float
    high: float
    function: Callable
    inputs: Callable
    twin: Callable | None = None
    floors: tuple[float, ...] = ()  # smallest scale that each output's error is relative to

    def __str__(self) -> str:
        """As a table names it."""
        return f"{self.kernel}, {self.axis}"


def rowwise(twin: Callable) -> Callable:
    """The twin of one ray for many."""
    return lambda *arrays: tuple(map(np.stack, zip(*(twin(*row) for row in zip(*arrays, strict=True)), strict=True)))


def unit(x):
    """Vectors of length 1."""
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def view_rays(cam_to_world, intrinsics):
    """Directions of an 8 x 8 image."""
    return cameras.camera_rays(Camera(cam_to_world=cam_to_world, intrinsics=intrinsics, height=8, width=8)).directions


def view_rays_twin(pose, intrinsics):
    """Pixel by pixel."""
    focal, centre = intrinsics[0, 0], intrinsics[:2, 2]
    rays = [[reference.camera_ray(pose, focal, centre, row, column) for column in range(8)] for row in range(8)]
    return (np.array(rays),)


def view(rng, field):
    """A turned camera of that field of view in radians."""
    focal = 4 / np.tan(field / 2)
    pose = np.concatenate([np.linalg.qr(rng.normal(size=(3, 3)))[0], np.ones((3, 1))], 1)
    return pose, np.array([[focal, 0, 4], [0, focal, 4], [0, 0, 1.0]])


def box(origins, directions):
    """Entry and length inside."""
    near, far, _ = cameras.intersect_box(origins, directions)
    return near, far - near


def box_twin(origin, direction):
    """Of one ray."""
    near, far = reference.box_interval(origin, direction) or (0.0, 0.0)
    return near, far - near


def towards_box(rng, distance):
    """Rays from a sphere around the box towards its inner half."""
    origins = unit(rng.normal(size=(RAYS, 3))) * distance
    return origins, unit(rng.uniform(-0.5, 0.5, (RAYS, 3)) - origins)


def layers(rng, depth=3.0, n=128):
    """Densities of about that optical depth in all, and lengths."""
    return depth * rng.uniform(0.01, 2, (RAYS, n)), rng.uniform(0.5, 1.5, (RAYS, n)) / n


def shares(rng, n=128):
    """Weights that add up to 0.9."""
    weights = rng.uniform(0.1, 1, (RAYS, n))
    return 0.9 * weights / weights.sum(-1, keepdims=True)


def along(rng, size):
    """Weights, distances between 2 and 3 sizes, and the far side."""
    return shares(rng), size * np.sort(rng.uniform(2, 3, (RAYS, 128))), np.full(RAYS, 3.0 * size)


def cells(rng, n, resolution):
    """Positions well inside voxels, away from their walls and centres' planes."""
    cell = rng.integers(0, resolution, (n, 3)) + rng.choice([0.25, 0.75], (n, 3)) + rng.uniform(-0.2, 0.2, (n, 3))
    return cell * 2 / resolution - 1


def points(rng, n, resolution, size=1.0):
    """Features up to a size, positions, and a volume of zeros that says the resolution."""
    return size * rng.uniform(0, 1, (n, 1)), cells(rng, n, resolution), np.zeros((resolution,) * 3)


def scatter(features, positions, like):
    """Mean and occupancy."""
    mask = jnp.ones(positions.shape[:-1], bool)
    return voxels.scatter_mean(jax.lax.stop_gradient(positions), features, mask, len(like))


def scatter_twin(features, positions, like):
    """A list of points per voxel."""
    return reference.scatter_mean(positions, features, np.ones(len(features), bool), len(like))


def lookup(rng, resolution, size=1.0):
    """A random volume and places in it."""
    return size * rng.normal(size=(*[resolution] * 3, 2)), cells(rng, 50, resolution)


def batch_norm(x):
    """In training, all points real."""
    inputs = (x, jnp.ones(x.shape[:-1], bool), True)
    return BatchNorm().apply(initial(BatchNorm(), *inputs), *inputs, mutable=["batch_stats"])[0]


def group_norm(x):
    """Of one volume, one group."""
    return GroupNorm(1).apply(initial(GroupNorm(1), x[None]), x[None])[0]


def initial(module, x, *others):
    """The ones and zeros that a normalisation starts with, in the format of x."""
    return jax.tree.map(lambda leaf: leaf.astype(x.dtype), module.init(jax.random.key(0), x, *others))


def r1(image, kernel):
    """Penalty of the discriminator (image . kernel)^2 / 2."""
    return losses.r1(lambda x: 0.5 * jnp.einsum("bhwc,hwc->b", x, kernel, precision="highest") ** 2, image)


def images(rng, size, apart=1.0):
    """Two images of that size, nowhere equal."""
    image = rng.normal(size=(32, 32, 3))
    return size * image, size * (image + apart * rng.uniform(0.1, 1, image.shape))


def off_grey(rng, value):
    """Images brighter than grey by about that much, and grey."""
    grey = np.full((2, 24, 24, 3), 0.5)
    return grey + value * rng.uniform(0.5, 1, grey.shape), grey


def ssim_twin(image, other):
    """scikit-image."""
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    return ([structural_similarity(*pair, channel_axis=-1, **settings) for pair in zip(image, other, strict=True)],)


def render(volume, origins, directions, bias):
    """Features, depth and opacity of rays through a volume by a small network; `bias` moves every density."""
    config = PaperConfig(
        field_width=8,
        num_features=4,
        direction_frequencies=1,
        sampling=SamplingConfig(num_coarse=16, num_fine=16),
    )
    module, rays = inference.network(config), Rays(origins=origins, directions=directions)
    encoded, rng = Scene(volume=volume, occupied=jnp.ones(volume.shape[:-1], bool)), np.random.default_rng(7)
    traced = partial(paper_method.trace, samples=config.sampling, options=AS_TRAINED, key=None)
    shapes = jax.eval_shape(lambda: module.init(jax.random.key(0), encoded, rays, method=traced))
    draw = lambda x: np.float32(rng.normal(size=x.shape) / max(int(np.prod(x.shape[:-1])), 1) ** 0.5)  # noqa: E731
    variables = jax.tree.map(lambda x: jnp.asarray(draw(x), volume.dtype), shapes)
    head = variables["params"]["field"]["head"]
    # no gradient by the bias: one number for all rays, whose gradients would cancel
    head["bias"] = head["bias"] + jnp.concatenate([jax.lax.stop_gradient(bias), jnp.zeros(3, bias.dtype)])
    return tuple(traced(module.bind(variables), encoded, rays))


def scene(rng, density=3.0, distance=3.0):
    """A random volume of about that density, seen from that far away."""
    origins, directions = towards_box(rng, distance)
    bias = np.array([1 + (density if density > 30 else np.log(np.expm1(density)))])
    return rng.normal(size=(1, 8, 8, 8, 16)), origins[None], directions[None], bias


def psnr_twin(image, other):
    """Decibel, at most 100."""
    return (-10 * np.log10(np.maximum(np.mean((image - other) ** 2, (1, 2, 3)), 1e-10)),)


WEIGHTS, COMPOSITE = rowwise(reference.volume_weights), lambda w, x: compositing.composite(w, x, 1.0)
ROWS = (  # kernel, axis, low, usual, high, function, inputs, twin, floors
    ("camera_rays", "field of view", 1e-20, 0.7, 3.1415, view_rays, view, view_rays_twin),
    ("intersect_box", "distance of the camera", 1, 1, 100, box, towards_box, rowwise(box_twin)),
    *(
        ("volume_weights", name, low, usual, high, compositing.volume_weights, inputs, WEIGHTS, (0.0, 1.0))
        for name, low, usual, high, inputs in (
            ("optical depth of a ray", 1e-32, 1, 1e36, layers),
            ("number of samples", 1, 64, 4096, lambda rng, n: layers(rng, n=int(n))),
        )
    ),
    (
        *("composite", "size of the colours", 1e-40, 1, 1e36, COMPOSITE),
        lambda rng, v: (shares(rng), v * rng.uniform(0, 1, (RAYS, 128, 3))),
        lambda w, x: (np.stack([reference.composite(a, b, 1.0) for a, b in zip(w, x, strict=True)]),),
        (1.0,),
    ),
    (
        *("expected_distance", "size of the distances", 1e-32, 1, 1e36, compositing.expected_distance, along),
        lambda w, t, far: ((w * t).sum(-1) + (1 - w.sum(-1)) * far,),
    ),
    (
        *("stratified", "size of near and far", 1e-32, 1, 1e36, lambda a, b: sampling.stratified(None, a, b, 64)),
        lambda rng, v: (v * rng.uniform(0.5, 1, RAYS), v * rng.uniform(1.5, 2, RAYS)),
    ),
    *(
        ("scatter_mean", name, low, usual, high, scatter, inputs, scatter_twin)
        for name, low, usual, high, inputs in (
            ("size of the features", 1e-32, 1, 1e36, lambda rng, v: points(rng, 100, 4, v)),
            ("points in one voxel", 1, 64, 32768, lambda rng, n: points(rng, int(n), 1)),
        )
    ),
    *(
        ("trilinear", name, low, usual, high, voxels.trilinear, inputs, twin)
        for twin in [lambda volume, at: (np.stack([reference.trilinear(volume, p) for p in at]),)]
        for name, low, usual, high, inputs in (
            ("size of the features", 1e-32, 1, 1e36, lambda rng, v: lookup(rng, 8, v)),
            ("voxels along an axis", 2, 32, 64, lambda rng, d: lookup(rng, int(d))),
        )
    ),
    *(
        (name, axis, low, 1, high, function, lambda rng, v, s=shape, m=moved: (moved_by(rng, v, s, m),), twin)
        for name, function, shape, twin in (
            ("BatchNorm", batch_norm, (512, 8), lambda x: (reference.batch_norm(x)[0],)),
            ("GroupNorm", group_norm, (4, 4, 4, 4), lambda x: (reference.group_norm(x, 1, 1.0, 0.0),)),
        )
        for axis, low, high, moved in (
            ("spread of the features", 1e-33, 1e15, False),
            ("mean over spread", 1, 100, True),
        )
    ),
    ("l1", "difference", 1e-36, 1, 1e32, losses.l1, images, lambda a, b: (np.mean(np.abs(a - b)),)),
    (
        *("r1", "size of the gradient", 1e-16, 1, 1e16, r1),
        lambda rng, v: (rng.uniform(0.5, 1, (2, 8, 8, 3)), v**0.5 * rng.uniform(0.05, 0.1, (8, 8, 3))),
        lambda x, k: (0.5 * np.mean(np.einsum("bhwc,hwc->b", x, k) ** 2 * np.sum(k**2)),),
    ),
    ("psnr", "difference", 0, 0.1, 1e17, metrics.psnr, off_grey, psnr_twin, (1.0,)),
    (
        *("ssim", "contrast", 0.1, 0.1, 10, metrics.ssim),
        lambda rng, v: tuple(0.5 + v * rng.uniform(-1, 1, (2, 24, 24, 3)) for _ in range(2)),
        *(ssim_twin, (1.0,)),
    ),
    ("whole render", "density", 1e-30, 1, 1e30, render, scene, None, (1.0, 1.0, 1.0)),
    (
        *("whole render", "distance of the camera", 1, 3, 10, render),
        *(lambda rng, v: scene(rng, distance=v), None, (1.0, 1.0, 1.0)),
    ),
)


def moved_by(rng, value, shape, moved):
    """Features of that spread, or of that mean and spread 1."""
    return value + rng.normal(size=shape) if moved else value * rng.normal(size=shape)


NAMES = ("kernel", "axis", "low", "usual", "high", "function", "inputs", "twin", "floors")
SWEEPS = [Sweep(**dict(zip(NAMES, row, strict=False))) for row in ROWS]
