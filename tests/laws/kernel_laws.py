"""Laws of numbers, cameras, losses and metrics: functions, domains in which float32 keeps its budget, twins.

Inputs stay away from kinks (cell walls, equal pixels): there a gradient jumps, and no precision helps.  Twins are
mostly the plain loops of tests/support/reference.py.  Sizes of `Extremes` run from 1e-30 to 1e30 wherever float32 can
hold the answer.
"""

from functools import partial
from math import comb

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from scipy.ndimage import correlate1d
from skimage.metrics import structural_similarity
from support import reference
from support.laws import TINY, Axis, Extremes, Law, close, extremes

from spnr_jax.kernels import cameras, imaging, losses, metrics, numerics
from spnr_jax.kernels.records import Camera
from spnr_jax.nn.paper_layers import encode_direction

FINITE = 1e30  # a floor under which gradients only have to be finite
seeds = st.integers(0, 999)


def each(twin, signature):
    """The twin of one item for any batch of them."""
    return np.vectorize(twin, signature=signature)


def usual(inputs):
    """The axis of a function that is looked at for arguments of size 1 alone."""
    return (Axis("size", 1, 1, 1, lambda rng, v: inputs(rng)),)


def sizes(name, low, high, inputs):
    return (Axis(name, low, 1, high, inputs),)


def around_zero(*shape):
    return lambda rng: (rng.uniform(0.2, 3, shape) * rng.choice([-1, 1], shape),)


def unit(vectors):
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


# numbers and vectors


def quotient(numerator, denominator):
    """0 where float32 does not hold a denominator or a quotient."""
    zero = np.abs(denominator) < TINY
    found = numerator / np.where(zero, 1, denominator)
    return np.where(zero | (np.abs(found) < TINY), 0, found)


def encode_srgb(x):
    with np.errstate(under="ignore"):
        return np.where(x > 0.0031308, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055, 12.92 * x)


def decode_srgb(x):
    return np.where(x > 0.04045, ((np.maximum(x, 0) + 0.055) / 1.055) ** 2.4, x / 12.92)


def encoding(frequencies):
    """Directions, and their sines and cosines."""
    return lambda d: np.concatenate([d] + [f(d * 2**k) for k in range(frequencies) for f in (np.sin, np.cos)], axis=-1)


def held(arguments, outputs):
    """Quotients that float32 holds are those of the twin."""
    expected = quotient(*map(np.float64, arguments))
    close(outputs[0][np.abs(expected) < 3e38], expected[np.abs(expected) < 3e38], rtol=1e-6, atol=TINY)


vectors = extremes(4, 3, low=-36, high=36).map(lambda v: np.where(np.abs(v) < TINY, 0, v))
# fmt: off
NUMBERS = (
    Law("safe_divide", numerics.safe_divide, quotient,
        usual(lambda rng: (rng.normal(size=(6, 4)), *around_zero(6, 4)(rng))), (1, 1),
        Extremes((extremes(6), extremes(6, low=-17, high=17)), check=held, twin=False)),
    Law("one_minus_exp", numerics.one_minus_exp, lambda x: -np.expm1(-x),
        sizes("size", 1e-30, 15, lambda rng, v: (v * rng.uniform(0.5, 1, (6, 4)),)), (1,),
        Extremes((extremes(6, signed=False),))),
    Law("softplus", numerics.softplus, reference.softplus, usual(around_zero(6, 4)), (1,),
        Extremes((extremes(6, high=36),)), agreement=1e-8),
    Law("slope of softplus", lambda x: jax.grad(lambda x: jnp.sum(numerics.softplus(x)))(x),
        lambda x: 1 / (1 + np.exp(-x)), usual(around_zero(6, 4)), (1,)),
    Law("length", numerics.length, partial(np.linalg.norm, axis=-1), usual(around_zero(6, 3)), (1,),
        Extremes((vectors,))),
    Law("normalize", numerics.normalize, unit, usual(around_zero(6, 3)), (1,), Extremes((vectors,))),
    Law("linear_to_srgb", imaging.linear_to_srgb, encode_srgb, usual(lambda rng: (rng.uniform(-0.1, 1, (6, 4)),)), (1,),
        Extremes((extremes(6, high=15),), rtol=2e-6)),
    Law("srgb_to_linear", imaging.srgb_to_linear, decode_srgb, usual(lambda rng: (rng.uniform(-0.1, 1, (6, 4)),)), (1,),
        Extremes((extremes(6, high=15),), rtol=1e-5)),
    Law("encode_direction", lambda d: encode_direction(d, 4), encoding(4), usual(around_zero(6, 3)), (1,)),
)
# fmt: on

