"""Extent and colors of discs: spacing, rim of the layer, sharp edges, gaps between random points, color edges.

Pure functions of a block of points, which is the last axis.  `membership` (k, block) weighs the neighbors by whether
they lie on the same layer; `uv` (k, 2, block) are the neighbors' coordinates in the tangent plane.  Lengths are in
spacings unless stated otherwise.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.kernels.numerics import (
    clamp,
    dot,
    larger,
    largest,
    normalize_columns,
    safe_sqrt,
    smaller,
    smallest,
    solve,
    sum_first,
    sum_products,
)
from spnr_jax.surfels.constants import CONSTANTS
from spnr_jax.surfels.layers import Neighborhood, project_on

NUM_RIM_DIRECTIONS = 16  # in which the rim of a layer is searched
CHANGE, ROOTS, SPREAD = slice(6, 9), slice(9, 12), 12  # columns of a color edge's sums: moments of the colors
RIM_ANGLES = 2 * np.pi / NUM_RIM_DIRECTIONS * np.arange(NUM_RIM_DIRECTIONS)


def measure_raw_spacing(hood: Neighborhood) -> Float[Array, " block"]:
    """Raw spacing: from the area of the disc that holds 6 neighbors on any layer; in units of the box."""
    count = jnp.minimum(CONSTANTS.raw_neighbors, jnp.sum(hood.real, axis=0) - 1)
    chosen = jnp.arange(len(hood.real), dtype=count.dtype)[:, None] == count[None]
    distance = safe_sqrt(jnp.sum(jnp.where(chosen, hood.squared, 0), axis=0))
    several = count > 0  # a single point represents a tenth of the box
    spacing = larger(jnp.sqrt(jnp.pi / jnp.where(several, count, 1)) * distance, CONSTANTS.least_spacing)
    return jnp.where(several, spacing, CONSTANTS.single_spacing)


def measure_layer_spacing(
    hood: Neighborhood, membership: Float[Array, "k block"], raw: Float[Array, " block"]
) -> Float[Array, " block"]:
    """Spacing from the area of the disc that holds 3 neighbors (by weight) on the same layer; in units of the box."""
    others = len(membership) - 1
    summed = jnp.matmul(jnp.tril(jnp.ones((others, others), membership.dtype)), membership[1:], precision="highest")
    wanted = jnp.minimum(CONSTANTS.disc_weight, jnp.maximum(CONSTANTS.disc_share * summed[-1], 0.5))
    count = jnp.sum(hood.real, axis=0) - 1
    last = jnp.minimum(sum_first((summed < wanted[None]).astype(count.dtype)), jnp.maximum(count - 1, 0))
    chosen = jnp.arange(others, dtype=count.dtype)[:, None] == last[None]
    weight, squared = sum_first(jnp.where(chosen, summed, 0)), sum_first(jnp.where(chosen, hood.squared[1:], 0))
    spacing = jnp.sqrt(jnp.pi / larger(weight, 1)) * safe_sqrt(squared)
    low, high = CONSTANTS.spacing_bounds
    return jnp.where(count > 0, clamp(spacing, low * raw, high * raw), raw)


def smooth_spacing(membership: Float[Array, "k block"], spacings: Float[Array, "k block"]) -> Float[Array, " block"]:
    """Geometric mean of the spacing over the 9 nearest neighbors on the same layer."""
    weight, near = membership[: CONSTANTS.averaged_neighbors], spacings[: CONSTANTS.averaged_neighbors]
    return jnp.exp(sum_first(weight * jnp.log(larger(near, CONSTANTS.least_spacing))) / sum_first(weight))


def average_rows(
    neighbors: Int[Array, "k block"], weight: Float[Array, "k block"], visibility: Float[Array, "all 64"]
) -> Float[Array, "block 64"]:
    """Weighted means of the neighbors' rows of `visibility`."""

    def add(sums: Array, neighbor: tuple[Array, Array]) -> tuple[Array, None]:
        rows = visibility.at[jnp.maximum(neighbor[0], 0)].get(mode="clip")
        return sums + neighbor[1][:, None] * rows, None

    empty = jnp.zeros((weight.shape[1], visibility.shape[1]), weight.dtype)
    return jax.lax.scan(add, empty, (neighbors, weight / larger(sum_first(weight), 1e-9)[None]))[0]


