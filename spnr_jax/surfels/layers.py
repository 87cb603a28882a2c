"""The layer of the surface that each point lies on: a plane that its neighbors support, then a quadric through it.

At thin walls, stickers and edges, points of several layers lie side by side; colors, spacings and normals of different
layers must not mix.  Two sheets that are closer than the thickness of a layer are separated by their colors.  Pure
functions of a block of points, which is the last axis; k are the neighbors of a point, itself the first.  Lengths are
in spacings unless stated otherwise.
"""

from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.kernels.numerics import clamp, larger, with_gradient
from spnr_jax.surfels.rules import Rules
from spnr_jax.surfels.small_systems import cross, dot, find_narrowest, frame, solve, sum_products, total, unit


class Hood(NamedTuple):
    """Neighborhoods of a block of points: which neighbors exist (1 or 0), the way to each in units of the box, its
    squared length, and the columns that were asked of each."""

    real: Float[Array, "k block"]
    offset: Float[Array, "k 3 block"]
    squared: Float[Array, "k block"]
    columns: Float[Array, "k columns block"]


class Layer(NamedTuple):
    """Unit normals of either sign, the layer's thickness, the neighbors' height over it."""

    normal: Float[Array, "3 block"]
    scale: Float[Array, " block"]
    height: Float[Array, "k block"]


class Sheets(NamedTuple):
    """The layers that points have if they lie on one of two sheets, whether they may, and whether that is certain."""

    layer: Layer
    possible: Bool[Array, " block"]
    certain: Bool[Array, " block"]


class Fit(NamedTuple):
    """A layer, the neighbors' weights in it, their sums over products of unknowns, the step to those unlike."""

    layer: Layer
    weight: Float[Array, "k block"]
    sums: Float[Array, "unknowns unknowns block"]
    step: Float[Array, " block"]


def look_around(
    number: Int[Array, "k block"], place: Float[Array, "3 block"], columns: Float[Array, "columns all"]
) -> Hood:
    """The neighborhoods of points at some places, from columns of all points, their positions the first three.

    Numbers of neighbors that do not exist are negative.
    """
    real = number >= 0
    found = gather(columns, number)
    offset = jnp.where(real[:, None], found[:, :3] - place[None], 0)
    offset, squared = jax.lax.optimization_barrier((offset, jnp.sum(offset**2, axis=1)))
    return Hood(real.astype(place.dtype), offset, squared, found[:, 3:])


def gather(columns: Float[Array, "columns all"], number: Int[Array, "k block"]) -> Float[Array, "k columns block"]:
    """Columns of the neighbors; those of the first point where there is no neighbor."""
    axes = jax.lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(1,), start_index_map=(1,))
    found = jax.lax.gather(columns, jnp.maximum(number, 0)[..., None], axes, (len(columns), 1), mode="clip")
    return jax.lax.optimization_barrier(found)


def select(chosen: Bool[Array, " block"], new: Array, old: Array | float | int) -> Array:
    """Of each point (the last axis) the new values where it is chosen, the old ones elsewhere."""
    return jnp.where(chosen.reshape(*[1] * (new.ndim - 1), -1), new, old)


def along(vectors: Float[Array, "k 3 block"], axis: Float[Array, "3 block"]) -> Float[Array, "k block"]:
    """Components of the vectors along one axis for each point."""
    return vectors[:, 0] * axis[0][None] + vectors[:, 1] * axis[1][None] + vectors[:, 2] * axis[2][None]


def _components(vectors: Array, axes: Array) -> tuple[Array, Array, Array]:
    """Components of vectors (k, 3, block) along three axes (3, 3, block), (k, block) each."""
    return along(vectors, axes[0]), along(vectors, axes[1]), along(vectors, axes[2])


