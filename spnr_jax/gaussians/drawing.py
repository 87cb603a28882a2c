"""A differentiable picture of Gaussian splats, as viewers draw them (EWA, Zwicker et al. 2001; Kerbl et al. 2023).

    footprint   a splat on the picture: centre, inverse covariance (a, b, c: a dx^2 + 2 b dx dy + c dy^2), depth; its
                covariance grows by `dilation` square pixels, so that no splat falls between the pixels, and what it
                hides stays: its opacity becomes that of `share` (Mip-Splatting, Yu et al. 2024), else small pictures
                would show everything thicker
    lists       the front-most splats of each covered pixel, at most LIST, in the order of the depth of their centres
    blend       alpha = opacity exp(-distance^2 / 2), laid over each other from the front, on a background

Lists are data: gradients pass through `footprints` and `blend` by shape, opacity and colour, not by what covers what.
A picture whose pixels are every second one of a larger picture is drawn with the camera of `every` and a quarter of the
dilation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spnr_jax.gaussians.harmonics import basis, degree_of
from spnr_jax.kernels.numerics import gather_rows, normalize
from spnr_jax.kernels.records import AnyArray, Camera, Gaussians

DILATION = 0.1  # square pixels (Mip-Splatting); as wide as the .3 of most viewers in a picture 1.7 times as large
LEAST_ALPHA = 1 / 255  # below which a splat does not touch a pixel
MOST_ALPHA = 0.99
LEAST_SHARE = 1e-4  # square of the smallest share, of a splat that is seen from its edge
NEAREST = 1e-6  # distance before the camera from which splats are drawn, in any unit
WIDEST = 128  # pixels that a splat reaches to each side at most
LIST = 1024  # splats of a pixel at most; the rest lies behind what is opaque
TOGETHER = 2**21  # entries of the lists of the pixels that are blended at a time


class Footprints(NamedTuple):
    """Splats on a picture, columns and rows in pixels."""

    centre: Float[Array, "splats 2"]
    conic: Float[Array, "splats 3"]
    depth: Float[Array, " splats"]
    share: Float[Array, " splats"]


class Lists(NamedTuple):
    """Numbers of the splats of each covered pixel, front-most first, then their count; and the pixel's number."""

    splats: Int[np.ndarray, "list pixels"]
    pixel: Int[np.ndarray, " pixels"]


