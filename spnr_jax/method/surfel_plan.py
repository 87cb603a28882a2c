"""At what size a view of surfels is drawn, and which window of it: counted first, because sizes shape arrays.

A picture is drawn at the resolution at which the points lie FINEST to COARSEST pixels apart and doubled from there by
the network, so its work follows the points and the pixels that they cover.  Only a window around the object is drawn.
Sizes are rounded up to few values: each new one is compiled once.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.errors import UserError
from spnr_jax.kernels.records import Camera, Surfels
from spnr_jax.surfels import projection

COARSEST = 3.5  # pixels between points from which on a picture is drawn at half the size
FINEST = 0.8  # below which it is drawn at twice the size and averaged
MOST_DOUBLINGS = 4
STEP, MARGIN = 32, 8  # pixels of which a window is a multiple, and around the object in it
GRID = 8  # of which a window's corner is a multiple: the network's levels see the same squares from every camera


class Plan(NamedTuple):
    """Doublings by the network, pixels averaged along a side, and the window of the G-buffer."""

    doublings: int
    side: int
    left: int
    top: int
    width: int
    height: int


def planned(surfels: Surfels, spacing: float, camera: Camera, share: float) -> tuple[Plan, int]:
    """Where and at what size a view is drawn, and its entries at most."""
    doublings, side = resolution_of(spacing, camera, share)
    box, total = jax.device_get(_extent(surfels, scaled(camera, doublings, side)))
    return _window(box, doublings, side), int(total)


def resolution_of(spacing: float, camera: Camera, share: float = 1.0) -> tuple[int, int]:
    """Doublings by the network, and pixels averaged along each side, for points this far apart around the origin.

    They are those of the picture of which the camera has a share of the pixels along a side.
    """
    focal, eye = np.asarray(camera.intrinsics)[0, 0], np.asarray(camera.cam_to_world, np.float64)[:, 3]
    pixels = spacing * float(focal) / share / max(float(np.linalg.norm(eye)), 1e-3)
    doublings = int(np.clip(np.floor(np.log2(max(pixels / COARSEST, 1e-9))) + 1, 0, MOST_DOUBLINGS))
    return doublings, 2 if pixels < FINEST else 1


@partial(jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": False})  # a third off the compilation
def _extent(surfels: Surfels, camera: Camera) -> tuple[Array, Array]:
    """Lowest and highest column and row that discs cover, and the number of entries at most."""
    foot = projection.footprints(surfels, camera)
    drawn = foot.covered > 0
    rows = foot.covered // foot.width
    low = [jnp.min(jnp.where(drawn, x, 2**20)) for x in (foot.left, foot.top)]
    high = [jnp.max(jnp.where(drawn, x + n, 0)) for x, n in ((foot.left, foot.width), (foot.top, rows))]
    return jnp.stack([*low, *high]), jnp.sum(foot.covered)


def _window(box: np.ndarray, doublings: int, side: int) -> Plan:
    left, top = (max(int(x) - MARGIN, 0) // GRID * GRID for x in box[:2])
    width, height = (
        max(-(-(int(end) + MARGIN - first) // STEP) * STEP, STEP)
        for first, end in zip((left, top), box[2:], strict=True)
    )
    return Plan(doublings, side, left, top, width, height)


def rounded(count: int, least: int, most: int) -> int:
    """A power of the root of two that holds the count: few sizes, few compilations."""
    if count > most:
        raise UserError(f"the picture needs {count} entries of discs, at most {most} are drawn; ask for a smaller one")
    return min(int(2 ** (np.ceil(2 * np.log2(max(count, least))) / 2)), most)


def scaled(camera: Camera, doublings: int, side: int) -> Camera:
    """The camera at the network's resolution; doubled, its picture may be larger than asked for, and is cut."""
    height, width = (-(-n * side // 2**doublings) for n in (camera.height, camera.width))
    scale = np.array([[side / 2**doublings], [side / 2**doublings], [1.0]], np.float32)
    intrinsics = np.asarray(camera.intrinsics, np.float32) * scale
    return Camera(cam_to_world=camera.cam_to_world, intrinsics=intrinsics, height=height, width=width)


def seen_through(camera: Camera, plan: Plan) -> Camera:
    """The camera whose picture is the window."""
    intrinsics = np.array(camera.intrinsics, np.float32)
    intrinsics[:2, 2] -= plan.left, plan.top
    return Camera(
        cam_to_world=np.asarray(camera.cam_to_world, np.float32),
        intrinsics=intrinsics,
        height=plan.height,
        width=plan.width,
    )


def in_window(picture: Float[Array, "h w features"], plan: Plan) -> Float[np.ndarray, "height width features"]:
    """The part of a picture in the window, which may reach beyond it."""
    ends = plan.top + plan.height, plan.left + plan.width
    lacking = [(0, max(end - n, 0)) for end, n in zip(ends, picture.shape, strict=False)]
    return np.pad(np.asarray(picture), [*lacking, (0, 0)])[plan.top : ends[0], plan.left : ends[1]]
