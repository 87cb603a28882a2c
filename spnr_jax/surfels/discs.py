"""Extent and colors of discs: spacing, rim of the layer, sharp edges, gaps between random points, borders of color.

Pure functions of a block of points, which is the last axis.  `layer` (k, block) weighs the neighbors by whether they
lie on the same layer; `place` (k, 2, block) holds the neighbors' coordinates in the tangent plane.  Lengths are in
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
    root,
    smaller,
    smallest,
    solve,
    sum_products,
    total,
    unit,
)
from spnr_jax.surfels.layers import Hood, Rules, along

RIM_DIRECTIONS = 16  # in which the rim of a layer is searched
CHANGE, ROOTS, SPREAD = slice(6, 9), slice(9, 12), 12  # columns of a border's sums: moments of the colors
TURN = 2 * np.pi / RIM_DIRECTIONS * np.arange(RIM_DIRECTIONS)


def first_spacing(hood: Hood, rules: Rules) -> Float[Array, " block"]:
    """Spacing from the area of the disc that holds a number of neighbors on any layer; in units of the box."""
    count = jnp.minimum(rules.first_disc, jnp.sum(hood.real, axis=0) - 1)
    chosen = jnp.arange(len(hood.real), dtype=count.dtype)[:, None] == count[None]
    distance = root(jnp.sum(jnp.where(chosen, hood.squared, 0), axis=0))
    several = count > 0  # a single point represents a tenth of the box
    spacing = larger(jnp.sqrt(jnp.pi / jnp.where(several, count, 1)) * distance, rules.least_spacing)
    return jnp.where(several, spacing, rules.alone)


def own_spacing(
    hood: Hood, layer: Float[Array, "k block"], raw: Float[Array, " block"], rules: Rules
) -> Float[Array, " block"]:
    """Spacing from the area of the disc that holds a number of neighbors on the same layer; in units of the box."""
    others = len(layer) - 1
    held = jnp.matmul(jnp.tril(jnp.ones((others, others), layer.dtype)), layer[1:], precision="highest")
    wanted = jnp.minimum(rules.own_disc, jnp.maximum(rules.own_share * held[-1], 0.5))
    count = jnp.sum(hood.real, axis=0) - 1
    last = jnp.minimum(total((held < wanted[None]).astype(count.dtype)), jnp.maximum(count - 1, 0))
    chosen = jnp.arange(others, dtype=count.dtype)[:, None] == last[None]
    weight, squared = total(jnp.where(chosen, held, 0)), total(jnp.where(chosen, hood.squared[1:], 0))
    spacing = jnp.sqrt(jnp.pi / larger(weight, 1)) * root(squared)
    low, high = rules.bounds
    return jnp.where(count > 0, clamp(spacing, low * raw, high * raw), raw)


def smooth_spacing(
    layer: Float[Array, "k block"], spacings: Float[Array, "k block"], rules: Rules
) -> Float[Array, " block"]:
    """Geometric mean of the spacing over the nearest neighbors on the same layer."""
    weight, near = layer[: rules.smoothed], spacings[: rules.smoothed]
    return jnp.exp(total(weight * jnp.log(larger(near, rules.least_spacing))) / total(weight))


def average(
    number: Int[Array, "k block"], weight: Float[Array, "k block"], seen: Float[Array, "all 64"]
) -> Float[Array, "block 64"]:
    """Weighted means of the neighbors' rows of `seen`."""

    def add(sums: Array, neighbor: tuple[Array, Array]) -> tuple[Array, None]:
        rows = seen.at[jnp.maximum(neighbor[0], 0)].get(mode="clip")
        return sums + neighbor[1][:, None] * rows, None

    empty = jnp.zeros((weight.shape[1], seen.shape[1]), weight.dtype)
    return jax.lax.scan(add, empty, (number, weight / total(weight)[None]))[0]


def measure_evenness(
    hood: Hood, layer: Float[Array, "k block"], spacing: Float[Array, " block"]
) -> Float[Array, " block"]:
    """Spacings to the nearest other point of the layer; median 0.5 for random points, 0.7 to 0.8 for even ones."""
    squared = jnp.min(jnp.where(layer[1:] > 0.5, hood.squared[1:], jnp.inf), axis=0)
    return jnp.sqrt(squared) / spacing


