"""Surfels splatted to a picture: the pixels that discs cover, as a list sorted by pixel and depth.

    entry         a pair of a disc and a pixel that it covers (gsplat: intersection); entries are counted, made, and
                  sorted by pixel and depth
    kernel        k = clip(max(c - r^2, RIM_SKIRT (1 - r^2), 1 - p^2), 0, 1): r is the distance from the disc's centre
                  in its plane, over RADIUS spacings; c falls from 1 to 0 at the disc's rims; p is the distance from the
                  projected centre, over MIN_RADIUS pixels (low-pass filter of EWA splatting, Zwicker et al. 2001)

Kernels fall to 0 at the rim of a disc, so a picture is continuous in the camera and in the points.  The pixels that a
disc covers, and the order of the entries, are integers without a gradient.  Sizes are static; entries that do not fit
are counted.  `blending` makes a G-buffer of the entries.
"""

from collections.abc import Sequence
from functools import reduce
from itertools import product
from operator import mul
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from spnr_jax.kernels.cameras import compute_ray_slopes
from spnr_jax.kernels.numerics import (
    clamp,
    cross,
    dot,
    larger,
    rotate_columns,
    safe_sqrt,
    smaller,
    smoothstep,
    split_columns,
)
from spnr_jax.kernels.records import AnyArray, Camera, Surfels

RADIUS = 1.6  # of a disc, in spacings
MIN_RADIUS = 1.0  # smallest radius of a disc in the picture, in pixels
RIM_WIDTH = 0.4  # spacings over which a disc fades out at the end of its layer
RIM_SKIRT = 0.15  # share of the kernel kept beyond the end of a layer, from which the network can correct that end
LEAST_COSINE = 0.02  # least cosine between ray and normal: smaller ones are replaced by it
FACING_RAMP = -0.1, 0.2  # cosines between ray and normal from which, and to which, a one-sided disc fades in
NEAR_PLANE = 0.05  # near plane: least distance from the camera at which discs are drawn
DEPTH_BITS, ENTRY_BITS = 19, 24  # at most, of the 64 bits of a sort key; the bits above hold the pixel
PIXEL_BITS = 64 - DEPTH_BITS - ENTRY_BITS  # if the depth has all its bits
MOST_ENTRIES = 2**ENTRY_BITS
MOST_COUNTED = 2**30  # largest count: sums of int32 overflow beyond twice that


class Footprints(NamedTuple):
    """Projection of each disc: camera coordinates, size, and its bounding rectangle of pixels.

    `rim_axes` are rim_tangent and normal x rim_tangent, `rim_distances` the extents along + and - of each, in spacings;
    `facing` in [0, 1] fades back faces; `column` and `row` are the projected centre in pixels, floats; `left`, `top`
    and `width` describe the rectangle, which covers `covered` pixels.
    """

    centre: tuple[Array, Array, Array]
    normal: tuple[Array, Array, Array]
    rim_axes: tuple[Sequence[Array], Float[Array, "3 points"]]
    rim_distances: Sequence[Array]
    radius: Float[Array, " points"]
    facing: Float[Array, " points"]
    column: Float[Array, " points"]
    row: Float[Array, " points"]
    left: Int[Array, " points"]
    top: Int[Array, " points"]
    width: Int[Array, " points"]
    covered: Int[Array, " points"]


class Entries(NamedTuple):
    """Pairs of disc and pixel: `point`, `kernel`, `depth` and `facing` by disc; the other fields by pixel and depth.

    The i-th entry by pixel and depth is number order[i] by disc; it lies in a pixel, which is the slot-th covered one,
    and has a rank in the list of its slot.
    """

    point: Int[Array, " entries"]
    kernel: Float[Array, " entries"]
    depth: Float[Array, " entries"]
    facing: Float[Array, " entries"]
    order: Int[Array, " entries"]
    pixel: Int[Array, " entries"]
    slot: Int[Array, " entries"]
    rank: Int[Array, " entries"]


