"""The layer of the surface that each point lies on: a plane that its neighbors support, then a quadric through it.

At thin walls, stickers and edges, points of several layers lie close together; their colors, spacings and normals must
not mix.  Two sheets that are closer than the thickness of a layer are separated by their colors.  Pure functions of a
block of points, which is the last axis; k is the axis of a point's neighbors, the point itself first.  *Height* is the
distance of a neighbor from a plane or layer.  Lengths are in spacings unless stated otherwise.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.kernels.numerics import (
    clamp,
    cross,
    dot,
    find_narrowest,
    frame,
    larger,
    solve,
    sum_products,
    total,
    unit,
    with_gradient,
)

# --- the numbers of the estimates -------------------------------------------------------------------------------------


NEIGHBORS = 20  # of a point, which counts as its own first neighbor
Pair = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Rules:
    """The constants of the surfel estimation.  A pair is a range: bounds, or start and end of a ramp.

    Lengths are in spacings of the points, or in units of the box (half diagonal 1) where marked.  Weights count
    neighbors (a neighbor at the point's own position weighs 1).  Cosines and shares have no unit.
    """

    # spacing
    first_disc: int = 6  # neighbors in the disc whose area gives the first spacing
    least_spacing: float = 1e-5  # in units of the box, for points that coincide
    alone: float = 0.1  # in units of the box, for a single point
    own_disc: float = 5.5  # summed weight of the neighbors in the disc whose area gives the spacing
    own_share: float = 0.6  # upper bound of that weight: share of the layer's total weight
    bounds: Pair = (0.5, 1.6)  # of the ratio of the spacing to the first spacing
    most_even: float = 1.2  # upper bound of that ratio for even points: otherwise thin legs are drawn too thick
    smoothed: int = 9  # neighbors over which spacing and visibility are averaged
    near: float = 1.2  # standard deviation of the weight of a neighbor's distance

    # layers: a plane through the point and two neighbors, then a quadric
    paired: int = 8  # nearest neighbors whose pairs span the candidate planes
    sliver: float = 0.2  # least sine of the angle between two neighbors that span a plane
    flat: float = 0.1  # height above a plane at which a neighbor's support is one half
    trusted: float = 1.15  # factor on the support of the least-squares plane, which is better where points are noisy
    rounds: int = 4  # of the quadric's fit
    slope_ridge: float = 1e-3  # added to the normal equations for slopes
    bend_ridge: float = 0.1  # added for curvatures
    mixed_ridge: float = 0.05  # added for the mixed curvature: half, so that the result does not depend on the axes
    step_ridge: float = 0.01  # added for a step between two colors
    start: float = 0.12  # standard deviation of a neighbor's height in the first round
    scales: Pair = (0.04, 0.3)  # bounds of that standard deviation in later rounds
    spreads: float = 2.0  # that standard deviation over the mean absolute height of the layer's neighbors
    loose: float = 2.0  # factor on the standard deviation for the layer that colors and spacings are taken from
    apart: float = 3.0  # standard deviations beyond which a neighbor belongs to another layer
    parallel: float = 0.8  # least cosine between the normals of parallel layers

    # sheets: two surfaces closer than the thickness of a layer; a point lies on the one of its color
    like: float = 0.1  # standard deviation for the similarity of two colors, in square roots of linear colors
    sheet_scale: float = 0.02  # lower bound of the standard deviation of heights where colors separate sheets
    agreed: float = 0.3  # least share of certain points among the neighbors of similar color, for a point on a sheet
    # thresholds for possible and for certain sheets: step over their thickness; share of the step's information that no
    # slope or curvature explains; neighbors of each color; step over its standard error
    step_high: Pair = (1.5, 3.0)
    step_known: Pair = (0.3, 0.7)
    step_points: Pair = (1.0, 2.0)
    step_significant: Pair = (3.0, 6.0)

    # sides
    wall: float = 1.5  # height below which another layer is taken for the other side of a wall
    wall_vote: float = 3.0  # weight of that vote
    turn: float = 0.5  # a given normal is flipped if the lean against it exceeds this
    evidence: float = 1.0  # regulariser in the denominator of the lean: a few votes alone decide nothing
    sure_side: Pair = (0.15, 0.45)  # lean of the votes at which `sided` begins to rise and reaches 1
    bounds_seen: Pair = (0.5, 2.0)  # of a point's spacing over the median one, for the visibility from directions
    leak: float = 0.02  # weight of the back of a one-sided disc: better than a hole

    # ends of discs
    rim_within: float = 2.2  # neighbors within this distance determine where a layer ends
    sharp: float = 0.75  # cosine between normals below which two faces meet at an edge
    steep: float = 0.3  # sine between normals above which a plane cuts a disc
    edge: float = 0.1  # by which a disc extends beyond the line where another face cuts it
    aligned: float = 0.8  # least cosine between the direction to such a line and one of a disc's four directions
    beyond: float = 0.25  # by which a surface extends beyond the last point of its layer
    far: float = 4.0  # radius of a disc without an end

    # gaps between random points
    even: float = 0.62  # median distance to the nearest point above which points count as even: their gaps are holes
    widest_gap: float = 2.2  # radius of the largest gap that is bridged
    same_place: float = 5e-7  # half the squared distance below which two points coincide
    bridged: float = 0.95  # distance to the middle of a gap, in spacings as enlarged, at most

    # colors
    border_within: float = 1.6  # standard deviation of a neighbor's weight by its distance, for borders
    border_least: float = 0.01  # least weight at which a neighbor bounds the line
    contrast: Pair = (0.06, 0.16)  # between the two colors, in square roots of linear ones
    parted: Pair = (0.8, 0.9)  # share of the variance of the colors that lies between the two groups
    far_share: Pair = (0.03, 0.06)  # share of the neighbors that lie beyond the line
    wrong_side: Pair = (0.05, 0.01)  # share of the neighbors on the wrong side of the line
    border_ridge: float = 0.1  # of the regression of the line

    # memory
    block: int = 512  # points per block: a block fits into a core's cache


RULES = Rules()


# --- layers -----------------------------------------------------------------------------------------------------------


class Hood(NamedTuple):
    """Neighborhoods: which neighbors exist (1 or 0), offsets in units of the box, squared lengths, gathered columns."""

    real: Float[Array, "k block"]
    offset: Float[Array, "k 3 block"]
    squared: Float[Array, "k block"]
    columns: Float[Array, "k columns block"]


class Layer(NamedTuple):
    """Unit normals of either sign, the layer's thickness, and the neighbors' heights above it."""

    normal: Float[Array, "3 block"]
    scale: Float[Array, " block"]
    height: Float[Array, "k block"]


class Sheets(NamedTuple):
    """Layers if points lie on one of two sheets; whether that is possible, and whether it is certain."""

    layer: Layer
    possible: Bool[Array, " block"]
    certain: Bool[Array, " block"]


class Fit(NamedTuple):
    """A layer, the neighbors' weights, the sums of products of the unknowns, the step to neighbors of another color."""

    layer: Layer
    weight: Float[Array, "k block"]
    sums: Float[Array, "unknowns unknowns block"]
    step: Float[Array, " block"]


def look_around(
    number: Int[Array, "k block"], place: Float[Array, "3 block"], columns: Float[Array, "columns all"]
) -> Hood:
    """The neighborhoods of points at given positions; the first three of the columns of all points are their positions.

    Indices of neighbors that do not exist are negative.
    """
    real = number >= 0
    found = gather(columns, number)
    offset = jnp.where(real[:, None], found[:, :3] - place[None], 0)
    offset, squared = jax.lax.optimization_barrier((offset, jnp.sum(offset**2, axis=1)))
    return Hood(real.astype(place.dtype), offset, squared, found[:, 3:])


def gather(columns: Float[Array, "columns all"], number: Int[Array, "k block"]) -> Float[Array, "k columns block"]:
    """Columns of the neighbors; where there is no neighbor, those of the first point."""
    axes = jax.lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(1,), start_index_map=(1,))
    found = jax.lax.gather(columns, jnp.maximum(number, 0)[..., None], axes, (len(columns), 1), mode="clip")
    return jax.lax.optimization_barrier(found)