def find_farthest(uv: Float[Array, "k 2 block"]) -> Float[Array, "16 block"]:
    """Distance of the farthest point of the plane in each of 16 directions."""
    turn = jnp.asarray(RIM_ANGLES[: NUM_RIM_DIRECTIONS // 2], uv.dtype)
    one, two = jax.lax.optimization_barrier((uv[:, 0], uv[:, 1]))

    def look(direction: tuple[Array, Array]) -> tuple[Array, Array]:
        ahead = one * direction[0] + two * direction[1]
        return largest(ahead), largest(-ahead)

    return jnp.concatenate(jax.lax.map(look, (jnp.cos(turn), jnp.sin(turn))))


def bridge_gaps(uv: Float[Array, "k 2 block"], membership: Float[Array, "k block"]) -> Float[Array, " block"]:
    """Factor by which a disc is enlarged beside gaps, so that the discs around a gap cover its middle.

    A gap is an empty circle through the point with other points all around it; its center is a vertex of the Voronoi
    diagram in the tangent plane.  The largest empty circle through the point with its center in direction d has the
    curvature k(d) = max_j d . y_j, with the inversions y_j = 2 p_j / |p_j|^2 of the neighbors.  k has a local minimum
    at a Voronoi vertex, and is at most 0 where the layer ends.  The factor is max(1, radius / gap_cover) of the largest
    gap whose radius is below widest_gap.
    """
    half = (uv[:, 0] ** 2 + uv[:, 1] ** 2) / 2
    other = (membership > 0.5) & (half > CONSTANTS.duplicate_distance)
    inverse = jnp.where(other, 1 / jnp.where(other, half, 1), 0)
    curved = find_farthest(uv * inverse[:, None])
    vertex = (curved > 1 / CONSTANTS.widest_gap) & (curved <= jnp.roll(curved, 1, axis=0))
    vertex = vertex & (curved <= jnp.roll(curved, -1, axis=0))
    least = smallest(jnp.where(vertex, curved, 1 / CONSTANTS.gap_cover))
    return larger(1 / (least * CONSTANTS.gap_cover), 1)


class ClipLines(NamedTuple):
    """Distances at which neighbors' planes cut a disc (infinite: no cut), and unit directions in the disc's plane."""

    distance: Float[Array, "k block"]
    across: Float[Array, "k block"]
    up: Float[Array, "k block"]


def find_clip_lines(
    hood: Neighborhood,
    axes: Float[Array, "3 3 block"],
    spacing: Float[Array, " block"],
    one_sided: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    neighbors_one_sided: Float[Array, "k block"],
) -> ClipLines:
    """At a sharp edge, the plane of the other face cuts a disc (clip lines, Zwicker et al. 2004)."""
    across, up, facing = (project_on(normals, axis) for axis in axes)
    flat = safe_sqrt(across**2 + up**2)
    cuts = (
        (facing < CONSTANTS.edge_cosine)
        & (flat > CONSTANTS.edge_sine)
        & (hood.real > 0)
        & (neighbors_one_sided > 0.5)
        & (one_sided > 0.5)[None]
        & (hood.squared < (CONSTANTS.rim_radius * spacing[None]) ** 2)
    )
    inverse = jnp.where(cuts, 1 / jnp.where(cuts, flat, 1), 0)
    line = jnp.sum(normals * hood.offset, axis=1) / spacing[None] * inverse
    distance = jnp.where(cuts & (line > 0), line + CONSTANTS.cut_margin, jnp.inf)
    return ClipLines(*jax.lax.optimization_barrier((distance, across * inverse, up * inverse)))


def find_rims(
    ends: Float[Array, "16 block"],
    clip_lines: ClipLines,
    axes: Float[Array, "3 3 block"],
) -> tuple[Float[Array, "3 block"], Float[Array, "4 block"]]:
    """The direction in which the layer ends first, and the distances of the ends, in the form of `Surfels`.

    A layer ends slightly beyond its last point, or where another face cuts it.  The choice of the neighbor or direction
    that ends it is constant for gradients.
    """
    constant = jax.lax.stop_gradient((clip_lines.distance, ends))
    nearest, soonest = jnp.min(constant[0], axis=0), jnp.argmin(constant[1], axis=0)
    cut = nearest < jnp.min(constant[1], axis=0) + CONSTANTS.rim_margin
    first = (constant[0] <= nearest[None]) & cut[None]
    turn = jnp.asarray(RIM_ANGLES, ends.dtype)
    direction = [
        jnp.where(cut, sum_first(jnp.where(first, components, 0)), of_turn[soonest])
        for components, of_turn in ((clip_lines.across, jnp.cos(turn)), (clip_lines.up, jnp.sin(turn)))
    ]
    right, high = normalize_columns(jnp.stack(direction))

    def find_end(direction: tuple[Array, Array]) -> Array:
        right, high = direction
        faces = clip_lines.across * right[None] + clip_lines.up * high[None] > CONSTANTS.cut_cosine
        line = smallest(jnp.where(faces, clip_lines.distance, jnp.inf))
        angle = jnp.arctan2(*jax.lax.stop_gradient((high, right)))
        step = jnp.round(angle / (2 * jnp.pi) * NUM_RIM_DIRECTIONS).astype(jnp.int32) % NUM_RIM_DIRECTIONS
        end = jnp.take_along_axis(ends, step[None], axis=0)[0]
        return jnp.where(line < jnp.inf, jnp.where(line < jnp.inf, line, 0), end)

    quarters = jnp.stack([right, -right, -high, high]), jnp.stack([high, -high, right, -right])
    return right[None] * axes[0] + high[None] * axes[1], smaller(
        jax.lax.map(find_end, quarters), CONSTANTS.largest_radius
    )


def find_color_edge(
    uv: Float[Array, "k 2 block"],
    membership: Float[Array, "k block"],
    spacing: Float[Array, " block"],
    axes: Float[Array, "3 3 block"],
    colors: Float[Array, "k 3 block"],
) -> tuple[Float[Array, "4 block"], Float[Array, "3 block"]]:
    """The fields `color_edge` and `color_jump` of `Surfels`: a straight edge between two colors, if any.

    With one color per disc, an edge would look frayed at the scale of the spacing.  Edges fade in smoothly.  Which
    neighbors have the other color is constant for gradients.
    """
    squared = uv[:, 0] ** 2 + uv[:, 1] ** 2
    weight = membership * jnp.exp(-0.5 / CONSTANTS.color_edge_sigma**2 * squared)
    weight = jax.lax.optimization_barrier(weight / sum_first(weight)[None])
    roots, change = safe_sqrt(colors), colors - colors[:1]
    roots = roots - roots[:1]
    beyond = _split_colors(weight, jax.lax.stop_gradient(roots))
    plane = jnp.concatenate([jnp.ones_like(uv[:, :1]), uv], axis=1)
    products = jnp.stack([uv[:, 0] ** 2, uv[:, 0] * uv[:, 1], uv[:, 1] ** 2], axis=1)
    groups = jnp.stack([jnp.where(beyond, 0, weight), jnp.where(beyond, weight, 0)], axis=1)
    spread = jnp.sum(roots**2, axis=1)[:, None]
    own, other = sum_products(groups, jnp.concatenate([plane, products, change, roots, spread], axis=1))
    direction, distance, wrong = _find_line(uv, weight, beyond, own, other)
    confidence = _measure_confidence(own, other) * _ramp(wrong, CONSTANTS.wrong_side)
    edge = [direction[0][None] * axes[0] + direction[1][None] * axes[1], (distance * spacing)[None]]
    jump = confidence[None] * (_mean(other, CHANGE) - _mean(own, CHANGE))
    return jnp.concatenate(edge), jump


def _ramp(values: Float[Array, " block"], ends: tuple[float, float]) -> Float[Array, " block"]:
    """Linear ramp: 0 before the first end, 1 beyond the second."""
    return clamp((values - ends[0]) / (ends[1] - ends[0]), 0, 1)


def _split_colors(weight: Float[Array, "k block"], change: Float[Array, "k 3 block"]) -> Bool[Array, "k block"]:
    """Which neighbors have another color than the point: those closer to the most different color than to its own."""
    differing = jax.lax.optimization_barrier(weight * jnp.sum(change**2, axis=1))
    most = (differing == jnp.max(differing, axis=0)[None]).astype(weight.dtype)
    axis = sum_first(most[:, None] * change) / sum_first(most)[None]
    return project_on(change, axis) > 0.5 * dot(axis, axis)[None]


def _measure_confidence(own: Float[Array, "sums block"], other: Float[Array, "sums block"]) -> Float[Array, " block"]:
    """Confidence that there are two colors, from the moments of square roots of linear colors."""
    apart = _mean(other, ROOTS) - _mean(own, ROOTS)
    whole = own + other
    variance = larger(whole[SPREAD] - dot(whole[ROOTS], whole[ROOTS]), 1e-9)
    between = own[0] * other[0] * dot(apart, apart) / variance
    contrast = largest(jnp.abs(apart))
    return (
        _ramp(other[0], CONSTANTS.other_color_share)
        * _ramp(contrast, CONSTANTS.contrast)
        * _ramp(between, CONSTANTS.parted_variance)
    )


def _find_line(
    uv: Float[Array, "k 2 block"],
    weight: Float[Array, "k block"],
    beyond: Bool[Array, "k block"],
    own: Float[Array, "sums block"],
    other: Float[Array, "sums block"],
) -> tuple[Float[Array, "2 block"], Float[Array, " block"], Float[Array, " block"]]:
    """Unit direction across the line, distance of the line along it, and the share of neighbors on the wrong side.

    The direction is that of a linear regression of the side.  The line lies midway between the last point of the own
    color and the first point of the other.
    """
    one, two = (0.5 / larger(sums[:1], 1e-6) * sums[:6] for sums in (own, other))
    (n, x, y, xx, xy, yy), side = one + two, two - one
    normal = jnp.stack(
        [jnp.stack([n, x, y, side[0]]), jnp.stack([x, xx, xy, side[1]]), jnp.stack([y, xy, yy, side[2]])]
    )
    stiff = jnp.asarray([1e-6, CONSTANTS.color_edge_ridge, CONSTANTS.color_edge_ridge], normal.dtype)
    direction = normalize_columns(solve(normal[:, :3] + jnp.diag(stiff)[..., None], normal[:, 3:])[1:, 0])
    height = jax.lax.optimization_barrier(uv[:, 0] * direction[0][None] + uv[:, 1] * direction[1][None])
    there = weight > CONSTANTS.color_edge_least_weight
    last = largest(jnp.where(there & ~beyond, height, 0))  # the point itself lies at 0
    first = smallest(jnp.where(there & beyond, height, jnp.inf))
    some = first < jnp.inf
    distance = larger(jnp.where(some, last + jnp.where(some, first, 0), 0) / 2, 0)
    return direction, distance, sum_first(jnp.where(beyond != (height > distance[None]), weight, 0))


def _mean(sums: Float[Array, "sums block"], columns: slice) -> Float[Array, "columns block"]:
    return sums[columns] / larger(sums[:1], 1e-6)