def project_discs(surfels: Surfels, camera: Camera) -> Footprints:
    """Discs projected to a camera; those behind it or outside the picture cover no pixel.

    One-sided discs that are seen from behind are drawn with a facing of 0.02 (`CONSTANTS.back_weight`), which is
    better than a hole.
    """
    rotation, eye = camera.cam_to_world[:, :3], camera.cam_to_world[:, 3]
    rotated = (rotate_columns(rotation, x) for x in (surfels.position, eye[None]))
    x, y, z = (there - here for there, here in zip(*rotated, strict=True))
    normal, rim = (rotate_columns(rotation, x) for x in (surfels.normal, surfels.rim_tangent))
    cosine = -dot(normal, (x, y, z)) / larger(safe_sqrt(dot((x, y, z), (x, y, z))), NEAR_PLANE)
    begin, end = FACING_RAMP
    facing = 1 - jnp.asarray(surfels.one_sided) * (1 - smoothstep((cosine - begin) / (end - begin)))
    ahead = larger(-z, NEAR_PLANE)
    column = camera.intrinsics[0, 0] * x / ahead + camera.intrinsics[0, 2]
    row = -camera.intrinsics[1, 1] * y / ahead + camera.intrinsics[1, 2]
    radius = RADIUS * jnp.asarray(surfels.spacing)
    known = jax.lax.stop_gradient((camera.intrinsics, (x, y, z), normal, radius, (column, row)))
    left, top, width, height = _rectangles(*known, (camera.width, camera.height))
    drawn = surfels.mask & (facing > 0) & (-z > NEAR_PLANE)
    return Footprints(
        centre=(x, y, z),
        normal=normal,
        rim_axes=(rim, cross(normal, rim)),
        rim_distances=split_columns(jnp.asarray(surfels.rim_distances)),
        radius=radius,
        facing=facing,
        column=column,
        row=row,
        left=left,
        top=top,
        width=jnp.maximum(width, 1),
        covered=jnp.where(drawn, width * height, 0),
    )


def _rectangles(
    intrinsics: Float[AnyArray, "3 3"],
    centre: tuple[Array, Array, Array],
    normal: tuple[Array, Array, Array],
    radius: Float[Array, " points"],
    place: tuple[Array, Array],
    size: tuple[int, int],
) -> tuple[Array, Array, Array, Array]:
    """First column and row, width and height of each disc's bounding rectangle in the picture; width 0 outside it."""
    x, y, z = centre
    ahead = jnp.maximum(-z, NEAR_PLANE)
    nearest = jnp.maximum(ahead - radius * jnp.sqrt(jnp.clip(1 - normal[2] ** 2, 0, 1)), NEAR_PLANE)  # of the disc
    sides = []
    for middle, focal, aside, along, most in (
        (place[0], intrinsics[0, 0], x / ahead, normal[0], size[0]),
        (place[1], intrinsics[1, 1], y / ahead, normal[1], size[1]),
    ):
        # a point of the disc at (dx, dz) from its centre projects focal * (dx + aside * dz) / (ahead - dz) beside it
        extent = jnp.sqrt(jnp.maximum(1 + aside**2 - (along + aside * normal[2]) ** 2, 0))
        half = jnp.maximum(focal * radius * extent / nearest, MIN_RADIUS)
        first = jnp.clip(jnp.ceil(middle - half - 0.5), 0, most)
        sides.append((first, jnp.maximum(jnp.clip(jnp.floor(middle + half - 0.5) + 1, 0, most) - first, 0)))
    (left, width), (top, height) = ([x.astype(jnp.int32) for x in side] for side in sides)
    return left, top, width, height


def move_to_window(foot: Footprints, corner: Int[Array, "2"], width: int, height: int) -> Footprints:
    """The footprints in a window of the picture, whose corner is (column, row): rectangles are clipped to it."""
    rows = foot.covered // foot.width
    left, right = (jnp.clip(x - corner[0], 0, width) for x in (foot.left, foot.left + foot.width))
    top, bottom = (jnp.clip(x - corner[1], 0, height) for x in (foot.top, foot.top + rows))
    return foot._replace(
        column=foot.column - corner[0].astype(foot.column.dtype),
        row=foot.row - corner[1].astype(foot.row.dtype),
        left=left,
        top=top,
        width=jnp.maximum(right - left, 1),
        covered=(right - left) * (bottom - top),
    )


def count_entries(covered: Int[Array, " points"]) -> Int[Array, ""]:
    """Sum of the pixels that discs cover, at most MOST_COUNTED."""
    return jnp.minimum(jnp.sum(covered.astype(jnp.float32)), MOST_COUNTED).astype(jnp.int32)