# cameras and rays


def view_rays(cam_to_world, intrinsics):
    """Origins and directions of a picture of 4 x 6 pixels."""
    rays = cameras.camera_rays(Camera(cam_to_world=cam_to_world, intrinsics=intrinsics, height=4, width=6))
    return rays.origins, rays.directions


def view_rays_twin(pose, intrinsics):
    focal, centre = intrinsics[0, 0], intrinsics[:2, 2]
    rays = [[reference.camera_ray(pose, focal, centre, row, column) for column in range(6)] for row in range(4)]
    return np.broadcast_to(pose[:, 3], (4, 6, 3)), np.array(rays)


def views(rng, field):
    """Turned cameras of that field of view in radians."""
    focal = 3 / np.tan(field / 2)
    turn = np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(6)])
    return np.concatenate([turn, rng.normal(size=(6, 3, 1))], 2), np.tile(
        [[focal, 0, 3], [0, focal, 2], [0, 0, 1.0]], (6, 1, 1)
    )


def look_at_twin(eye, target, up):
    """The axes of a camera in columns, and where it stands."""
    backward = unit(eye - target)
    right = unit(np.cross(up, backward))
    return np.stack([right, np.cross(backward, right), backward, eye], axis=-1)


def project(pose, intrinsics, positions):
    view = Camera(cam_to_world=pose, intrinsics=intrinsics, height=4, width=6)
    return cameras.project(view, positions)


def project_twin(pose, intrinsics, positions):
    local = (positions - pose[:, 3]) @ pose[:, :3]
    ahead = local[:, 2:] < 0
    plane = local[:, :2] / -np.where(ahead, local[:, 2:], 1) * [1, -1]
    return np.where(ahead, intrinsics[0, 0] * plane + intrinsics[:2, 2], -np.inf), np.linalg.norm(local, axis=1)


def before_eyes(rng, field):
    pose, intrinsics = views(rng, field)
    local = np.concatenate([rng.normal(size=(6, 5, 2)), -rng.uniform(2, 4, (6, 5, 1))], -1)
    return pose, intrinsics, np.einsum("nij,nkj->nki", pose[..., :3], local) + pose[:, None, :, 3]


# before an eye, in its plane, behind it, and in the eye itself
BESIDE_EYE = np.array([[0.5, 0.2, -2], [0.5, 0.2, 0], [0.5, 0.2, 2], [0, 0, 0]])
LENS = np.array([[7.0, 0, 3], [0, 7, 2], [0, 0, 1]])


def orbit_twin(azimuth, elevation, distance, centre):
    """Azimuth from z towards x; beyond a pole the camera goes on upside down."""
    right, south = np.array([[np.cos(azimuth), 0, -np.sin(azimuth)], [np.sin(azimuth), 0, np.cos(azimuth)]])
    backward = np.cos(elevation) * south + [0, np.sin(elevation), 0]
    return np.stack([right, np.cross(backward, right), backward, centre + distance * backward], axis=-1)


def around(rng):
    """Azimuths, elevations with both poles among them, distances and centres."""
    elevation = np.array([-0.5, 0.5, 1.5, *rng.uniform(-1, 1, 3)]) * np.pi
    return rng.uniform(-4, 4, 6), elevation, rng.uniform(1, 4, 6), rng.normal(size=(6, 3))


def lenses(cam_to_world, field_of_view):
    return cameras.pinhole(cam_to_world, field_of_view, 4, 6).intrinsics


def lens_twin(cam_to_world, field_of_view):
    focal = 3 / np.tan(field_of_view / 2)
    return np.array([[focal, 0, 3], [0, focal, 2], [0, 0, 1]])


def box(origins, directions):
    near, far, _ = cameras.intersect_box(origins, directions)
    return near, far - near


def box_twin(origin, direction):
    near, far = (direction.any() and reference.box_interval(origin, direction)) or (0.0, 0.0)
    return near, far - near


def towards_box(rng, distance):
    """Rays from a sphere around the box towards its inner half."""
    origins = unit(rng.normal(size=(6, 3))) * distance
    return origins, unit(rng.uniform(-0.5, 0.5, (6, 3)) - origins)


