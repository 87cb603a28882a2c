"""G-buffer of surfels: their discs blended layer by layer, without order artefacts.

Each covered pixel has the list of its LIST front-most entries (`projection.py`):

    layers      entries less than a spacing apart in depth blend and do not hide each other; from two spacings on, the
                front entry hides the one behind
    share       blend weight of an entry in its pixel: the shares of a layer add up to 1 - exp(-optical depth), times
                the transmittance of the layers before it; over all layers they add up to the opacity
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spnr_jax.kernels.numerics import clamp, columns, larger, one_minus_exp, root, smaller, with_gradient
from spnr_jax.kernels.records import Camera, GBuffer, Surfels
from spnr_jax.surfels.projection import Entries, footprints, rotate_columns, smoothstep

OPACITY = 3.0  # optical depth at the middle of a disc
LIST = 24  # entries of a pixel at most
NEAR = 8  # places in the list before and after an entry that are compared in depth; those farther in front hide it
THIN = 0.03  # optical depth of a layer below which its transmittance is a series
LEAST_SHARE = 1e-4  # of the entries of a pixel together, that means are divided by
SHARP = 4  # power of the kernel by which colours are blended more narrowly than everything else
TOLD = 1e-12  # summed narrow weights from which on they say something; float32 holds the square
FAR = 1e-4  # summed narrow weights that the centres' distances pass to 0 at


def blend(
    found: Entries, surfels: Surfels, attributes: Float[Array, "points features"], camera: Camera, *, slots: int
) -> GBuffer:
    """The G-buffer from the entries of a picture, of its first `slots` covered pixels (`count_covered_pixels`)."""
    height, width = camera.height, camera.width
    table, pixel_of = _lists(found, slots, height * width)
    listed = table >= 0
    table = jnp.maximum(table, 0)
    point = jax.lax.optimization_barrier(found.point[table])
    kernel = jnp.where(listed, found.kernel[table], 0)
    weight = kernel**2 * found.facing[table]
    depth, spacing = found.depth[table], jnp.asarray(surfels.spacing)[point]
    weight, depth, spacing = jax.lax.optimization_barrier((weight, depth, spacing))
    share, left = shares(OPACITY * weight, depth, spacing)
    sharp = share * kernel**SHARP * found.facing[table]
    share, sharp = jax.lax.optimization_barrier((share, sharp))
    rotation = camera.cam_to_world[:, :3]
    normal = jnp.stack(rotate_columns(rotation, surfels.normal), axis=-1)
    wide = jnp.concatenate([attributes, normal, jnp.log(surfels.spacing)[:, None]], axis=1)
    foot = footprints(surfels, camera)
    narrow = jnp.concatenate([_colors(surfels), jnp.stack([foot.column, foot.row], axis=-1)], axis=1)
    wide, narrow = jax.lax.optimization_barrier((wide, narrow))
    sums = [_sum_rows(share, point, wide)]
    drawn, deep = jnp.sum(share, axis=0), jnp.sum(share * depth, axis=0)
    mean = deep / larger(drawn, LEAST_SHARE)
    squared = jnp.sum(share * (depth - mean[None]) ** 2, axis=0)  # about the mean: of squares no digit would be left
    sums += [x[:, None] for x in (drawn, jnp.sum(weight * left, axis=0), mean, squared)]
    total, deep = (jnp.sum(x, axis=0) for x in (sharp, sharp * depth))
    ahead = deep / jnp.where(total > TOLD, total, 1)
    sums += [_sum_colors(sharp, point, narrow, pixel_of, ahead, camera), total[:, None]]
    slot = jnp.arange(slots, dtype=jnp.int32)
    slot_of = jnp.full(height * width, slots, jnp.int32).at[pixel_of].set(slot, mode="drop")
    of_slot = jax.lax.optimization_barrier(jnp.pad(jnp.concatenate(sums, axis=1), ((0, 1), (0, 0))))
    of_pixel = of_slot[slot_of].reshape(height, width, -1)
    return _gather(columns(of_pixel), attributes.shape[1], camera)


def count_covered_pixels(found: Entries) -> Int[Array, ""]:
    """Number of pixels that hold an entry."""
    return found.slot[-1] + 1


def _sum_rows(
    weights: Float[Array, "list slots"], point: Int[Array, "list slots"], rows: Float[Array, "points features"]
) -> Float[Array, "slots features"]:
    """Weighted sums over each list, whole rows at a time: ten times as fast on a CPU as column by column."""
    empty = jnp.zeros((point.shape[1], rows.shape[1]), rows.dtype)
    places = (weights, point)
    return jax.lax.scan(lambda sums, at: (sums + at[0][:, None] * rows[at[1]], None), empty, places, unroll=8)[0]


def _colors(surfels: Surfels) -> Float[Array, "points 10"]:
    """Of each disc: its colour, the plane of its border, the jump there."""
    border = surfels.border[:, 3] + jnp.sum(surfels.border[:, :3] * surfels.position, axis=-1)
    parts = surfels.base_color, surfels.border[:, :3], border[:, None], surfels.jump
    return jnp.concatenate(parts, axis=1)


def _sum_colors(
    sharp: Float[Array, "list slots"],
    point: Int[Array, "list slots"],
    rows: Float[Array, "points 12"],
    pixel_of: Int[Array, " slots"],
    ahead: Float[Array, " slots"],
    camera: Camera,
) -> Float[Array, "slots 5"]:
    """Weighted sums of the colours that discs (`_colors`) have where the ray meets the surface, and of their centres.

    A border is a pixel wide.
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

    return jax.lax.scan(add, jnp.zeros((point.shape[1], 5), rows.dtype), (sharp, point), unroll=8)[0]