def find_farthest(place: Float[Array, "k 2 block"]) -> Float[Array, "16 block"]:
    """Distance of the farthest point of the plane in each of 16 directions."""
    turn = jnp.asarray(TURN[: RIM_DIRECTIONS // 2], place.dtype)
    one, two = jax.lax.optimization_barrier((place[:, 0], place[:, 1]))

    def look(way: tuple[Array, Array]) -> tuple[Array, Array]:
        ahead = one * way[0] + two * way[1]
        return largest(ahead), largest(-ahead)

    return jnp.concatenate(jax.lax.map(look, (jnp.cos(turn), jnp.sin(turn))))


def bridge_gaps(
    place: Float[Array, "k 2 block"], layer: Float[Array, "k block"], rules: Rules
) -> Float[Array, " block"]:
    """Factor by which a disc is enlarged beside gaps, so that the discs around a gap cover its middle.

    A gap is an empty circle through the point with other points all around it; its center is a vertex of the Voronoi
    diagram in the tangent plane.  For each direction, consider the largest empty circle through the point whose center
    lies there.  Its radius has a local maximum at a Voronoi vertex, and no limit where the layer ends.  After the
    inversion p -> 2 p / |p|^2, the distance of the farthest point in the direction is the curvature of that circle.
    """
    half = (place[:, 0] ** 2 + place[:, 1] ** 2) / 2
    other = (layer > 0.5) & (half > rules.same_place)
    inverse = jnp.where(other, 1 / jnp.where(other, half, 1), 0)
    curved = find_farthest(place * inverse[:, None])
    vertex = (curved > 1 / rules.widest_gap) & (curved <= jnp.roll(curved, 1, axis=0))
    vertex = vertex & (curved <= jnp.roll(curved, -1, axis=0))
    least = smallest(jnp.where(vertex, curved, 1 / rules.bridged))
    return larger(1 / (least * rules.bridged), 1)


class Cuts(NamedTuple):
    """Distances at which neighbors' planes cut a disc (infinite: no cut), and unit directions in the disc's plane."""

    distance: Float[Array, "k block"]
    across: Float[Array, "k block"]
    up: Float[Array, "k block"]


def find_cuts(
    hood: Hood,
    axes: Float[Array, "3 3 block"],
    spacing: Float[Array, " block"],
    sided: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    sides: Float[Array, "k block"],
    rules: Rules,
) -> Cuts:
    """At a sharp edge, the plane of the other face cuts a disc (clip lines, Zwicker et al. 2004)."""
    across, up, facing = (along(normals, axis) for axis in axes)
    flat = root(across**2 + up**2)
    cuts = (facing < rules.sharp) & (flat > rules.steep) & (hood.real > 0)
    cuts = cuts & (sides > 0.5) & (sided > 0.5)[None] & (hood.squared < (rules.rim_within * spacing[None]) ** 2)
    inverse = jnp.where(cuts, 1 / jnp.where(cuts, flat, 1), 0)
    line = jnp.sum(normals * hood.offset, axis=1) / spacing[None] * inverse
    distance = jnp.where(cuts & (line > 0), line + rules.edge, jnp.inf)
    return Cuts(*jax.lax.optimization_barrier((distance, across * inverse, up * inverse)))


def find_rims(
    ends: Float[Array, "16 block"], cuts: Cuts, axes: Float[Array, "3 3 block"], rules: Rules
) -> tuple[Float[Array, "3 block"], Float[Array, "4 block"]]:
    """The direction in which the layer ends first, and the distances of the ends, in the form of `Surfels`.

    A layer ends slightly beyond its last point, or where another face cuts it.  The choice of the neighbor or direction
    that ends it is constant for gradients.
    """
    constant = jax.lax.stop_gradient((cuts.distance, ends))
    nearest, soonest = jnp.min(constant[0], axis=0), jnp.argmin(constant[1], axis=0)
    cut = nearest < jnp.min(constant[1], axis=0) + rules.beyond
    first = (constant[0] <= nearest[None]) & cut[None]
    turn = jnp.asarray(TURN, ends.dtype)
    way = [
        jnp.where(cut, total(jnp.where(first, ways, 0)), of_turn[soonest])
        for ways, of_turn in ((cuts.across, jnp.cos(turn)), (cuts.up, jnp.sin(turn)))
    ]
    right, high = unit(jnp.stack(way))

    def reach(way: tuple[Array, Array]) -> Array:
        right, high = way
        aligned = cuts.across * right[None] + cuts.up * high[None] > rules.aligned
        line = smallest(jnp.where(aligned, cuts.distance, jnp.inf))
        angle = jnp.arctan2(*jax.lax.stop_gradient((high, right)))
        step = jnp.round(angle / (2 * jnp.pi) * RIM_DIRECTIONS).astype(jnp.int32) % RIM_DIRECTIONS
        end = jnp.take_along_axis(ends, step[None], axis=0)[0]
        return jnp.where(line < jnp.inf, jnp.where(line < jnp.inf, line, 0), end)

    quarters = jnp.stack([right, -right, -high, high]), jnp.stack([high, -high, right, -right])
    return right[None] * axes[0] + high[None] * axes[1], smaller(jax.lax.map(reach, quarters), rules.far)


def find_border(
    place: Float[Array, "k 2 block"],
    layer: Float[Array, "k block"],
    spacing: Float[Array, " block"],
    axes: Float[Array, "3 3 block"],
    colors: Float[Array, "k 3 block"],
    rules: Rules,
) -> dict[str, Array]:
    """The fields `border` (4, block) and `jump` (3, block): a straight border between two colors, where there is one.

    With one color per disc, a border would look frayed at the scale of the spacing.  Borders fade in smoothly.  Which
    neighbors have the other color is constant for gradients.
    """
    squared = place[:, 0] ** 2 + place[:, 1] ** 2
    weight = layer * jnp.exp(-0.5 / rules.border_within**2 * squared)
    weight = jax.lax.optimization_barrier(weight / total(weight)[None])
    roots, change = root(colors), colors - colors[:1]
    roots = roots - roots[:1]
    beyond = _part(weight, jax.lax.stop_gradient(roots))
    plane = jnp.concatenate([jnp.ones_like(place[:, :1]), place], axis=1)
    products = jnp.stack([place[:, 0] ** 2, place[:, 0] * place[:, 1], place[:, 1] ** 2], axis=1)
    sides = jnp.stack([weight * ~beyond, weight * beyond], axis=1)
    spread = jnp.sum(roots**2, axis=1)[:, None]
    own, other = sum_products(sides, jnp.concatenate([plane, products, change, roots, spread], axis=1))
    way, distance, wrong = _find_line(place, weight, beyond, own, other, rules)
    sure = _trust(own, other, rules) * _ramp(wrong, rules.wrong_side)
    border = [way[0][None] * axes[0] + way[1][None] * axes[1], (distance * spacing)[None]]
    jump = sure[None] * (_mean(other, CHANGE) - _mean(own, CHANGE))
    return {"border": jnp.concatenate(border), "jump": jump}


def _ramp(values: Float[Array, " block"], ends: tuple[float, float]) -> Float[Array, " block"]:
    """Linear ramp: 0 before the first end, 1 beyond the second."""
    return clamp((values - ends[0]) / (ends[1] - ends[0]), 0, 1)


def _part(weight: Float[Array, "k block"], change: Float[Array, "k 3 block"]) -> Bool[Array, "k block"]:
    """Which neighbors have another color than the point: those closer to the most different color than to its own."""
    differing = jax.lax.optimization_barrier(weight * jnp.sum(change**2, axis=1))
    most = (differing == jnp.max(differing, axis=0)[None]).astype(weight.dtype)
    axis = total(most[:, None] * change) / total(most)[None]
    return along(change, axis) > 0.5 * dot(axis, axis)[None]


def _trust(own: Float[Array, "sums block"], other: Float[Array, "sums block"], rules: Rules) -> Float[Array, " block"]:
    """Confidence that there are two colors, from the moments of square roots of linear colors."""
    apart = _mean(other, ROOTS) - _mean(own, ROOTS)
    whole = own + other
    variance = larger(whole[SPREAD] - dot(whole[ROOTS], whole[ROOTS]), 1e-9)
    between = own[0] * other[0] * dot(apart, apart) / variance
    contrast = largest(jnp.abs(apart))
    return _ramp(other[0], rules.far_share) * _ramp(contrast, rules.contrast) * _ramp(between, rules.parted)


def _find_line(
    place: Float[Array, "k 2 block"],
    weight: Float[Array, "k block"],
    beyond: Bool[Array, "k block"],
    own: Float[Array, "sums block"],
    other: Float[Array, "sums block"],
    rules: Rules,
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
    way = unit(_solve_plane(normal, rules.border_ridge)[:, 0])
    height = jax.lax.optimization_barrier(place[:, 0] * way[0][None] + place[:, 1] * way[1][None])
    there = weight > rules.border_least
    last = largest(jnp.where(there & ~beyond, height, 0))  # the point itself lies at 0
    first = smallest(jnp.where(there & beyond, height, jnp.inf))
    some = first < jnp.inf
    distance = larger(jnp.where(some, last + jnp.where(some, first, 0), 0) / 2, 0)
    return way, distance, total(weight * (beyond != (height > distance[None])))


def _solve_plane(normal: Float[Array, "3 columns block"], ridge: float) -> Float[Array, "2 sides block"]:
    """Slopes of a linear regression over the plane, from its normal equations beside their right-hand sides."""
    stiff = jnp.diag(jnp.asarray([1e-6, ridge, ridge], normal.dtype))[..., None]
    return solve(normal[:, :3] + stiff, normal[:, 3:])[1:]


def _mean(sums: Float[Array, "sums block"], columns: slice) -> Float[Array, "columns block"]:
    return sums[columns] / larger(sums[:1], 1e-6)