def touches_or_hits(arguments, outputs):
    """A ray that touches the box may hit or miss it; others have the interval of the loop."""
    for origin, towards, near, inside in zip(*arguments, *outputs, strict=True):
        expected, rounding = box_twin(*np.float64([origin, towards])), 1e-6 * (1 + np.abs(origin).max())
        assert near >= 0
        assert inside >= 0
        if expected[1] > rounding:
            close((near, near + inside), (expected[0], sum(expected)), rtol=1e-5, atol=rounding)
        else:
            assert inside <= 2 * rounding


unit_vectors = extremes(5, 3).map(lambda v: np.asarray(numerics.normalize(jnp.asarray(v))))
# fmt: off
CAMERAS = (
    Law("look_at", cameras.look_at, look_at_twin,
        usual(lambda rng: (rng.normal(size=(6, 3)), 3 + rng.normal(size=(6, 3)), np.eye(3)[[1] * 6])), (1, 1, 1)),
    Law("camera_rays", view_rays, each(view_rays_twin, "(r,c),(k,k)->(h,w,r),(h,w,r)"),
        (Axis("field of view", 1e-20, 0.7, 3.1415, views),), (2, 2)),
    Law("project", project, each(project_twin, "(r,c),(k,k),(n,r)->(n,t),(n)"),
        (Axis("field of view", 0.7, 0.7, 0.7, before_eyes),), (2, 2, 2),
        Extremes((st.just((np.eye(3, 4), LENS, BESIDE_EYE)),)), agreement=1e-7),
    Law("orbit", cameras.orbit, each(orbit_twin, "(),(),(),(n)->(r,c)"), usual(around), (0, 0, 0, 1)),
    Law("pinhole", lenses, each(lens_twin, "(r,c),()->(k,k)"), usual(lambda rng: (views(rng, 1)[0], rng.random(6))),
        (2, 0)),
    Law("intersect_box", box, each(box_twin, "(n),(n)->(),()"), sizes("distance of the camera", 1, 100, towards_box),
        (1, 1), Extremes((extremes(5, 3, low=-30, high=4), unit_vectors), floors=(FINITE, FINITE),
        check=touches_or_hits, twin=False)),
)
# fmt: on

# losses, metrics, pictures


def r1(image, kernel):
    """Penalty of the discriminator (image . kernel)^2 / 2."""
    return losses.r1(lambda x: 0.5 * jnp.einsum("bhwc,hwc->b", x, kernel, precision="highest") ** 2, image)


def images(rng, size):
    """Two images of that size, nowhere equal."""
    image = rng.normal(size=(16, 16, 3))
    return size * image, size * (image + rng.uniform(0.1, 1, image.shape))


def off_grey(rng, value):
    """Images brighter than grey by about that much, and grey."""
    grey = np.full((6, 16, 13, 3), 0.5)
    return grey + value * rng.uniform(0.5, 1, grey.shape), grey


def masked(rng):
    """Two images, and about half of their pixels."""
    return *off_grey(rng, 0.3), rng.uniform(size=(6, 16, 13))


def decibel(image, other):
    return -10 * np.log10(np.maximum(np.mean((image - other) ** 2, (-3, -2, -1)), 1e-10))


def visible_decibel(image, other, mask):
    return -10 * np.log10(np.maximum(np.mean((image - other)[mask > 0.5] ** 2), 1e-10))


def ssim_twin(image, other):
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return structural_similarity(other, image, data_range=1.0, channel_axis=-1, **options)


def union_share(acc, alpha):
    """Pixels that both hold among those that either does."""
    ours, theirs = acc > 0.5, alpha > 0.5
    return (ours & theirs).sum((-2, -1)) / (ours | theirs).sum((-2, -1))


def quality(image, other, mask):
    """All metrics; 0 where no pixel is visible."""
    visible = metrics.conditional_psnr(image, other, mask > 0.5)
    return metrics.psnr(image, other), jnp.where(jnp.isnan(visible), 0, visible), metrics.ssim(image, other)


def smooth_twin(x):
    """Each axis in turn, less what a binomial filter leaves of it once every second pixel has the other sign."""
    for axis in (1, 2):
        alternating = [(-1) ** i * comb(8, i) / 256 for i in range(9)]
        x = x - correlate1d(np.float64(x), alternating, axis, mode="nearest")
    return x