def select(chosen: Bool[Array, " block"], new: Array, old: Array | float | int) -> Array:
    """For each point (the last axis), the new values where `chosen`, else the old ones."""
    return jnp.where(chosen.reshape(*[1] * (new.ndim - 1), -1), new, old)


def along(vectors: Float[Array, "k 3 block"], axis: Float[Array, "3 block"]) -> Float[Array, "k block"]:
    """Components of each point's vectors along its axis."""
    return vectors[:, 0] * axis[0][None] + vectors[:, 1] * axis[1][None] + vectors[:, 2] * axis[2][None]


def _components(vectors: Array, axes: Array) -> tuple[Array, Array, Array]:
    """Components of vectors (k, 3, block) along three axes (3, 3, block), (k, block) each."""
    return along(vectors, axes[0]), along(vectors, axes[1]), along(vectors, axes[2])


def _pull_back_components(primals: tuple[Array, Array], cotangents: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Gradients by vectors and axes.  XLA would compute the sums that JAX derives one number at a time on a CPU."""
    vectors, axes = primals
    given = jnp.stack(cotangents, axis=1)
    return jnp.stack([along(given, axes[:, i]) for i in range(3)], axis=1), sum_products(given, vectors)


components = with_gradient(_components, _pull_back_components)


def weigh_near(hood: Hood, spacing: Float[Array, " block"], rules: Rules) -> Float[Array, "k block"]:
    """Weights of the neighbors by their distance."""
    return hood.real * jnp.exp(hood.squared * (-0.5 / (rules.near * spacing) ** 2)[None])


def weigh_height(layer: Layer, loose: float = 1.0) -> Float[Array, "k block"]:
    """Weights of the neighbors by their height above the layer."""
    return jnp.exp(-0.5 * (layer.height / (loose * layer.scale)[None]) ** 2)


def measure_covariance(
    hood: Hood, spacing: Float[Array, " block"], weight: Float[Array, "k block"]
) -> Float[Array, "3 3 block"]:
    """Covariance of the weighted neighbors, in squared spacings."""
    offset = hood.offset / spacing[None, None]
    terms = jnp.concatenate([jnp.ones_like(offset[:, :1]), offset], axis=1)
    sums = sum_products(weight[:, None] * terms, terms)
    sums = sums / larger(sums[:1, :1], 1e-9)
    return sums[1:, 1:] - sums[1:, :1] * sums[:1, 1:]


def find_planes(hood: Hood, spacing: Float[Array, " block"], rules: Rules) -> Float[Array, "3 block"]:
    """Unit normals: of the planes through the point and two of its nearest neighbors, the one with the largest support.

    The least-squares plane is a candidate, too.  So a point at an edge gets the plane of one face, not an average of
    both.  The choice of the plane is constant for gradients; its normal has a gradient.
    """
    weight = weigh_near(hood, spacing, rules)
    narrowest = find_narrowest(measure_covariance(hood, spacing, weight))
    pairs = np.array(list(combinations(range(1, rules.paired + 1), 2)), np.int32)
    fixed = (hood.offset / spacing[None, None], hood.squared / spacing[None] ** 2, hood.real, narrowest, weight)
    offset, squared, real, constant, weight = jax.lax.optimization_barrier(jax.lax.stop_gradient(fixed))

    def support(normal: Array) -> Array:
        return total(weight / (1 + (along(offset, normal) / rules.flat) ** 2))

    def compare(best: tuple[Array, Array], pair: Array) -> tuple[tuple[Array, Array], None]:
        one, two = pair
        across = cross(offset[one], offset[two])
        size = dot(across, across)
        spans = (size > rules.sliver**2 * squared[one] * squared[two]) & (real[one] * real[two] > 0)
        supported = jnp.where(spans, support(unit(across)), 0)
        better = supported > best[0]
        return (jnp.where(better, supported, best[0]), jnp.where(better[None], pair[:, None], best[1])), None

    none = jnp.zeros((2, len(spacing)), jnp.int32)
    _, chosen = jax.lax.scan(compare, (rules.trusted * support(constant), none), jnp.asarray(pairs))[0]
    one, two = (jnp.take_along_axis(hood.offset, which[None, None], axis=0)[0] for which in chosen)
    return jnp.where(chosen[:1] > 0, unit(cross(one / spacing[None], two / spacing[None])), narrowest)


def begin_normals(
    hood: Hood, spacing: Float[Array, " block"], given: Float[Array, "3 block"] | None = None, *, rules: Rules
) -> tuple[Float[Array, "3 block"], Bool[Array, " block"]]:
    """Unit normals to start from, and which are firm: given ones are; where none is given (or 0), planes are fitted."""
    if given is None:
        return find_planes(hood, spacing, rules), jnp.zeros(spacing.shape, bool)
    firm = dot(given, given) > 0.5

    def complete() -> Array:
        return select(firm, given, find_planes(hood, spacing, rules))

    return jax.lax.cond(jnp.all(firm | (hood.real[0] == 0)), lambda: given, complete), firm


def fit_layers(
    hood: Hood,
    spacing: Float[Array, " block"],
    normal: Float[Array, "3 block"],
    weight: Float[Array, "k block"],
    firm: Bool[Array, " block"],
    unlike: Float[Array, "k block"] | None,
    rules: Rules,
) -> tuple[Layer, Sheets | None]:
    """Layers from initial normals (firm ones are kept); also layers of sheets if `unlike` is given.

    A layer is a quadric through its point (Cazals and Pouget 2003).  For sheets, the quadric is fitted again with one
    more unknown: the step to the neighbors of another color (`unlike`).  A border of two colors on a curved surface is
    not a step: slope and curvature explain it as well.  Blocks without mixed colors are not fitted again.
    """
    offset = jax.lax.optimization_barrier(hood.offset / spacing[None, None])
    weight, free = jax.lax.optimization_barrier((weight, 1 - firm.astype(weight.dtype)))

    def begin(normal: Array, scale: Array | float) -> Fit:
        layer = Layer(normal, jnp.broadcast_to(jnp.asarray(scale, normal.dtype), spacing.shape), along(offset, normal))
        unknowns = 5 if unlike is None else 6
        sums = jnp.zeros((unknowns, unknowns, len(spacing)), normal.dtype)
        return Fit(layer, weight, sums, jnp.zeros_like(spacing))

    if unlike is None:
        start = begin(normal, rules.start)
        return _fit_quadric(offset, weight, start, None, rules.scales[0], free, rules).layer, None
    mixed = _fewer(total(weight), total(weight * unlike)) > rules.step_points[0]

    def fit(normal: Array, again: Array) -> tuple[Array, Fit]:
        start = begin(normal, jnp.where(again, rules.scales[1], rules.start))
        least = jnp.broadcast_to(jnp.where(again, rules.sheet_scale, rules.scales[0]), spacing.shape)
        slopes = jnp.where(again, 1, free)

        def fit_quadric() -> Fit:
            return _fit_quadric(offset, weight, start, again * unlike, least, slopes, rules)

        found = jax.lax.cond(~again | jnp.any(mixed), fit_quadric, lambda: start)
        return found.layer.normal, found

    _, fits = jax.lax.scan(fit, normal, jnp.array([False, True]))
    first, second = (jax.tree.map(lambda x, i=i: x[i], fits) for i in (0, 1))
    possible, certain = _tell_apart(second, unlike, rules)
    return first.layer, Sheets(second.layer, possible & mixed, certain & mixed)


def _fit_quadric(
    offset: Float[Array, "k 3 block"],
    weight: Float[Array, "k block"],
    start: Fit,
    unlike: Float[Array, "k block"] | None,
    least: Float[Array, " block"] | float,
    slopes: Float[Array, " block"],
    rules: Rules,
) -> Fit:
    """Fit in rounds: each weighs the neighbors by their height above the layer before; `least` bounds its thickness.

    Neighbors that are `unlike` the point lie one step off the quadric.  With `slopes` 0, the normals are kept.
    """
    ridge = _ridge(rules, weight.dtype)[: len(start.sums), : len(start.sums)]

    def improve(_: Array, last: tuple[Fit, Array]) -> tuple[Fit, Array]:
        (_, scale, _), rest = last[0].layer, last[1]
        axes = frame(last[0].layer.normal)
        one, two, up = components(offset, axes)
        own = weight * jnp.exp(-0.5 * (rest / scale[None]) ** 2)
        terms = [one, two, one * one, one * two, two * two, *([] if unlike is None else [unlike])]
        unknown = jnp.stack(terms, axis=1)
        sums = sum_products(own[:, None] * unknown, jnp.concatenate([unknown, up[:, None]], axis=1))
        solution = solve(sums[:, :-1] + ridge, sums[:, -1:])[:, 0]
        slope = slopes[None] * solution[:2]
        bent = (solution[i][None] * terms[i] for i in (2, 3, 4))
        height = rest = up - slope[0][None] * one - slope[1][None] * two - sum(bent)
        if unlike is not None:
            rest = height - solution[5][None] * unlike
        normal = unit(axes[2] - slope[:1] * axes[0] - slope[1:] * axes[1])
        away = total(own * jnp.abs(rest)) / larger(total(own) - 1, 0.5)  # the point itself is at 0
        scale = clamp(rules.spreads * away, least, rules.scales[1])
        return Fit(Layer(normal, scale, height), own, sums[:, :-1], solution[-1]), rest

    return jax.lax.fori_loop(0, rules.rounds, improve, (start, start.layer.height))[0]


def _ridge(rules: Rules, dtype: jnp.dtype) -> Float[Array, "6 6 1"]:
    """Ridge terms of the normal equations for slopes, curvatures, and the step between two colors."""
    bend = rules.bend_ridge
    ridge = [rules.slope_ridge, rules.slope_ridge, bend, rules.mixed_ridge, bend, rules.step_ridge]
    return jnp.diag(jnp.asarray(ridge, dtype))[..., None]


def _tell_apart(
    fit: Fit, unlike: Float[Array, "k block"], rules: Rules
) -> tuple[Bool[Array, " block"], Bool[Array, " block"]]:
    """Whether the step separates two sheets: possibly, and certainly."""
    step, own = fit.step, fit.weight
    last = jnp.zeros((6, 1, len(step)), step.dtype).at[-1].set(1)
    error = jnp.maximum(solve(fit.sums + _ridge(rules, step.dtype), last)[-1, 0], 1e-9)
    held, others, squares = total(own), total(own * unlike), total(own * unlike**2)
    alone = jnp.maximum(squares - others**2 / jnp.maximum(held, 1e-9), 1e-9)  # if the step were the only unknown
    high = jnp.abs(step) / fit.layer.scale
    measured = high, 1 / (alone * error), _fewer(held, others), high * rules.spreads / jnp.sqrt(error)
    limits = rules.step_high, rules.step_known, rules.step_points, rules.step_significant
    passed = [[value > limit[i] for value, limit in zip(measured, limits, strict=True)] for i in (0, 1)]
    return jnp.all(jnp.stack(passed[0]), axis=0), jnp.all(jnp.stack(passed[1]), axis=0)


def agree_on_sheets(
    hood: Hood,
    layer: Layer,
    sheets: Sheets,
    unlike: Float[Array, "k block"],
    certain: Float[Array, "k block"],
    rules: Rules,
) -> Layer:
    """The layers; those of sheets where enough neighbors of similar color are certain."""
    like = (hood.real * (1 - unlike))[1:]
    sure = total(like * certain[1:]) > rules.agreed * jnp.maximum(total(like), 1e-6)
    return jax.tree.map(lambda new, old: select(sheets.possible & sure, new, old), sheets.layer, layer)


def compare_colors(hood: Hood, roots: Float[Array, "k 3 block"], rules: Rules) -> Float[Array, "k block"]:
    """Difference in color between each neighbor and the point, 0 to 1, in square roots of linear colors."""
    change = roots - roots[:1]
    return -jnp.expm1(-0.5 / rules.like**2 * jnp.sum(change**2, axis=1)) * hood.real


def _fewer(held: Float[Array, " block"], others: Float[Array, " block"]) -> Float[Array, " block"]:
    """The smaller of two total weights: the neighbors of the point's color, and the others."""
    return jnp.minimum(others, held - others - 1)  # the point is its own neighbor


def weigh_layer(
    hood: Hood,
    layer: Layer,
    normal: Float[Array, "3 block"],
    sided: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    rules: Rules,
) -> Float[Array, "k block"]:
    """Weight of each neighbor as a member of the same layer: close to the quadric, normal to the same side."""
    weight = hood.real * weigh_height(layer, rules.loose)
    weight = weight * jnp.where((sided > 0.5)[None], clamp(0.5 + along(normals, normal), 0, 1), 1)
    return jax.lax.optimization_barrier(jnp.concatenate([jnp.ones_like(weight[:1]), weight[1:]]))
