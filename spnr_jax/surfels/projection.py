"""Discs projected into a picture: which pixels each covers, and the entries that are blended there.

An entry is a pair of a disc and a pixel that it covers.  Entries are counted, made, and sorted by pixel and depth;
their weight is the square of a kernel:

    kernel      1 - r^2, r the distance from the disc's centre in its plane over RADIUS spacings; a disc viewed edge-on,
                or smaller than a pixel, is as wide as FLOOR pixels (the low-pass filter of EWA splatting, Zwicker et
                al. 2001)

Weights fall to 0 at the rim of a disc, so a picture is continuous in the camera and in the points.  The pixels that a
disc covers, and the order of the entries, are integers without a gradient.  Sizes are static; entries that do not fit
are counted.
"""

from collections.abc import Sequence
from functools import reduce
from itertools import product
from operator import add, mul
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from spnr_jax.kernels.numerics import clamp, columns, larger, root, smaller
from spnr_jax.kernels.records import AnyArray, Camera, Surfels

RADIUS = 1.6  # of a disc, in spacings
FLOOR = 1.0  # smallest radius on the picture, in pixels
RIM_WIDTH = 0.4  # spacings over which a disc passes to 0 at the end of its layer
SKIRT = 0.15  # of the kernel left beyond the end of a layer: for the network, which may know better where that is
EDGE = 0.02  # cosine between ray and plane below which the plane counts as seen at this angle
NEAREST = 0.05  # distance before the camera from which discs are drawn
DEPTH_BITS, ENTRY_BITS = 19, 24  # of the sorted number of 64, at most; pixels have those above
PIXEL_BITS = 64 - DEPTH_BITS - ENTRY_BITS  # that leave so many to the depth
MOST_ENTRIES = 2**ENTRY_BITS
MOST = 2**30  # that is counted: sums of int32 wrap beyond twice that


class View(NamedTuple):
    """A camera whose picture's size is a number like others, not one that programs are compiled for."""

    cam_to_world: Float[AnyArray, "3 4"]
    intrinsics: Float[AnyArray, "3 3"]
    height: Int[AnyArray, ""]
    width: Int[AnyArray, ""]


class Footprints(NamedTuple):
    """Where each disc lies in the picture: camera coordinates, size, and the rectangle of pixels around it."""

    centre: tuple[Array, Array, Array]
    normal: tuple[Array, Array, Array]
    radius: Float[Array, " points"]
    facing: Float[Array, " points"]
    column: Float[Array, " points"]
    row: Float[Array, " points"]
    left: Int[Array, " points"]
    top: Int[Array, " points"]
    width: Int[Array, " points"]
    covered: Int[Array, " points"]


class Entries(NamedTuple):
    """Pairs of disc and pixel; `order` sorts them by pixel and depth, `pixel`, `slot`, `rank` are sorted already.

    A covered pixel has a slot, an entry its rank in the list of the slot.
    """

    point: Int[Array, " entries"]
    kernel: Float[Array, " entries"]
    depth: Float[Array, " entries"]
    facing: Float[Array, " entries"]
    order: Int[Array, " entries"]
    pixel: Int[Array, " entries"]
    slot: Int[Array, " entries"]
    rank: Int[Array, " entries"]