def _lists(found: Entries, slots: int, pixels: int) -> tuple[Int[Array, "list slots"], Int[Array, " slots"]]:
    """Numbers of the entries of each slot, -1 where there are fewer, and the pixel of each slot."""
    live = (found.pixel < pixels) & (found.rank < LIST) & (found.slot < slots)
    place = jnp.where(live, found.rank * slots + found.slot, LIST * slots)
    table = jnp.full(LIST * slots, -1, jnp.int32).at[place].set(found.order, mode="drop", unique_indices=True)
    place = jnp.where(live & (found.rank == 0), found.slot, slots)
    pixel_of = jnp.full(slots, pixels, jnp.int32).at[place].set(found.pixel, mode="drop", unique_indices=True)
    return table.reshape(LIST, slots), pixel_of


@jax.checkpoint
def shares(
    tau: Float[Array, "list slots"], depth: Float[Array, "list slots"], spacing: Float[Array, "list slots"]
) -> tuple[Float[Array, "list slots"], Float[Array, "list slots"]]:
    """Share of each entry in its pixel, and the transmittance before it, of lists sorted by depth.

    A layer of optical depth t has 1 - exp(-t), divided among its entries by theirs.
    """
    return _shares(tau, depth, spacing)


def _plain_shares(tau: Array, depth: Array, spacing: Array) -> tuple[Array, Array]:
    hidden, band = _optical_depths(tau, depth, spacing)
    left = jnp.exp(-hidden)
    return tau * left * _mean_transmittance(band)[0], left


