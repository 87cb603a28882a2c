"""Surfels splatted to a G-buffer: the pixels that discs cover, and their order-independent blending by groups.

    entry         a pair of a disc and a pixel that it covers (gsplat: intersection); entries are counted, made, and
                  sorted by pixel and depth
    kernel        k = clip(max(c - r^2, RIM_SKIRT (1 - r^2), 1 - p^2), 0, 1): r is the distance from the disc's centre
                  in its plane, over RADIUS spacings; c falls from 1 to 0 at the disc's rims; p is the distance from the
                  projected centre, over MIN_RADIUS pixels (low-pass filter of EWA splatting, Zwicker et al. 2001).  An
                  entry whose facing is f (0 for a hidden back face) has the optical depth CENTRE_TAU k^2 f
    groups        of a pixel's LIST_LENGTH front-most entries, those less than a spacing apart in depth blend and do not
                  occlude each other; from two spacings on, the front entry occludes the one behind
    blend weight  of an entry in its pixel: the weights of a group add up to 1 - exp(-optical depth), times the
                  transmittance before it; over all groups they add up to the opacity

Kernels fall to 0 at the rim of a disc, so a picture is continuous in the camera and in the points.  The pixels that a
disc covers, and the order of the entries, are integers without a gradient.  Sizes are static; entries that do not fit
are counted.
"""

from collections.abc import Iterator
from functools import reduce
from itertools import product
from operator import mul
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spnr_jax.kernels import numerics
from spnr_jax.kernels.numerics import (
    clamp,
    cross,
    dot,
    larger,
    one_minus_exp,
    safe_sqrt,
    smaller,
    smoothstep,
    split_columns,
)
from spnr_jax.kernels.records import AnyArray, Camera, GBuffer, Surfels

# --- entries ----------------------------------------------------------------------------------------------------------


RADIUS = 1.6  # of a disc, in spacings
MIN_RADIUS = 1.0  # smallest radius of a disc in the picture, in pixels
RIM_WIDTH = 0.4  # spacings over which a disc fades out at the end of its layer
RIM_SKIRT = 0.15  # share of the kernel kept beyond the end of a layer, from which the network can correct that end
LEAST_COSINE = 0.02  # least cosine between ray and normal: smaller ones are replaced by it
NEAR_PLANE = 0.05  # near plane: least distance from the camera at which discs are drawn
DEPTH_BITS, ENTRY_BITS = 19, 24  # at most, of the 64 bits of a sort key; the bits above hold the pixel
PIXEL_BITS = 64 - DEPTH_BITS - ENTRY_BITS  # if the depth has all its bits
MOST_ENTRIES = 2**ENTRY_BITS
MOST_COUNTED = 2**30  # largest count: sums of int32 overflow beyond twice that


class Footprints(NamedTuple):
    """Projection of each disc: camera coordinates, size, and its bounding rectangle of pixels.

    `facing` in [0, 1] fades back faces; `column` and `row` are the projected centre in pixels, floats; `left`, `top`
    and `width` describe the rectangle, which covers `covered` pixels.
    """

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
    """Discs projected to a camera; back faces and discs behind the camera or outside the picture cover no pixel."""
    rotation, eye = camera.cam_to_world[:, :3], camera.cam_to_world[:, 3]
    x, y, z = (
        a - b
        for a, b in zip(
            numerics.rotate_columns(rotation, surfels.position),
            numerics.rotate_columns(rotation, eye[None]),
            strict=True,
        )
    )
    normal = numerics.rotate_columns(rotation, surfels.normal)
    cosine = -dot(normal, (x, y, z)) / larger(safe_sqrt(dot((x, y, z), (x, y, z))), NEAR_PLANE)
    facing = 1 - jnp.asarray(surfels.one_sided) * (1 - smoothstep((cosine + 0.1) / 0.3))
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


def count_entries(covered: Int[Array, " points"]) -> Int[Array, ""]:
    """Sum of the pixels that discs cover, at most MOST_COUNTED."""
    return jnp.minimum(jnp.sum(covered.astype(jnp.float32)), MOST_COUNTED).astype(jnp.int32)