def bound_covered_pixels(foot: Footprints, camera: Camera) -> Int[Array, ""]:
    """Number of pixels in the union of the discs' rectangles."""
    rows, columns = camera.height + 1, camera.width + 1
    across = (foot.left, 1), (foot.left + foot.width, -1)
    down = (foot.top, 1), (foot.top + foot.covered // foot.width, -1)
    count = jnp.zeros(rows * columns, jnp.int32)
    for (row, one), (column, other) in product(down, across):
        count = count.at[row * columns + column].add(jnp.where(foot.covered > 0, one * other, 0), mode="drop")
    inside = jnp.cumsum(jnp.cumsum(count.reshape(rows, columns), axis=0), axis=1)
    return jnp.sum(inside > 0, dtype=jnp.int32)


def make_entries(foot: Footprints, camera: Camera, *, capacity: int) -> tuple[Entries, Int[Array, ""]]:
    """The sorted entries of a picture, padded to `capacity`, and the number of those that did not fit.

    Discs that do not fit are left out as a whole, the last surfels first.
    """
    end = jnp.cumsum(foot.covered.astype(jnp.float32))  # exact up to 2**24, and does not overflow as int32 would
    covered = jnp.where(end <= capacity, foot.covered, 0)
    lost = count_entries(jnp.where(end <= capacity, 0, foot.covered))
    end = jnp.cumsum(covered)
    point = jnp.repeat(jnp.arange(len(covered), dtype=jnp.int32), covered, total_repeat_length=capacity)
    # gather whole columns once instead of at every use: twenty times faster on a CPU
    foot, begin, point = jax.lax.optimization_barrier((foot, end - covered, point))
    index = jnp.arange(capacity, dtype=jnp.int32)
    inside, width = index - begin[point], foot.width[point]
    row = inside // width
    row, column = foot.top[point] + row, foot.left[point] + inside - row * width
    kernel, depth = evaluate_kernels(foot, point, row, column, camera.intrinsics)
    pixels = camera.height * camera.width
    pixel = jnp.where((index < end[-1]) & (kernel > 0), row * camera.width + column, pixels)
    order, pixel = _sort_entries(pixel, jax.lax.stop_gradient(depth), index, max(PIXEL_BITS, pixels.bit_length()))
    first = jnp.concatenate([jnp.ones(1, bool), pixel[1:] != pixel[:-1]]) & (pixel < pixels)
    slot = jnp.cumsum(first.astype(jnp.int32)) - 1
    rank = index - jax.lax.cummax(jnp.where(first, index, 0))
    return Entries(point, kernel, depth, foot.facing[point], order, pixel, slot, rank), lost


def evaluate_kernels(
    foot: Footprints,
    point: Int[Array, " entries"],
    row: Int[Array, " entries"],
    column: Int[Array, " entries"],
    intrinsics: Float[AnyArray, "3 3"],
) -> tuple[Float[Array, " entries"], Float[Array, " entries"]]:
    """Kernel of each disc at a pixel, and the depth at which the ray through the pixel's centre meets its plane.

    The depth differs from that of the disc's centre by at most its radius.
    """
    gathered = (
        [x[point] for x in columns] for columns in (foot.centre, foot.normal, *foot.rim_axes, foot.rim_distances)
    )
    (x, y, z), (nx, ny, nz), rim, side, rim_distances = gathered
    radius = foot.radius[point]
    column_centre, row_centre = (x.astype(radius.dtype) + 0.5 for x in (column, row))
    right, up = compute_ray_slopes(intrinsics, column_centre, row_centre)
    slope = nx * right + ny * up - nz
    slope = jnp.where(slope < 0, smaller(slope, -LEAST_COSINE), larger(slope, LEAST_COSINE))
    ray_depth = (nx * x + ny * y + nz * z) / slope
    ahead = ray_depth > 0  # else the eye is between the disc's plane and the ray, as where it is close to a floor
    ray_depth = clamp(ray_depth, -z - 2 * radius, -z + 2 * radius)
    offset = [RADIUS / radius * x for x in (ray_depth * right - x, ray_depth * up - y, -ray_depth - z)]  # in spacings
    in_plane = dot(offset, offset) / RADIUS**2
    along, across = dot(offset, rim), dot(offset, side)
    ends = [r - x for r, x in zip(rim_distances, (along, -along, across, -across), strict=True)]
    cut = reduce(mul, (clamp(0.5 + end / RIM_WIDTH, 0, 1) for end in ends))
    beside = (column_centre - foot.column[point]) ** 2 + (row_centre - foot.row[point]) ** 2
    on_picture = beside / MIN_RADIUS**2
    cut = jnp.where(ahead, larger(cut - in_plane, RIM_SKIRT * (1 - in_plane)), 0)
    return clamp(larger(cut, 1 - on_picture), 0, 1), clamp(ray_depth, -z - radius, -z + radius)


def _sort_entries(
    pixel: Int[Array, " entries"], depth: Float[Array, " entries"], index: Int[Array, " entries"], pixel_bits: int
) -> tuple[Int[Array, " entries"], Int[Array, " entries"]]:
    """Order and pixels of the entries by pixel and depth: one 64-bit key sorts nine times faster than three arrays."""
    low, high = jnp.min(depth), jnp.max(depth)
    depth_bits = 64 - ENTRY_BITS - pixel_bits
    steps = 2**depth_bits - 1
    with jax.enable_x64(True):
        level = (steps * (depth - low) / jnp.maximum(high - low, 1e-6)).astype(jnp.uint64)
        key = pixel.astype(jnp.uint64) << (depth_bits + ENTRY_BITS) | level << ENTRY_BITS | index.astype(jnp.uint64)
        key = jax.lax.sort(key)
        return (key & (2**ENTRY_BITS - 1)).astype(jnp.int32), (key >> (depth_bits + ENTRY_BITS)).astype(jnp.int32)