def smoothstep(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """0 below 0, 1 above 1, a cubic without a kink between."""
    x = clamp(x, 0, 1)
    return x * x * (3 - 2 * x)


def rotate_columns(matrix: Float[AnyArray, "3 3"], vectors: Float[AnyArray, "points 3"]) -> tuple[Array, Array, Array]:
    """Columns of vectors @ matrix."""
    x, y, z = columns(jnp.asarray(vectors))
    one, two, three = (x * matrix[0, i] + y * matrix[1, i] + z * matrix[2, i] for i in range(3))
    return one, two, three


def _cross(a: tuple[Array, Array, Array], b: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return reduce(add, (x * y for x, y in zip(a, b, strict=True)))


def footprints(surfels: Surfels, camera: Camera | View) -> Footprints:
    """Discs before a camera; those turned away, behind it or beside the picture cover no pixel."""
    rotation, eye = camera.cam_to_world[:, :3], camera.cam_to_world[:, 3]
    x, y, z = (
        a - b
        for a, b in zip(rotate_columns(rotation, surfels.position), rotate_columns(rotation, eye[None]), strict=True)
    )
    normal = rotate_columns(rotation, surfels.normal)
    cosine = -(normal[0] * x + normal[1] * y + normal[2] * z) / larger(root(x * x + y * y + z * z), NEAREST)
    facing = 1 - jnp.asarray(surfels.sided) * (1 - smoothstep((cosine + 0.1) / 0.3))
    ahead = larger(-z, NEAREST)
    column = camera.intrinsics[0, 0] * x / ahead + camera.intrinsics[0, 2]
    row = -camera.intrinsics[1, 1] * y / ahead + camera.intrinsics[1, 2]
    radius = RADIUS * jnp.asarray(surfels.spacing)
    known = jax.lax.stop_gradient((camera.intrinsics, (x, y, z), normal, radius, (column, row)))
    left, top, width, height = _rectangles(*known, (camera.width, camera.height))
    drawn = surfels.mask & (facing > 0) & (-z > NEAREST)
    return Footprints(
        centre=(x, y, z),
        normal=normal,
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
    size: tuple[int | AnyArray, int | AnyArray],
) -> tuple[Array, Array, Array, Array]:
    """First column and row, width and height of the pixels around each disc, inside the picture; width 0 beside it."""
    x, y, z = centre
    ahead = jnp.maximum(-z, NEAREST)
    nearest = jnp.maximum(ahead - radius * jnp.sqrt(jnp.clip(1 - normal[2] ** 2, 0, 1)), NEAREST)  # of the disc
    sides = []
    for middle, focal, aside, along, most in (
        (place[0], intrinsics[0, 0], x / ahead, normal[0], size[0]),
        (place[1], intrinsics[1, 1], y / ahead, normal[1], size[1]),
    ):
        # a place of the disc at (dx, dz) from its centre lies focal * (dx + aside * dz) / (ahead - dz) beside it
        extent = jnp.sqrt(jnp.maximum(1 + aside**2 - (along + aside * normal[2]) ** 2, 0))
        half = jnp.maximum(focal * radius * extent / nearest, FLOOR)
        first = jnp.clip(jnp.ceil(middle - half - 0.5), 0, most)
        sides.append((first, jnp.maximum(jnp.clip(jnp.floor(middle + half - 0.5) + 1, 0, most) - first, 0)))
    (left, width), (top, height) = ([x.astype(jnp.int32) for x in side] for side in sides)
    return left, top, width, height


def total(covered: Int[Array, " points"]) -> Int[Array, ""]:
    """Sum of the pixels that discs cover, at most MOST."""
    return jnp.minimum(jnp.sum(covered.astype(jnp.float32)), MOST).astype(jnp.int32)


def count_covered(foot: Footprints, most: tuple[int, int]) -> Int[Array, ""]:
    """Number of the pixels in the rectangles around discs, of a picture of so many rows and columns at most."""
    rows, columns = (n + 1 for n in most)
    across = (foot.left, 1), (foot.left + foot.width, -1)
    down = (foot.top, 1), (foot.top + foot.covered // foot.width, -1)
    count = jnp.zeros(rows * columns, jnp.int32)
    for (row, one), (column, other) in product(down, across):
        count = count.at[row * columns + column].add(jnp.where(foot.covered > 0, one * other, 0), mode="drop")
    inside = jnp.cumsum(jnp.cumsum(count.reshape(rows, columns), axis=0), axis=1)
    return jnp.sum(inside > 0, dtype=jnp.int32)


def entries(surfels: Surfels, camera: Camera, *, room: int) -> tuple[Entries, Int[Array, ""]]:
    """The sorted entries of a picture, `room` of them with the empty ones, and how many did not fit in.

    Discs that do not fit are left out whole, the last ones of the surfels.
    """
    foot = footprints(surfels, camera)
    end = jnp.cumsum(foot.covered.astype(jnp.float32))  # exact up to 2**24, and no int32 that wraps
    covered = jnp.where(end <= room, foot.covered, 0)
    lost = total(jnp.where(end <= room, 0, foot.covered))
    end = jnp.cumsum(covered)
    point = jnp.repeat(jnp.arange(len(covered), dtype=jnp.int32), covered, total_repeat_length=room)
    # whole columns are gathered one by one, and not computed anew at every use: twenty times faster on a CPU
    rotation = camera.cam_to_world[:, :3]
    rim = rotate_columns(rotation, surfels.rim)
    side = _cross(foot.normal, rim)
    reach = tuple(columns(jnp.asarray(surfels.reach)))
    foot, begin, point, rim, side, reach = jax.lax.optimization_barrier((foot, end - covered, point, rim, side, reach))
    x, y, z, nx, ny, nz = (column[point] for column in (*foot.centre, *foot.normal))
    radius = foot.radius[point]
    place = jnp.arange(room, dtype=jnp.int32)
    inside, width = place - begin[point], foot.width[point]
    row = inside // width
    column = foot.left[point] + inside - row * width
    row = foot.top[point] + row
    right = (column + 0.5 - camera.intrinsics[0, 2]) / camera.intrinsics[0, 0]
    up = -(row + 0.5 - camera.intrinsics[1, 2]) / camera.intrinsics[1, 1]
    slope = nx * right + ny * up - nz
    slope = jnp.where(slope < 0, smaller(slope, -EDGE), larger(slope, EDGE))
    met = clamp((nx * x + ny * y + nz * z) / slope, -z - 2 * radius, -z + 2 * radius)
    there = [RADIUS / radius * x for x in (met * right - x, met * up - y, -met - z)]  # in spacings
    in_plane = _dot(there, there) / RADIUS**2
    along, across = _dot(there, [c[point] for c in rim]), _dot(there, [c[point] for c in side])
    ends = [r[point] - x for r, x in zip(reach, (along, -along, across, -across), strict=True)]
    cut = reduce(mul, (clamp(0.5 + end / RIM_WIDTH, 0, 1) for end in ends))
    on_picture = ((column + 0.5 - foot.column[point]) ** 2 + (row + 0.5 - foot.row[point]) ** 2) / FLOOR**2
    cut = larger(cut - in_plane, SKIRT * (1 - in_plane))
    kernel = clamp(larger(cut, 1 - on_picture), 0, 1)
    depth = clamp(met, -z - radius, -z + radius)
    pixels = camera.height * camera.width
    pixel = jnp.where((place < end[-1]) & (kernel > 0), row * camera.width + column, pixels)
    order, pixel = _sort_entries(pixel, jax.lax.stop_gradient(depth), place, max(PIXEL_BITS, pixels.bit_length()))
    first = jnp.concatenate([jnp.ones(1, bool), pixel[1:] != pixel[:-1]]) & (pixel < pixels)
    slot = jnp.cumsum(first.astype(jnp.int32)) - 1
    rank = place - jax.lax.cummax(jnp.where(first, place, 0))
    return Entries(point, kernel, depth, foot.facing[point], order, pixel, slot, rank), lost


def _sort_entries(
    pixel: Int[Array, " entries"], depth: Float[Array, " entries"], place: Int[Array, " entries"], pixel_bits: int
) -> tuple[Int[Array, " entries"], Int[Array, " entries"]]:
    """Places and pixels in the order of pixel and depth: one number of 64 bits sorts nine times faster than three."""
    low, high = jnp.min(depth), jnp.max(depth)
    depth_bits = 64 - ENTRY_BITS - pixel_bits
    steps = 2**depth_bits - 1
    with jax.enable_x64(True):
        level = (steps * (depth - low) / jnp.maximum(high - low, 1e-6)).astype(jnp.uint64)
        key = pixel.astype(jnp.uint64) << (depth_bits + ENTRY_BITS) | level << ENTRY_BITS | place.astype(jnp.uint64)
        key = jax.lax.sort(key)
        return (key & (2**ENTRY_BITS - 1)).astype(jnp.int32), (key >> (depth_bits + ENTRY_BITS)).astype(jnp.int32)