def bound_covered_pixels(foot: Footprints, most: tuple[int, int]) -> Int[Array, ""]:
    """Number of pixels in the union of the discs' rectangles; `most` bounds the rows and columns of the picture."""
    rows, columns = (n + 1 for n in most)
    across = (foot.left, 1), (foot.left + foot.width, -1)
    down = (foot.top, 1), (foot.top + foot.covered // foot.width, -1)
    count = jnp.zeros(rows * columns, jnp.int32)
    for (row, one), (column, other) in product(down, across):
        count = count.at[row * columns + column].add(jnp.where(foot.covered > 0, one * other, 0), mode="drop")
    inside = jnp.cumsum(jnp.cumsum(count.reshape(rows, columns), axis=0), axis=1)
    return jnp.sum(inside > 0, dtype=jnp.int32)


def make_entries(surfels: Surfels, camera: Camera, *, capacity: int) -> tuple[Entries, Int[Array, ""]]:
    """The sorted entries of a picture, padded to `capacity`, and the number of those that did not fit.

    Discs that do not fit are left out as a whole, the last surfels first.
    """
    foot = project_discs(surfels, camera)
    end = jnp.cumsum(foot.covered.astype(jnp.float32))  # exact up to 2**24, and does not overflow as int32 would
    covered = jnp.where(end <= capacity, foot.covered, 0)
    lost = count_entries(jnp.where(end <= capacity, 0, foot.covered))
    end = jnp.cumsum(covered)
    point = jnp.repeat(jnp.arange(len(covered), dtype=jnp.int32), covered, total_repeat_length=capacity)
    # gather whole columns once instead of at every use: twenty times faster on a CPU
    rotation = camera.cam_to_world[:, :3]
    rim = numerics.rotate_columns(rotation, surfels.rim_tangent)
    side = cross(foot.normal, rim)
    far = tuple(split_columns(jnp.asarray(surfels.rim_distances)))
    foot, begin, point, rim, side, far = jax.lax.optimization_barrier((foot, end - covered, point, rim, side, far))
    x, y, z, nx, ny, nz = (column[point] for column in (*foot.centre, *foot.normal))
    radius = foot.radius[point]
    index = jnp.arange(capacity, dtype=jnp.int32)
    inside, width = index - begin[point], foot.width[point]
    row = inside // width
    column = foot.left[point] + inside - row * width
    row = foot.top[point] + row
    right = (column + 0.5 - camera.intrinsics[0, 2]) / camera.intrinsics[0, 0]
    up = -(row + 0.5 - camera.intrinsics[1, 2]) / camera.intrinsics[1, 1]
    slope = nx * right + ny * up - nz
    slope = jnp.where(slope < 0, smaller(slope, -LEAST_COSINE), larger(slope, LEAST_COSINE))
    ray_depth = (nx * x + ny * y + nz * z) / slope
    ahead = ray_depth > 0  # else the eye is between the disc's plane and the ray, as where it is close to a floor
    ray_depth = clamp(ray_depth, -z - 2 * radius, -z + 2 * radius)
    there = [RADIUS / radius * x for x in (ray_depth * right - x, ray_depth * up - y, -ray_depth - z)]  # in spacings
    in_plane = dot(there, there) / RADIUS**2
    along, across = dot(there, [c[point] for c in rim]), dot(there, [c[point] for c in side])
    ends = [r[point] - x for r, x in zip(far, (along, -along, across, -across), strict=True)]
    cut = reduce(mul, (clamp(0.5 + end / RIM_WIDTH, 0, 1) for end in ends))
    on_picture = ((column + 0.5 - foot.column[point]) ** 2 + (row + 0.5 - foot.row[point]) ** 2) / MIN_RADIUS**2
    cut = jnp.where(ahead, larger(cut - in_plane, RIM_SKIRT * (1 - in_plane)), 0)
    kernel = clamp(larger(cut, 1 - on_picture), 0, 1)
    depth = clamp(ray_depth, -z - radius, -z + radius)
    pixels = camera.height * camera.width
    pixel = jnp.where((index < end[-1]) & (kernel > 0), row * camera.width + column, pixels)
    order, pixel = _sort_entries(pixel, jax.lax.stop_gradient(depth), index, max(PIXEL_BITS, pixels.bit_length()))
    first = jnp.concatenate([jnp.ones(1, bool), pixel[1:] != pixel[:-1]]) & (pixel < pixels)
    slot = jnp.cumsum(first.astype(jnp.int32)) - 1
    rank = index - jax.lax.cummax(jnp.where(first, index, 0))
    return Entries(point, kernel, depth, foot.facing[point], order, pixel, slot, rank), lost


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


# --- blending ---------------------------------------------------------------------------------------------------------


CENTRE_TAU = 3.0  # optical depth at the centre of a disc
LIST_LENGTH = 24  # largest number of entries of a pixel
COMPARED = 8  # entries on each side in the list that are compared in depth; those farther in front occlude
THIN_TAU = 0.03  # optical depth of a group below which its mean transmittance is a series
LEAST_OPACITY = 1e-4  # least summed blend weight that means are divided by
SHARP_POWER = 4  # power of the kernel for the narrower weights that colours are blended with
LEAST_WEIGHT = 1e-12  # summed narrow weights below which there is no colour; float32 holds the square
FADE = 1e-4  # summed narrow weights below which the distances of the centres fade to 0


def blend(
    entries: Entries, surfels: Surfels, attributes: Float[Array, "points features"], camera: Camera, *, slots: int
) -> GBuffer:
    """The G-buffer from the entries of a picture, for its first `slots` covered pixels (`count_covered_pixels`)."""
    height, width = camera.height, camera.width
    table, pixel_of = _build_lists(entries, slots, height * width)
    listed = table >= 0
    table = jnp.maximum(table, 0)
    point = jax.lax.optimization_barrier(entries.point[table])
    kernel = jnp.where(listed, entries.kernel[table], 0)
    weight = kernel**2 * entries.facing[table]
    depth, spacing = entries.depth[table], jnp.asarray(surfels.spacing)[point]
    weight, depth, spacing = jax.lax.optimization_barrier((weight, depth, spacing))
    blend_weight, transmittance = compute_blend_weights(CENTRE_TAU * weight, depth, spacing)
    sharp_weight = blend_weight * kernel**SHARP_POWER * entries.facing[table]
    blend_weight, sharp_weight = jax.lax.optimization_barrier((blend_weight, sharp_weight))
    rotation = camera.cam_to_world[:, :3]
    normal = jnp.stack(numerics.rotate_columns(rotation, surfels.normal), axis=-1)
    wide = jnp.concatenate([attributes, normal, jnp.log(surfels.spacing)[:, None]], axis=1)
    foot = project_discs(surfels, camera)
    narrow = jnp.concatenate([_gather_colors(surfels), jnp.stack([foot.column, foot.row], axis=-1)], axis=1)
    wide, narrow = jax.lax.optimization_barrier((wide, narrow))
    sums = [_sum_rows(blend_weight, point, wide)]
    drawn, deep = jnp.sum(blend_weight, axis=0), jnp.sum(blend_weight * depth, axis=0)
    mean = deep / larger(drawn, LEAST_OPACITY)
    squared = jnp.sum(blend_weight * (depth - mean[None]) ** 2, axis=0)  # about the mean: squares would lose all digits
    sums += [x[:, None] for x in (drawn, jnp.sum(weight * transmittance, axis=0), mean, squared)]
    total, deep = (jnp.sum(x, axis=0) for x in (sharp_weight, sharp_weight * depth))
    ahead = deep / jnp.where(total > LEAST_WEIGHT, total, 1)
    sums += [_sum_colors(sharp_weight, point, narrow, pixel_of, ahead, camera), total[:, None]]
    slot = jnp.arange(slots, dtype=jnp.int32)
    slot_of = jnp.full(height * width, slots, jnp.int32).at[pixel_of].set(slot, mode="drop")
    of_slot = jax.lax.optimization_barrier(jnp.pad(jnp.concatenate(sums, axis=1), ((0, 1), (0, 0))))
    of_pixel = of_slot[slot_of].reshape(height, width, -1)
    return _normalise_sums(split_columns(of_pixel), attributes.shape[1], camera)


def count_covered_pixels(entries: Entries) -> Int[Array, ""]:
    """Number of pixels that hold an entry."""
    return entries.slot[-1] + 1


def _sum_rows(
    weights: Float[Array, "list slots"], point: Int[Array, "list slots"], rows: Float[Array, "points features"]
) -> Float[Array, "slots features"]:
    """Weighted sums over each list, whole rows at a time: ten times as fast on a CPU as column by column."""
    empty = jnp.zeros((point.shape[1], rows.shape[1]), rows.dtype)
    places = (weights, point)
    return jax.lax.scan(lambda sums, at: (sums + at[0][:, None] * rows[at[1]], None), empty, places, unroll=8)[0]


def _gather_colors(surfels: Surfels) -> Float[Array, "points 10"]:
    """For each disc: its colour, the line of its color edge, and the change of colour across it."""
    border = surfels.color_edge[:, 3] + jnp.sum(surfels.color_edge[:, :3] * surfels.position, axis=-1)
    parts = surfels.base_color, surfels.color_edge[:, :3], border[:, None], surfels.color_jump
    return jnp.concatenate(parts, axis=1)


def _sum_colors(
    sharp_weight: Float[Array, "list slots"],
    point: Int[Array, "list slots"],
    rows: Float[Array, "points 12"],
    pixel_of: Int[Array, " slots"],
    ahead: Float[Array, " slots"],
    camera: Camera,
) -> Float[Array, "slots 5"]:
    """Weighted sums of the discs' colours where the ray meets the surface, and of the discs' centres.

    Rows: the 10 columns of `_gather_colors`, then column and row of the disc's centre in pixels.  A color edge is
    antialiased over one pixel.
    """
    right = ahead * ((pixel_of % camera.width + 0.5 - camera.intrinsics[0, 2]) / camera.intrinsics[0, 0])
    up = ahead * -((pixel_of // camera.width + 0.5 - camera.intrinsics[1, 2]) / camera.intrinsics[1, 1])
    pose, pixel = camera.cam_to_world, larger(ahead, 1e-6) / camera.intrinsics[0, 0]
    where = [pose[i, 0] * right + pose[i, 1] * up - pose[i, 2] * ahead + pose[i, 3] for i in range(3)]

    def add(sums: Array, at: tuple[Array, Array]) -> tuple[Array, None]:
        color, across, border, jump, centre = jnp.split(rows[at[1]], (3, 6, 7, 10), axis=1)
        beyond = sum(across[:, i] * where[i] for i in range(3)) - border[:, 0]
        color += clamp(0.5 + beyond / pixel, 0, 1)[:, None] * jump
        return sums + at[0][:, None] * jnp.concatenate([color, centre], axis=1), None

    return jax.lax.scan(add, jnp.zeros((point.shape[1], 5), rows.dtype), (sharp_weight, point), unroll=8)[0]


def _build_lists(entries: Entries, slots: int, pixels: int) -> tuple[Int[Array, "list slots"], Int[Array, " slots"]]:
    """Indices of the entries of each slot, -1 where there are fewer, and the pixel of each slot."""
    live = (entries.pixel < pixels) & (entries.rank < LIST_LENGTH) & (entries.slot < slots)
    cell = jnp.where(live, entries.rank * slots + entries.slot, LIST_LENGTH * slots)
    table = jnp.full(LIST_LENGTH * slots, -1, jnp.int32).at[cell].set(entries.order, mode="drop", unique_indices=True)
    cell = jnp.where(live & (entries.rank == 0), entries.slot, slots)
    pixel_of = jnp.full(slots, pixels, jnp.int32).at[cell].set(entries.pixel, mode="drop", unique_indices=True)
    return table.reshape(LIST_LENGTH, slots), pixel_of


def _blend_weights(
    tau: Float[Array, "list slots"], depth: Float[Array, "list slots"], spacing: Float[Array, "list slots"]
) -> tuple[Float[Array, "list slots"], Float[Array, "list slots"]]:
    """Blend weight of each entry, and the transmittance in front of it, for lists sorted by depth.

    A group of optical depth t has the opacity 1 - exp(-t), divided among its entries by their optical depths.
    """
    tau_before, tau_group = _optical_depths(tau, depth, spacing)
    transmittance = jnp.exp(-tau_before)
    return tau * transmittance * _mean_transmittance(tau_group)[0], transmittance


def _pull_back_blend_weights(
    primals: tuple[Array, Array, Array], cotangents: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Gradients by tau, depth and spacing; `by_x` is the gradient by x.

    With o_ij = 1 for entries of one group, falling to 0 for separate ones, and m(t) = (1 - exp(-t)) / t, the weights
    are

        T_i = exp(-sum_{j in front} (1 - o_ij) tau_j),    a_i = tau_i T_i m(tau_i + sum_j o_ij tau_j).

    Each pair of entries contributes to both of its members.  The gradient that JAX derives takes twenty times as long
    as the weights.
    """
    tau, depth, spacing = primals
    by_weight, by_transmittance = cotangents
    tau_before, tau_group = _optical_depths(*primals)
    transmittance, (mean, slope) = jnp.exp(-tau_before), _mean_transmittance(tau_group)
    by_group = by_weight * (tau * transmittance * slope)
    by_before = -transmittance * (by_transmittance + by_weight * (tau * mean))
    by_tau = by_weight * (transmittance * mean) + by_group
    by_tau += jnp.matmul(_far_in_front(len(tau)).T, by_before, precision="highest")
    by_depth = by_spacing = jnp.zeros_like(tau)
    by_group, by_before = map(jax.lax.optimization_barrier, (by_group, by_before))  # one would be linear in all
    known = tau, depth, spacing, by_group, by_before
    for step, (other_tau, *places, other_by_group, other_by_before) in _shift_lists(known, (0.0, 0.0, 1.0, 0.0, 0.0)):
        gap, middle = _measure_gap(step, depth, spacing, *places)
        x = clamp(gap - 1, 0, 1)
        apart, slope = x * x * (3 - 2 * x), 6 * x * (1 - x)
        by_tau += other_by_group * (1 - apart) + (other_by_before * apart if step > 0 else 0)
        through = tau * other_by_before if step > 0 else other_tau * by_before  # the front entry occludes the other
        by_gap = slope * (through - other_tau * by_group - tau * other_by_group)
        by_depth += np.sign(-step) * by_gap / middle
        by_spacing -= 0.5 * by_gap * gap / middle
    return by_tau, by_depth, by_spacing


compute_blend_weights = jax.checkpoint(numerics.with_gradient(_blend_weights, _pull_back_blend_weights))


def _optical_depths(tau: Array, depth: Array, spacing: Array) -> tuple[Array, Array]:
    """Optical depth in front of each entry's group, and that of the group."""
    tau_before, tau_group = jnp.matmul(_far_in_front(len(tau)).astype(tau.dtype), tau, precision="highest"), tau
    for step, (other_tau, *places) in _shift_lists((tau, depth, spacing), (0.0, 0.0, 1.0)):
        apart = smoothstep(_measure_gap(step, depth, spacing, *places)[0] - 1)
        tau_group += other_tau * (1 - apart)
        if step < 0:
            tau_before += other_tau * apart
    return tau_before, tau_group


def _far_in_front(length: int) -> Array:
    """1 where the column's entry is so far in front of the row's entry in the list that it occludes it untested."""
    return jnp.tril(jnp.ones((length, length)), -COMPARED - 1)


def _shift_lists(
    lists: tuple[Array, ...], beyond: tuple[float, ...]
) -> Iterator[tuple[int, list[Float[Array, "list slots"]]]]:
    """The lists shifted by each of the compared distances, forwards and backwards."""
    padded = [
        jax.lax.optimization_barrier(jnp.pad(x, ((COMPARED, COMPARED), (0, 0)), constant_values=c))
        for x, c in zip(lists, beyond, strict=True)
    ]
    for step in [*range(-COMPARED, 0), *range(1, COMPARED + 1)]:
        yield step, [x[COMPARED + step : COMPARED + step + len(lists[0])] for x in padded]


def _measure_gap(
    step: int, depth: Array, spacing: Array, other_depth: Array, other_spacing: Array
) -> tuple[Array, Array]:
    """Distance in depth between two entries in spacings, and the mean of their spacings."""
    middle = 0.5 * (spacing + other_spacing)
    return np.sign(-step) * (depth - other_depth) / middle, middle


def _mean_transmittance(tau: Array) -> tuple[Array, Array]:
    """(1 - exp(-tau)) / tau of a group, and its derivative; a series for small tau, where all digits would cancel."""
    thin = tau < THIN_TAU
    thick = jnp.where(thin, 1, tau)
    mean = jnp.where(thin, 1 - tau * (1 / 2 - tau * (1 / 6 - tau / 24)), one_minus_exp(thick) / thick)
    slope = jnp.where(thin, -1 / 2 + tau * (1 / 3 - tau * (1 / 8 - tau / 30)), (jnp.exp(-thick) - mean) / thick)
    return mean, slope


def _normalise_sums(sums: list[Array], features: int, camera: Camera) -> GBuffer:
    """Normalises the sums of `blend` to means."""
    wide, rest, narrow = sums[: features + 4], sums[features + 4 : features + 8], sums[features + 8 :]
    blend_weight, coverage, depth, squared = rest
    inverse = 1 / larger(blend_weight, LEAST_OPACITY)
    *wide, log_spacing = (x * inverse for x in wide)
    *color, column, row, sharp = narrow
    has_color = sharp > LEAST_WEIGHT
    inverse_sharp = jnp.where(has_color, 1 / jnp.where(has_color, sharp, 1), 0)
    middles = (jnp.arange(camera.width) + 0.5)[None], (jnp.arange(camera.height) + 0.5)[:, None]
    offsets = (column, middles[0]), (row, middles[1])
    return GBuffer(
        opacity=smaller(blend_weight, 1),
        coverage=coverage,
        depth=depth,
        depth_deviation=safe_sqrt(squared * inverse),
        log_spacing=log_spacing,
        normal=jnp.stack(wide[features:], axis=-1),
        color=jnp.stack([c * inverse_sharp for c in color], axis=-1),
        attributes=jnp.stack(wide[:features], axis=-1),
        sharp_weight=sharp,
        centre_offset=jnp.stack([(total - sharp * pixels) / (sharp + FADE) for total, pixels in offsets], axis=-1),
    )