def quality_twin(image, other, mask):
    """Where both images are bright and flat, float32 leaves three digits of their variances."""
    visible = visible_decibel(image, other, mask) if (mask > 0.5).any() else 0.0
    return decibel(image, other), visible, ssim_twin(image, other)


@st.composite
def pictures(draw):
    """Two pictures in [0, 1], and a mask of none, some or all pixels."""
    other, change = draw(extremes(12, 12, 3, high=0, signed=False)), draw(extremes(12, 12, 3, high=0))
    mask = np.random.default_rng(draw(seeds)).random((12, 12)) < draw(st.sampled_from([0, 0.1, 1]))
    return np.clip(other + change, 0, 1), other, np.float32(mask)


# fmt: off
LOSSES = (
    Law("l1", losses.l1, lambda a, b: np.mean(np.abs(a - b)), sizes("difference", 1e-34, 1e32, images),
        extremes=Extremes((extremes(2, 4, 3), extremes(2, 4, 3)))),
    Law("mse", losses.mse, lambda a, b: np.mean((a - b) ** 2), sizes("difference", 1e-17, 1e17, images)),
    Law("adversarial losses", lambda real, fake: (losses.generator_adversarial(fake),
            losses.discriminator_adversarial(real, fake)),
        lambda real, fake: (reference.softplus(-fake).mean(),
        reference.softplus(-real).mean() + reference.softplus(fake).mean()),
        usual(lambda rng: tuple(rng.normal(size=(2, 2, 5, 5, 1)))),
        extremes=Extremes((extremes(2, 5), extremes(2, 5)))),
    Law("r1", r1, lambda x, k: 0.5 * np.mean(np.einsum("bhwc,hwc->b", x, k) ** 2 * np.sum(k**2)),
        sizes("size of the gradient", 1e-16, 1e16,
        lambda rng, v: (rng.uniform(0.5, 1, (2, 8, 8, 3)), v**0.5 * rng.uniform(0.05, 0.1, (8, 8, 3))))),
    Law("area_downsample", lambda image: losses.area_downsample(image, 3),
        each(partial(reference.area_downsample, size=3), "(h,w,c)->(s,s,c)"), usual(around_zero(6, 5, 7, 2)), (3,),
        Extremes((extremes(5, 7, 3),), rtol=1e-5, atol=lambda image: 1e-6 * np.abs(image).max() + TINY),
        agreement=1e-6),
    Law("psnr", metrics.psnr, decibel, (Axis("difference", 0, 0.1, 1e17, off_grey),), (3, 3), floors=(1.0,)),
    Law("conditional_psnr", lambda a, b, mask: metrics.conditional_psnr(a, b, mask > 0.5),
        each(visible_decibel, "(h,w,c),(h,w,c),(h,w)->()"), usual(masked), (3, 3, 2)),
    Law("ssim", metrics.ssim, each(ssim_twin, "(h,w,c),(h,w,c)->()"),
        (Axis(*("contrast", 0.1, 0.1, 10), lambda rng, v: tuple(0.5 + v * rng.uniform(-1, 1, (2, 6, 16, 13, 3)))),),
        (3, 3), floors=(1.0,)),
    Law("opacity_iou", metrics.opacity_iou, union_share, usual(lambda rng: tuple(rng.uniform(size=(2, 6, 8, 8)))),
        (2, 2)),
    Law("metrics of pictures", quality, quality_twin,
        usual(lambda rng: (*(0.5 + 0.4 * rng.uniform(-1, 1, (2, 12, 12, 3))), np.eye(12))),
        extremes=Extremes((pictures(),), floors=(FINITE,) * 3, atol=lambda *x: 2e-3)),
    Law("bilinear", lambda x: imaging.resize_bilinear(x, 6, 9),
        each(partial(reference.bilinear, height=6, width=9), "(h,w,c)->(a,b,c)"), usual(around_zero(2, 4, 6, 2))),
    Law("double_size", imaging.double_size, lambda x: np.stack([reference.bilinear(one, 2 * x.shape[1],
            2 * x.shape[2]) for one in x]), usual(around_zero(2, 3, 4, 2))),
    Law("remove_checkerboard", imaging.remove_checkerboard, smooth_twin, usual(around_zero(2, 5, 6, 2))),
)
# fmt: on

LAWS = (*NUMBERS, *CAMERAS, *LOSSES)