def _pull_back_components(primals: tuple[Array, Array], cotangents: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """By vectors and axes: sums over the neighbors as JAX derives them are computed one number at a time on a CPU."""
    vectors, axes = primals
    given = jnp.stack(cotangents, axis=1)
    return jnp.stack([along(given, axes[:, i]) for i in range(3)], axis=1), sum_products(given, vectors)


components = with_gradient(_components, _pull_back_components)


def weigh_near(hood: Hood, spacing: Float[Array, " block"], rules: Rules) -> Float[Array, "k block"]:
    """Weights of the neighbors by their distance."""
    return hood.real * jnp.exp(hood.squared * (-0.5 / (rules.near * spacing) ** 2)[None])


def weigh_height(layer: Layer, loose: float = 1.0) -> Float[Array, "k block"]:
    """Weights of the neighbors by their height over the layer."""
    return jnp.exp(-0.5 * (layer.height / (loose * layer.scale)[None]) ** 2)


def measure_covariance(
    hood: Hood, spacing: Float[Array, " block"], weight: Float[Array, "k block"]
) -> Float[Array, "3 3 block"]:
    """Of the weighted neighbors, in squared spacings."""
    offset = hood.offset / spacing[None, None]
    terms = jnp.concatenate([jnp.ones_like(offset[:, :1]), offset], axis=1)
    sums = sum_products(weight[:, None] * terms, terms)
    sums = sums / larger(sums[:1, :1], 1e-9)
    return sums[1:, 1:] - sums[1:, :1] * sums[:1, 1:]


def find_planes(hood: Hood, spacing: Float[Array, " block"], rules: Rules) -> Float[Array, "3 block"]:
    """Unit normals of the planes through a point that two of its nearest span: that which most neighbors support.

    The plane of least squares is tried, too.  So a point at an edge gets the plane of one of the faces, not one between
    them.  Which plane is chosen is a constant; its normal has a gradient.
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
    """Given unit normals, which are firm; where there is none, or it is 0, those of planes, which are not."""
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
    """Layers from first normals, which are kept if they are firm; of sheets, too, where neighbors are `unlike` a point.

    A layer is a quadric through its point (Cazals and Pouget 2003).  For sheets it is fitted once more with the step to
    the neighbors of another color as one more unknown.  The border of two colors on a bent surface is no step: slope
    and curvature beyond it explain as much.  Blocks in which no two colors lie among each other are not fitted again.
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
    """Fit in rounds to the neighbors that lie close to the layer before, with a least thickness.

    Those that are unlike lie a step from the quadric.  With 0 for `slopes` normals are kept.
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
        away = total(own * jnp.abs(rest)) / larger(total(own) - 1, 0.5)  # it is at 0 itself
        scale = clamp(rules.spreads * away, least, rules.scales[1])
        return Fit(Layer(normal, scale, height), own, sums[:, :-1], solution[-1]), rest

    return jax.lax.fori_loop(0, rules.rounds, improve, (start, start.layer.height))[0]


def _ridge(rules: Rules, dtype: jnp.dtype) -> Float[Array, "6 6 1"]:
    """What is added to the normal equations of a quadric's slopes, curvatures, and a step between two colors."""
    bend = rules.bend_ridge
    ridge = [rules.slope_ridge, rules.slope_ridge, bend, rules.mixed_ridge, bend, rules.step_ridge]
    return jnp.diag(jnp.asarray(ridge, dtype))[..., None]


def _tell_apart(
    fit: Fit, unlike: Float[Array, "k block"], rules: Rules
) -> tuple[Bool[Array, " block"], Bool[Array, " block"]]:
    """Whether the step is one between two sheets: perhaps, and certainly."""
    step, own = fit.step, fit.weight
    last = jnp.zeros((6, 1, len(step)), step.dtype).at[-1].set(1)
    error = jnp.maximum(solve(fit.sums + _ridge(rules, step.dtype), last)[-1, 0], 1e-9)
    held, others, squares = total(own), total(own * unlike), total(own * unlike**2)
    alone = jnp.maximum(squares - others**2 / jnp.maximum(held, 1e-9), 1e-9)  # were nothing else unknown
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
    """The layers, those of sheets where enough neighbors of a like color are certain."""
    like = (hood.real * (1 - unlike))[1:]
    sure = total(like * certain[1:]) > rules.agreed * jnp.maximum(total(like), 1e-6)
    return jax.tree.map(lambda new, old: select(sheets.possible & sure, new, old), sheets.layer, layer)


def compare_colors(hood: Hood, roots: Float[Array, "k 3 block"], rules: Rules) -> Float[Array, "k block"]:
    """How far the neighbors are of another color than the point, 0 to 1, by the square roots of linear colors."""
    change = roots - roots[:1]
    return -jnp.expm1(-0.5 / rules.like**2 * jnp.sum(change**2, axis=1)) * hood.real


def _fewer(held: Float[Array, " block"], others: Float[Array, " block"]) -> Float[Array, " block"]:
    """Weights of the neighbors of the point's color or of others, out of all that are held, whichever are fewer."""
    return jnp.minimum(others, held - others - 1)  # it is its own neighbor


def weigh_layer(
    hood: Hood,
    layer: Layer,
    normal: Float[Array, "3 block"],
    sided: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    rules: Rules,
) -> Float[Array, "k block"]:
    """Weight of each neighbor as one of the same layer: near the quadric, and turned to the same side."""
    weight = hood.real * weigh_height(layer, rules.loose)
    weight = weight * jnp.where((sided > 0.5)[None], clamp(0.5 + along(normals, normal), 0, 1), 1)
    return jax.lax.optimization_barrier(jnp.concatenate([jnp.ones_like(weight[:1]), weight[1:]]))