def _pull_back_shares(
    primals: tuple[Array, Array, Array], cotangents: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Gradients by tau, depth and spacing from those by share and transmittance; every pair is seen from both ends.

    That of the plain shares, as JAX derives it, takes twenty times as long as they do.
    """
    tau, depth, spacing = primals
    by_share, by_left = cotangents
    hidden, band = _optical_depths(*primals)
    left, (mean, slope) = jnp.exp(-hidden), _mean_transmittance(band)
    by_band = by_share * (tau * left * slope)
    by_hidden = -left * (by_left + by_share * (tau * mean))
    by_tau = by_share * (left * mean) + by_band + jnp.matmul(_far(len(tau)).T, by_hidden, precision="highest")
    by_depth = by_spacing = jnp.zeros_like(tau)
    by_band, by_hidden = map(jax.lax.optimization_barrier, (by_band, by_hidden))  # one would be linear in all of these
    known = tau, depth, spacing, by_band, by_hidden
    for step, (other_tau, *places, other_band, other_hidden) in _neighbours(known, (0.0, 0.0, 1.0, 0.0, 0.0)):
        gap, middle = _gap(step, depth, spacing, *places)
        x = clamp(gap - 1, 0, 1)
        apart, slope = x * x * (3 - 2 * x), 6 * x * (1 - x)
        by_tau += other_band * (1 - apart) + (other_hidden * apart if step > 0 else 0)
        through = tau * other_hidden if step > 0 else other_tau * by_hidden  # what is in front hides what is behind
        by_gap = slope * (through - other_tau * by_band - tau * other_band)
        by_depth += np.sign(-step) * by_gap / middle
        by_spacing -= 0.5 * by_gap * gap / middle
    return by_tau, by_depth, by_spacing


_shares = with_gradient(_plain_shares, _pull_back_shares)


def _optical_depths(tau: Array, depth: Array, spacing: Array) -> tuple[Array, Array]:
    """Optical depth before each entry's layer, and that of the layer."""
    hidden, band = jnp.matmul(_far(len(tau)).astype(tau.dtype), tau, precision="highest"), tau
    for step, (other_tau, *places) in _neighbours((tau, depth, spacing), (0.0, 0.0, 1.0)):
        apart = smoothstep(_gap(step, depth, spacing, *places)[0] - 1)
        band += other_tau * (1 - apart)
        if step < 0:
            hidden += other_tau * apart
    return hidden, band


def _far(length: int) -> Array:
    """1 where the column's entry stands too far before the row's in a list to be compared with it, and hides it."""
    return jnp.tril(jnp.ones((length, length)), -NEAR - 1)


def _neighbours(
    lists: tuple[Array, ...], beyond: tuple[float, ...]
) -> Iterator[tuple[int, list[Float[Array, "list slots"]]]]:
    """The lists of the entries so many places before and behind each, for all places that are compared."""
    padded = [
        jax.lax.optimization_barrier(jnp.pad(x, ((NEAR, NEAR), (0, 0)), constant_values=c))
        for x, c in zip(lists, beyond, strict=True)
    ]
    for step in [*range(-NEAR, 0), *range(1, NEAR + 1)]:
        yield step, [x[NEAR + step : NEAR + step + len(lists[0])] for x in padded]


def _gap(step: int, depth: Array, spacing: Array, other_depth: Array, other_spacing: Array) -> tuple[Array, Array]:
    """How far one of two entries lies behind the other in spacings, and the spacing between theirs."""
    middle = 0.5 * (spacing + other_spacing)
    return np.sign(-step) * (depth - other_depth) / middle, middle


def _mean_transmittance(tau: Array) -> tuple[Array, Array]:
    """(1 - exp(-tau)) / tau, of a layer, and its derivative; by a series where no digit would be left."""
    thin = tau < THIN
    thick = jnp.where(thin, 1, tau)
    mean = jnp.where(thin, 1 - tau * (1 / 2 - tau * (1 / 6 - tau / 24)), one_minus_exp(thick) / thick)
    slope = jnp.where(thin, -1 / 2 + tau * (1 / 3 - tau * (1 / 8 - tau / 30)), (jnp.exp(-thick) - mean) / thick)
    return mean, slope


def _gather(sums: list[Array], features: int, camera: Camera) -> GBuffer:
    """Means from the sums of `blend`."""
    wide, rest, narrow = sums[: features + 4], sums[features + 4 : features + 8], sums[features + 8 :]
    share, coverage, depth, squared = rest
    inverse = 1 / larger(share, LEAST_SHARE)
    *wide, log_spacing = (x * inverse for x in wide)
    *color, column, row, sharp = narrow
    told = sharp > TOLD
    inverse_sharp = jnp.where(told, 1 / jnp.where(told, sharp, 1), 0)
    middles = (jnp.arange(camera.width) + 0.5)[None], (jnp.arange(camera.height) + 0.5)[:, None]
    beside = (column, middles[0]), (row, middles[1])
    return GBuffer(
        opacity=smaller(share, 1),
        coverage=coverage,
        depth=depth,
        spread=root(squared * inverse),
        log_spacing=log_spacing,
        normal=jnp.stack(wide[features:], axis=-1),
        color=jnp.stack([c * inverse_sharp for c in color], axis=-1),
        attributes=jnp.stack(wide[:features], axis=-1),
        centres=sharp,
        beside=jnp.stack([(total - sharp * pixels) / (sharp + FAR) for total, pixels in beside], axis=-1),
    )
