"""Entries of discs blended to a G-buffer: order-independent among entries of about the same depth.

    optical depth  of an entry: CENTRE_TAU k^2 f, for its kernel k and its facing f (0.02 for a back face)
    group          of a pixel's LIST_LENGTH front-most entries, those less than a spacing apart in depth blend and do
                   not occlude each other; from two spacings on, the front entry occludes the one behind
    blend weight   of an entry in its pixel: the weights of a group add up to 1 - exp(-optical depth), times the
                   transmittance before it; over all groups they add up to the opacity
    color weight   those of a group have the same sum, but narrower kernels divide it

A *slot* is a covered pixel.  Lists are arrays (list, slots): the entries of each slot, front to back.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spnr_jax.kernels import numerics
from spnr_jax.kernels.cameras import compute_ray_slopes
from spnr_jax.kernels.numerics import clamp, larger, one_minus_exp, safe_sqrt, smaller, smoothstep
from spnr_jax.kernels.records import Camera, GBuffer, Surfels
from spnr_jax.surfels.splatting import Entries, Footprints

CENTRE_TAU = 3.0  # optical depth at the centre of a disc
LIST_LENGTH = 24  # largest number of entries of a pixel
BLOCK = 2048  # slots blended at a time: their lists stay in the cache of a core
COMPARED = 8  # entries on each side in the list that are compared in depth; those farther in front occlude
THIN_TAU = 0.03  # optical depth of a group below which the slope of its mean transmittance is a series
LEAST_OPACITY = 1e-4  # least summed blend weight that means are divided by
SHARP_POWER = 4  # power of the kernel, times which an optical depth is narrow
LEAST_WEIGHT = 1e-12  # sum of narrow weights of a pixel below which it has no colour
LEAST_SUM = 1e-34  # of a group that its entries are divided by: float32 holds the inverse
FADE = 1e-4  # sum of narrow weights below which the distances of the centres fade to 0


def blend(
    entries: Entries,
    foot: Footprints,
    surfels: Surfels,
    attributes: Float[Array, "points features"],
    camera: Camera,
    *,
    slots: int,
) -> GBuffer:
    """The G-buffer from the entries of a picture, for its first `slots` covered pixels (`count_covered_pixels`).

    The normals of the surfels face the camera (`shader.face_camera`), those of their footprints outward.
    """
    table, pixel_of = _build_lists(entries, slots, camera.height * camera.width)
    normal = jnp.stack(numerics.rotate_columns(camera.cam_to_world[:, :3], surfels.normal), axis=-1)
    wide = jnp.concatenate([attributes, normal, jnp.log(surfels.spacing)[:, None]], axis=1)
    narrow = jnp.concatenate([_gather_colors(surfels), jnp.stack([foot.column, foot.row], axis=-1)], axis=1)
    wide, narrow = jax.lax.optimization_barrier((wide, narrow))

    def blend_block(block: Int[Array, "rows block"]) -> GBuffer:
        return _blend_lists(entries, surfels, block[:-1], block[-1], wide, narrow, camera)

    blocks = numerics.split_blocks(jnp.concatenate([table, pixel_of[None]]), min(BLOCK, slots), -1)
    of_blocks = jax.lax.map(blend_block, blocks)
    of_slots = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:slots], of_blocks)
    return _place_in_picture(of_slots, pixel_of, camera)


def _blend_lists(
    entries: Entries,
    surfels: Surfels,
    table: Int[Array, "list slots"],
    pixel_of: Int[Array, " slots"],
    wide: Float[Array, "points features"],
    narrow: Float[Array, "points 12"],
    camera: Camera,
) -> GBuffer:
    """The G-buffer of slots, from their lists; `wide` and `narrow` are what is averaged with either weights."""
    point, depth, coverage, blend_weight, color_weight, sharp_weight = _weigh_entries(entries, table, surfels)
    opacity = jnp.sum(blend_weight, axis=0)
    divisor = larger(opacity, LEAST_OPACITY)
    inverse = 1 / divisor
    means = _sum_rows(blend_weight, point, wide) * inverse[:, None]
    features = means.shape[1] - 4
    attributes, normal, log_spacing = jnp.split(means, (features, features + 3), axis=1)
    mean_depth = depth[0] + jnp.sum(blend_weight * (depth - depth[:1]), axis=0) / divisor  # faint: of the front entry
    squared = jnp.sum(blend_weight * (depth - mean_depth[None]) ** 2, axis=0)  # about the mean: else all digits cancel
    sharp, colored = (jnp.sum(x, axis=0) for x in (sharp_weight, color_weight))
    has_color = sharp > LEAST_WEIGHT
    inverse_color = jnp.where(has_color, 1 / jnp.where(has_color, colored, 1), 0)
    ahead = jnp.sum(color_weight * depth, axis=0) * inverse_color
    pixel = jnp.stack([pixel_of % camera.width, pixel_of // camera.width], axis=-1).astype(depth.dtype) + 0.5
    color, centre = _sum_colors(color_weight, sharp_weight, point, narrow, pixel, ahead, camera)
    return GBuffer(
        opacity=smaller(opacity, 1),
        coverage=coverage,
        depth=mean_depth,
        depth_deviation=safe_sqrt(squared * inverse),
        log_spacing=log_spacing[:, 0],
        normal=normal,
        color=color * inverse_color[:, None],
        attributes=attributes,
        sharp_weight=sharp,
        centre_offset=(centre - sharp[:, None] * pixel) / (sharp + FADE)[:, None],
    )


def _weigh_entries(
    entries: Entries, table: Int[Array, "list slots"], surfels: Surfels
) -> tuple[Int[Array, "list slots"], Array, Float[Array, " slots"], Array, Array, Array]:
    """Disc, depth, coverage of each slot, blend weight, color weight, and blend weight times the narrower kernel."""
    listed = table >= 0
    table = jnp.maximum(table, 0)
    point = jax.lax.optimization_barrier(entries.point[table])
    kernel, facing = jnp.where(listed, entries.kernel[table], 0), entries.facing[table]
    weight, narrowing = kernel**2 * facing, kernel**SHARP_POWER * facing
    known = weight, narrowing, entries.depth[table], jnp.asarray(surfels.spacing)[point]
    weight, narrowing, depth, spacing = jax.lax.optimization_barrier(known)
    tau = CENTRE_TAU * weight
    blend_weight, color_weight, transmittance = compute_blend_weights(tau, tau * narrowing, depth, spacing)
    shares = jax.lax.optimization_barrier((blend_weight, color_weight, blend_weight * narrowing))
    return point, depth, jnp.sum(weight * transmittance, axis=0), *shares


def _place_in_picture(of_slots: GBuffer, pixel_of: Int[Array, " slots"], camera: Camera) -> GBuffer:
    """The picture's G-buffer, 0 where no slot is: whole rows are gathered, which is fast on a CPU."""
    leaves, structure = jax.tree.flatten(of_slots)
    slots = len(pixel_of)
    rows = jnp.concatenate([x.reshape(slots, -1) for x in leaves], axis=1)
    rows = jax.lax.optimization_barrier(jnp.pad(rows, ((0, 1), (0, 0))))
    slot_of = jnp.full(camera.height * camera.width, slots, jnp.int32)
    slot_of = slot_of.at[pixel_of].set(jnp.arange(slots, dtype=jnp.int32), mode="drop")
    ends = np.cumsum([x.size // slots for x in leaves])
    columns = jnp.split(rows[slot_of], ends[:-1], axis=1)
    shaped = [y.reshape(camera.height, camera.width, *x.shape[1:]) for x, y in zip(leaves, columns, strict=True)]
    return jax.tree.unflatten(structure, shaped)


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
    color_weight: Float[Array, "list slots"],
    sharp_weight: Float[Array, "list slots"],
    point: Int[Array, "list slots"],
    rows: Float[Array, "points 12"],
    pixel: Float[Array, "slots 2"],
    ahead: Float[Array, " slots"],
    camera: Camera,
) -> tuple[Float[Array, "slots 3"], Float[Array, "slots 2"]]:
    """Weighted sums of the discs' colours where the ray meets the surface, and of the discs' centres.

    Rows: the 10 columns of `_gather_colors`, then column and row of the disc's centre in pixels, as `pixel` has them
    of the slot.  A color edge is antialiased over one pixel.
    """
    right, up = (ahead * slope for slope in compute_ray_slopes(camera.intrinsics, *pixel.T))
    pose, width = camera.cam_to_world, larger(ahead, 1e-6) / camera.intrinsics[0, 0]
    where = [pose[i, 0] * right + pose[i, 1] * up - pose[i, 2] * ahead + pose[i, 3] for i in range(3)]

    def add(sums: Array, at: tuple[Array, Array, Array]) -> tuple[Array, None]:
        color, across, border, jump, centre = jnp.split(rows[at[2]], (3, 6, 7, 10), axis=1)
        beyond = sum(across[:, i] * where[i] for i in range(3)) - border[:, 0]
        color += clamp(0.5 + beyond / width, 0, 1)[:, None] * jump
        return sums + jnp.concatenate([at[0][:, None] * color, at[1][:, None] * centre], axis=1), None

    empty, places = jnp.zeros((point.shape[1], 5), rows.dtype), (color_weight, sharp_weight, point)
    color, centre = jnp.split(jax.lax.scan(add, empty, places, unroll=8)[0], (3,), axis=1)
    return color, centre


def _build_lists(entries: Entries, slots: int, pixels: int) -> tuple[Int[Array, "list slots"], Int[Array, " slots"]]:
    """Indices of the entries of each slot, -1 where there are fewer, and the pixel of each slot."""
    live = (entries.pixel < pixels) & (entries.rank < LIST_LENGTH) & (entries.slot < slots)
    cell = jnp.where(live, entries.rank * slots + entries.slot, LIST_LENGTH * slots)
    table = jnp.full(LIST_LENGTH * slots, -1, jnp.int32).at[cell].set(entries.order, mode="drop", unique_indices=True)
    cell = jnp.where(live & (entries.rank == 0), entries.slot, slots)
    pixel_of = jnp.full(slots, pixels, jnp.int32).at[cell].set(entries.pixel, mode="drop", unique_indices=True)
    return table.reshape(LIST_LENGTH, slots), pixel_of


def _blend_weights(
    tau: Float[Array, "list slots"],
    narrow: Float[Array, "list slots"],
    depth: Float[Array, "list slots"],
    spacing: Float[Array, "list slots"],
) -> tuple[Float[Array, "list slots"], Float[Array, "list slots"], Float[Array, "list slots"]]:
    """Blend weight, color weight and transmittance in front of each entry, for lists sorted by depth.

    A group of optical depth t has the opacity 1 - exp(-t), divided among its entries by their optical depths (blend
    weights), and by their narrow ones (color weights).
    """
    tau_before, tau_group, narrow_group = _sum_groups(tau, narrow, depth, spacing)
    transmittance = jnp.exp(-tau_before)
    # by roots, because XLA would compute the sums anew at each use of a quotient
    per_tau, per_narrow = (jax.lax.rsqrt(larger(x, LEAST_SUM)) ** 2 for x in (tau_group, narrow_group))
    visible = transmittance * one_minus_exp(1 / per_tau)
    return tau * per_tau * visible, narrow * per_narrow * visible, transmittance


def _pull_back_blend_weights(
    primals: tuple[Array, Array, Array, Array], cotangents: tuple[Array, Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Gradients by tau, narrow, depth and spacing; `by_x` is the gradient by x.

    With o_ij = 1 for entries of one group, falling to 0 for separate ones, and m(t) = (1 - exp(-t)) / t, the weights
    are

        T_i = exp(-sum_{j in front} (1 - o_ij) tau_j),    a_i = tau_i T_i m(t_i),    c_i = n_i T_i (1 - exp(-t_i)) / N_i

    with the sums t_i = tau_i + sum_j o_ij tau_j and N_i = n_i + sum_j o_ij n_j of a group.  Each pair of entries
    contributes to both of its members.  The gradient that JAX derives takes twenty times as long as the weights.
    """
    tau, narrow, depth, spacing = primals
    by_weight, by_color, by_transmittance = cotangents
    tau_before, tau_group, narrow_group = _sum_groups(*primals)
    transmittance, (mean, slope) = jnp.exp(-tau_before), _mean_transmittance(tau_group)
    inverse = 1 / larger(narrow_group, LEAST_SUM)
    share, by_share = narrow * inverse, by_color * (transmittance * one_minus_exp(tau_group))
    by_group = transmittance * (by_weight * (tau * slope) + by_color * (share * jnp.exp(-tau_group)))
    by_before = -transmittance * (by_transmittance + by_weight * (tau * mean)) - by_share * share
    by_sum = by_share * jnp.where(narrow_group > LEAST_SUM, -share * inverse, 0)
    by_narrow = by_share * inverse + by_sum
    by_tau = by_weight * (transmittance * mean) + by_group
    by_tau += jnp.matmul(_far_in_front(tau).T, by_before, precision="highest")
    by_depth = by_spacing = jnp.zeros_like(tau)
    slopes = by_group, by_before, by_sum
    by_group, by_before, by_sum = map(jax.lax.optimization_barrier, slopes)  # one would be linear in all
    for step, (other_tau, other_narrow, *places, other_by_group, other_by_before, other_by_sum) in _shift_lists(
        (*primals, by_group, by_before, by_sum), (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    ):
        gap, middle = _measure_gap(step, depth, spacing, *places)
        x = clamp(gap - 1, 0, 1)
        apart, slope = x * x * (3 - 2 * x), 6 * x * (1 - x)
        by_tau += other_by_group * (1 - apart) + (other_by_before * apart if step > 0 else 0)
        by_narrow += other_by_sum * (1 - apart)
        through = tau * other_by_before if step > 0 else other_tau * by_before  # the front entry occludes the other
        within = other_tau * by_group + tau * other_by_group + other_narrow * by_sum + narrow * other_by_sum
        by_gap = slope * (through - within)
        by_depth += by_gap / middle if step < 0 else -by_gap / middle
        by_spacing -= 0.5 * by_gap * gap / middle
    return by_tau, by_narrow, by_depth, by_spacing


compute_blend_weights = jax.checkpoint(numerics.with_gradient(_blend_weights, _pull_back_blend_weights))


def _sum_groups(tau: Array, narrow: Array, depth: Array, spacing: Array) -> tuple[Array, Array, Array]:
    """Optical depth in front of each entry's group, that of the group, and the sum of its narrow ones."""
    tau_before, tau_group = jnp.matmul(_far_in_front(tau), tau, precision="highest"), tau
    narrow_group = narrow
    for step, (other_tau, other_narrow, *places) in _shift_lists((tau, narrow, depth, spacing), (0.0, 0.0, 0.0, 1.0)):
        apart = smoothstep(_measure_gap(step, depth, spacing, *places)[0] - 1)
        tau_group += other_tau * (1 - apart)
        narrow_group += other_narrow * (1 - apart)
        if step < 0:
            tau_before += other_tau * apart
    return tau_before, tau_group, narrow_group


def _far_in_front(lists: Array) -> Array:
    """1 where the column's entry is so far in front of the row's entry in the list that it occludes it untested."""
    return jnp.tril(jnp.ones((len(lists), len(lists)), lists.dtype), -COMPARED - 1)


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
    return (depth - other_depth if step < 0 else other_depth - depth) / middle, middle


def _mean_transmittance(tau: Array) -> tuple[Array, Array]:
    """(1 - exp(-tau)) / tau of a group, and its derivative: a series for small tau, where all digits would cancel."""
    thick = larger(tau, LEAST_SUM)
    mean = one_minus_exp(thick) / thick
    slope = jnp.where(
        tau < THIN_TAU, -1 / 2 + tau * (1 / 3 - tau * (1 / 8 - tau / 30)), (jnp.exp(-thick) - mean) / thick
    )
    return mean, slope