def rotations(quaternion: Float[AnyArray, "splats 4"]) -> Float[Array, "splats 3 3"]:
    """Rotation matrices of unit quaternions w x y z."""
    w, x, y, z = (quaternion[:, i] for i in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def footprints(gaussians: Gaussians, camera: Camera, dilation: float | Array = DILATION) -> Footprints:
    """Where the splats lie on the picture of a camera (unbatched); behind it their depth is negative."""
    pose, k = jnp.asarray(camera.cam_to_world), jnp.asarray(camera.intrinsics)
    turn = pose[:, :3] * jnp.array([[1.0, -1.0, -1.0]])  # to axes right, down, forward
    local = jnp.matmul(jnp.asarray(gaussians.position) - pose[None, :, 3], turn, precision="highest")
    depth = local[:, 2]
    ahead = jnp.maximum(depth, NEAREST)
    across, down = local[:, 0] / ahead, local[:, 1] / ahead
    axes = jnp.matmul(turn.T, rotations(jnp.asarray(gaussians.rotation)), precision="highest")
    axes = axes * jnp.asarray(gaussians.scale)[:, None, :]
    right = k[0, 0] / ahead[:, None] * (axes[:, 0] - across[:, None] * axes[:, 2])
    below = k[1, 1] / ahead[:, None] * (axes[:, 1] - down[:, None] * axes[:, 2])
    xx = jnp.sum(right * right, axis=-1) + dilation
    yy = jnp.sum(below * below, axis=-1) + dilation
    xy = jnp.sum(right * below, axis=-1)
    determinant = xx * yy - xy * xy
    undilated = jnp.maximum(determinant - dilation * (xx + yy - dilation), 0)
    share = jnp.sqrt(jnp.maximum(undilated / determinant, LEAST_SHARE))
    centre = jnp.stack([k[0, 0] * across + k[0, 2], k[1, 1] * down + k[1, 2]], axis=-1)
    return Footprints(centre, jnp.stack([yy, -xy, xx], axis=-1) / determinant[:, None], depth, share)


def colors(gaussians: Gaussians, eye: Float[AnyArray, "3"]) -> Float[Array, "splats 3"]:
    """sRGB of the splats as seen from a place; not below 0."""
    harmonics = jnp.asarray(gaussians.harmonics)
    seen = basis(normalize(jnp.asarray(gaussians.position) - eye[None]), degree_of(harmonics.shape[1]))
    return jnp.maximum(0.5 + jnp.einsum("nk,nkc->nc", seen, harmonics, precision="highest"), 0)


def lists(foot: Footprints, opacity: Float[np.ndarray, " splats"], height: int, width: int, most: int = LIST) -> Lists:
    """The front-most splats of each pixel that any touches, in lists as long as is needed, a power of two; NumPy."""
    centre, conic, depth, share = (np.asarray(x, np.float32) for x in foot)
    opacity = share * opacity
    touching = (depth > NEAREST) & (opacity > LEAST_ALPHA)
    order = np.flatnonzero(touching)
    order = order[np.argsort(depth[order], kind="stable")]
    centre, conic, opacity = centre[order], conic[order], np.asarray(opacity, np.float32)[order]
    reach = 2 * np.log(opacity / LEAST_ALPHA)  # squared distance, in standard deviations, where it no longer touches
    determinant = conic[:, 0] * conic[:, 2] - conic[:, 1] ** 2
    extent = np.sqrt(reach[:, None] * conic[:, [2, 0]] / determinant[:, None])
    extent = np.minimum(extent, WIDEST)
    low = np.clip(np.ceil(centre - extent - 0.5), 0, [width, height]).astype(np.int32)
    high = np.clip(np.floor(centre + extent - 0.5) + 1, low, [width, height]).astype(np.int32)
    across, down = (high - low).T
    count = across * down
    rank = np.repeat(np.arange(len(order), dtype=np.int32), count)
    place = np.arange(len(rank), dtype=np.int32) - np.repeat((np.cumsum(count) - count).astype(np.int32), count)
    row, column = np.divmod(place, across[rank])
    column, row = column + low[rank, 0], row + low[rank, 1]
    dx, dy = column + np.float32(0.5) - centre[rank, 0], row + np.float32(0.5) - centre[rank, 1]
    a, b, c = (conic[:, i][rank] for i in range(3))
    inside = a * dx * dx + 2 * b * dx * dy + c * dy * dy < reach[rank]
    key = np.sort((row[inside].astype(np.int64) * width + column[inside]) << 32 | rank[inside])
    pixel, rank = key >> 32, key & (2**32 - 1)
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    slot = np.cumsum(np.diff(pixel, prepend=-1) > 0) - 1
    depth_rank = np.arange(len(pixel)) - first[slot]
    length = min(most, 1 << int(depth_rank.max(initial=0)).bit_length())
    kept = depth_rank < length
    table = np.full((length, len(first)), len(depth), np.int32)
    table[depth_rank[kept], slot[kept]] = order[rank[kept]]
    return Lists(table, pixel[first].astype(np.int32))


def padded(found: Lists, pixels: int, nothing: int) -> Lists:
    """The lists of so many pixels: those added are pixel 0 and hold no splat, whose number is `nothing`."""
    extra = pixels - len(found.pixel)
    splats = np.pad(found.splats, ((0, 0), (0, extra)), constant_values=nothing)
    return Lists(splats, np.pad(found.pixel, (0, extra)))


def blend(
    foot: Footprints,
    color: Float[AnyArray, "splats 3"],
    opacity: Float[AnyArray, " splats"],
    found: Lists,
    width: int,
) -> Float[Array, "pixels 4"]:
    """Colour, weighted by the opacity, and opacity of each listed pixel."""
    rows = jnp.concatenate([foot.centre, foot.conic, (foot.share * opacity)[:, None], color], axis=-1)
    rows = jnp.concatenate([rows, jnp.zeros((1, rows.shape[1]))])  # no splat
    x, y, a, b, c, strength, *shown = jnp.moveaxis(gather_rows(rows, jnp.asarray(found.splats)), -1, 0)
    row, column = jnp.divmod(jnp.asarray(found.pixel), width)
    dx, dy = column[None] + 0.5 - x, row[None] + 0.5 - y
    alpha = strength * jnp.exp(-0.5 * jnp.maximum(a * dx * dx + 2 * b * dx * dy + c * dy * dy, 0))
    alpha = jnp.where(alpha >= LEAST_ALPHA, jnp.minimum(alpha, MOST_ALPHA), 0)
    passed = jnp.cumsum(jnp.log1p(-alpha), axis=0)
    weight = alpha * jnp.exp(jnp.concatenate([jnp.zeros_like(passed[:1]), passed[:-1]]))
    return jnp.stack([*(jnp.sum(weight * x, axis=0) for x in shown), jnp.sum(weight, axis=0)], axis=-1)


@jax.jit
def looked(gaussians: Gaussians, camera: Camera, dilation: Float[Array, ""]) -> tuple[Footprints, Array]:
    """Footprints and colours of splats as a camera sees them, compiled whole."""
    return footprints(gaussians, camera, dilation), colors(gaussians, camera.cam_to_world[:, 3])


_blend = jax.jit(blend, static_argnames="width")


def draw(
    gaussians: Gaussians, camera: Camera, dilation: float | int = DILATION, background: float | int = 1.0
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]:
    """Picture (sRGB) and opacity of the splats from a camera (unbatched), in the units and axes of their positions."""
    height, width = camera.height, camera.width
    foot, color = looked(gaussians, camera, jnp.float32(dilation))
    opacity = np.asarray(gaussians.opacity)
    found = lists(foot, opacity, height, width)
    sums, depth = np.zeros((height * width, 4), np.float32), len(found.splats)
    for first in range(0, len(found.pixel), TOGETHER // depth):
        some = Lists(*(x[..., first : first + TOGETHER // depth] for x in found))
        number = len(some.pixel)
        wide = padded(some, min(size_above(number), TOGETHER // depth), len(opacity))
        sums[some.pixel] = np.asarray(_blend(foot, color, jnp.asarray(opacity), wide, width))[:number]
    whole = sums.reshape(height, width, 4)
    return whole[..., :3] + (1 - whole[..., 3:]) * np.float32(background), whole[..., 3]


def size_above(count: int, least: int = 2**12) -> int:
    """A power of the root of two that holds a count: few sizes, few compilations."""
    return int(2 ** (np.ceil(2 * np.log2(max(count, least))) / 2)) + 1


def every(camera: Camera, stride: int, column: int, row: int) -> Camera:
    """The camera whose pixels are every `stride`-th one, from a column and a row on, of another's picture."""
    k = np.array(camera.intrinsics, np.float32)
    k[:2] /= stride
    k[0, 2] += 0.5 - (column + 0.5) / stride
    k[1, 2] += 0.5 - (row + 0.5) / stride
    height, width = ((n - first - 1) // stride + 1 for n, first in ((camera.height, row), (camera.width, column)))
    return Camera(cam_to_world=np.asarray(camera.cam_to_world), intrinsics=k, height=height, width=width)
