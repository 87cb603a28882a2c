"""The layer of the surface that each point lies on: a plane that its neighbors support, then a quadric through it.

At thin walls, stickers and edges, points of several layers lie close together; their colors, spacings and normals must
not mix.  Two surfaces that are closer than the thickness of a layer are split by their colors.  Pure functions of a
block of points, which is the last axis; k is the axis of a point's neighbors, the point itself first.  *Height* is the
distance of a neighbor from a plane or layer.  Lengths are in spacings unless stated otherwise.
"""

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
    larger,
    normalize_columns,
    solve,
    sum_first,
    sum_products,
    tangent_frame,
    with_gradient,
)
from spnr_jax.surfels.constants import CONSTANTS


class Neighborhood(NamedTuple):
    """Which neighbors exist (1 or 0), offsets in units of the box, squared distances, columns of the neighbors."""

    real: Float[Array, "k block"]
    offset: Float[Array, "k 3 block"]
    squared: Float[Array, "k block"]
    columns: Float[Array, "k columns block"]


class Layer(NamedTuple):
    """Unit normals of either sign, the layer's thickness, and the neighbors' heights above it."""

    normal: Float[Array, "3 block"]
    thickness: Float[Array, " block"]
    height: Float[Array, "k block"]


class SplitLayer(NamedTuple):
    """The layer if colors separate two surfaces; whether that is possible, and whether it is certain."""

    layer: Layer
    possible: Bool[Array, " block"]
    certain: Bool[Array, " block"]


class QuadricFit(NamedTuple):
    """A layer, the neighbors' weights, the sums of products of the unknowns, the step to neighbors of another color."""

    layer: Layer
    weight: Float[Array, "k block"]
    sums: Float[Array, "unknowns unknowns block"]
    step: Float[Array, " block"]


def gather_neighborhoods(
    neighbors: Int[Array, "k block"], positions: Float[Array, "3 block"], columns: Float[Array, "columns all"]
) -> Neighborhood:
    """The neighborhoods of points at given positions; the first three of the columns of all points are their positions.

    Indices of neighbors that do not exist are negative.
    """
    real = neighbors >= 0
    found = gather(columns, neighbors)
    offset = jnp.where(real[:, None], found[:, :3] - positions[None], 0)
    offset, squared = jax.lax.optimization_barrier((offset, jnp.sum(offset**2, axis=1)))
    return Neighborhood(real.astype(positions.dtype), offset, squared, found[:, 3:])


def gather(columns: Float[Array, "columns all"], neighbors: Int[Array, "k block"]) -> Float[Array, "k columns block"]:
    """Columns of the neighbors; where there is no neighbor, those of the first point."""
    axes = jax.lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(1,), start_index_map=(1,))
    found = jax.lax.gather(columns, jnp.maximum(neighbors, 0)[..., None], axes, (len(columns), 1), mode="clip")
    return jax.lax.optimization_barrier(found)


def select(chosen: Bool[Array, " block"], new: Array, old: Array | float | int) -> Array:
    """For each point (the last axis), the new values where `chosen`, else the old ones."""
    return jnp.where(chosen.reshape(*[1] * (new.ndim - 1), -1), new, old)


def project_on(vectors: Float[Array, "k 3 block"], axis: Float[Array, "3 block"]) -> Float[Array, "k block"]:
    """Components of each point's vectors along its axis."""
    return vectors[:, 0] * axis[0][None] + vectors[:, 1] * axis[1][None] + vectors[:, 2] * axis[2][None]


def _plain_project_on_axes(vectors: Array, axes: Array) -> tuple[Array, Array, Array]:
    """Components of vectors (k, 3, block) along three axes (3, 3, block), (k, block) each."""
    return project_on(vectors, axes[0]), project_on(vectors, axes[1]), project_on(vectors, axes[2])


def _pull_back_projection(primals: tuple[Array, Array], cotangents: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Gradients by vectors and axes.  XLA would compute the sums that JAX derives one number at a time on a CPU."""
    vectors, axes = primals
    given = jnp.stack(cotangents, axis=1)
    return jnp.stack([project_on(given, axes[:, i]) for i in range(3)], axis=1), sum_products(given, vectors)


project_on_axes = with_gradient(_plain_project_on_axes, _pull_back_projection)


def weigh_distance(hood: Neighborhood, spacing: Float[Array, " block"]) -> Float[Array, "k block"]:
    """Weights of the neighbors by their distance."""
    return hood.real * jnp.exp(hood.squared * (-0.5 / (CONSTANTS.distance_sigma * spacing) ** 2)[None])


def weigh_height(layer: Layer, factor: float = 1.0) -> Float[Array, "k block"]:
    """Weights of the neighbors by their height above the layer."""
    return jnp.exp(-0.5 * (layer.height / (factor * layer.thickness)[None]) ** 2)


def measure_covariance(
    hood: Neighborhood, spacing: Float[Array, " block"], weight: Float[Array, "k block"]
) -> Float[Array, "3 3 block"]:
    """Covariance of the weighted neighbors, in squared spacings."""
    offset = hood.offset / spacing[None, None]
    terms = jnp.concatenate([jnp.ones_like(offset[:, :1]), offset], axis=1)
    sums = sum_products(weight[:, None] * terms, terms)
    sums = sums / larger(sums[:1, :1], 1e-9)
    return sums[1:, 1:] - sums[1:, :1] * sums[:1, 1:]


def fit_planes(hood: Neighborhood, spacing: Float[Array, " block"]) -> Float[Array, "3 block"]:
    """Unit normals: of the planes through the point and two of its nearest neighbors, the one with the largest support.

    The least-squares plane is a candidate, too.  So a point at an edge gets the plane of one face, not an average of
    both.  The choice of the plane is constant for gradients; its normal has a gradient.
    """
    weight = weigh_distance(hood, spacing)
    narrowest = find_narrowest(measure_covariance(hood, spacing, weight))
    pairs = np.array(list(combinations(range(1, CONSTANTS.plane_neighbors + 1), 2)), np.int32)
    fixed = (hood.offset / spacing[None, None], hood.squared / spacing[None] ** 2, hood.real, narrowest, weight)
    offset, squared, real, constant, weight = jax.lax.optimization_barrier(jax.lax.stop_gradient(fixed))

    def support(normal: Array) -> Array:
        return sum_first(weight / (1 + (project_on(offset, normal) / CONSTANTS.plane_height) ** 2))

    def compare(best: tuple[Array, Array], pair: Array) -> tuple[tuple[Array, Array], None]:
        one, two = pair
        across = cross(offset[one], offset[two])
        size = dot(across, across)
        spans = (size > CONSTANTS.least_plane_sine**2 * squared[one] * squared[two]) & (real[one] * real[two] > 0)
        supported = jnp.where(spans, support(normalize_columns(across)), 0)
        better = supported > best[0]
        return (jnp.where(better, supported, best[0]), jnp.where(better[None], pair[:, None], best[1])), None

    none = jnp.zeros((2, len(spacing)), jnp.int32)
    _, chosen = jax.lax.scan(compare, (CONSTANTS.least_squares_bonus * support(constant), none), jnp.asarray(pairs))[0]
    one, two = (jnp.take_along_axis(hood.offset, which[None, None], axis=0)[0] for which in chosen)
    return jnp.where(chosen[:1] > 0, normalize_columns(cross(one / spacing[None], two / spacing[None])), narrowest)


def init_normals(
    hood: Neighborhood,
    spacing: Float[Array, " block"],
    given: Float[Array, "3 block"] | None = None,
) -> tuple[Float[Array, "3 block"], Bool[Array, " block"]]:
    """Initial unit normals, and which are fixed: given ones; where none is given (or 0), planes are fitted."""
    if given is None:
        return fit_planes(hood, spacing), jnp.zeros(spacing.shape, bool)
    fixed_normal = dot(given, given) > 0.5

    def complete() -> Array:
        return select(fixed_normal, given, fit_planes(hood, spacing))

    return jax.lax.cond(jnp.all(fixed_normal | (hood.real[0] == 0)), lambda: given, complete), fixed_normal


def fit_layers(
    hood: Neighborhood,
    spacing: Float[Array, " block"],
    normal: Float[Array, "3 block"],
    weight: Float[Array, "k block"],
    fixed_normal: Bool[Array, " block"],
    color_distance: Float[Array, "k block"] | None,
) -> tuple[Layer, SplitLayer | None]:
    """Layers from initial normals (fixed ones are kept), and split layers if a color distance is given.

    A layer is a quadric through its point (Cazals and Pouget 2003).  In the frame of the normal, neighbor j has the
    tangent coordinates u, v and the height

        h_j = s . (u, v) + q . (u^2, u v, v^2) + a c_j

    with slopes s, curvatures q and, in a second fit for splits, the step a to the neighbors of another color (color
    distance c_j in [0, 1]).  It is found by ridge regression, in rounds with the weights exp(-r_j^2 / (2 t^2)) of the
    residuals r_j, with the thickness t.  A color edge on a curved surface is no step: slopes and curvatures explain it
    as well.  Blocks without mixed colors are not fitted again.  Both fits are the body of one loop, which is compiled
    once.
    """
    offset = jax.lax.optimization_barrier(hood.offset / spacing[None, None])
    weight, free = jax.lax.optimization_barrier((weight, 1 - fixed_normal.astype(weight.dtype)))

    def init(normal: Array, thickness: Array | float) -> QuadricFit:
        layer = Layer(
            normal, jnp.broadcast_to(jnp.asarray(thickness, normal.dtype), spacing.shape), project_on(offset, normal)
        )
        unknowns = 5 if color_distance is None else 6
        sums = jnp.zeros((unknowns, unknowns, len(spacing)), normal.dtype)
        return QuadricFit(layer, weight, sums, jnp.zeros_like(spacing))

    if color_distance is None:
        initial = init(normal, CONSTANTS.first_thickness)
        return _fit_quadric(offset, weight, initial, None, CONSTANTS.thickness_bounds[0], free).layer, None
    two_colors = _smaller_weight(sum_first(weight), sum_first(weight * color_distance)) > CONSTANTS.step_points[0]

    def fit(normal: Array, with_step: Array) -> tuple[Array, QuadricFit]:
        initial = init(normal, jnp.where(with_step, CONSTANTS.thickness_bounds[1], CONSTANTS.first_thickness))
        least_thickness = jnp.broadcast_to(
            jnp.where(with_step, CONSTANTS.split_thickness, CONSTANTS.thickness_bounds[0]), spacing.shape
        )
        fit_slopes = jnp.where(with_step, 1, free)

        def fit_quadric() -> QuadricFit:
            step = jnp.where(with_step, color_distance, 0)
            return _fit_quadric(offset, weight, initial, step, least_thickness, fit_slopes)

        found = jax.lax.cond(~with_step | jnp.any(two_colors), fit_quadric, lambda: initial)
        return found.layer.normal, found

    _, fits = jax.lax.scan(fit, normal, jnp.array([False, True]))
    first, stepped = (jax.tree.map(lambda x, i=i: x[i], fits) for i in (0, 1))
    possible, certain = _test_split(stepped, color_distance)
    return first.layer, SplitLayer(stepped.layer, possible & two_colors, certain & two_colors)


def _fit_quadric(
    offset: Float[Array, "k 3 block"],
    weight: Float[Array, "k block"],
    initial: QuadricFit,
    color_distance: Float[Array, "k block"] | None,
    least_thickness: Float[Array, " block"] | float,
    fit_slopes: Float[Array, " block"],
) -> QuadricFit:
    """The rounds of a fit, with the step if a color distance is given.  With `fit_slopes` 0, the normals are kept."""
    ridge = _ridge(weight.dtype)[: len(initial.sums), : len(initial.sums)]

    def improve(_: Array, last: tuple[QuadricFit, Array]) -> tuple[QuadricFit, Array]:
        (_, thickness, _), rest = last[0].layer, last[1]
        axes = tangent_frame(last[0].layer.normal)
        one, two, up = project_on_axes(offset, axes)
        own = weight * jnp.exp(-0.5 * (rest / thickness[None]) ** 2)
        terms = [one, two, one * one, one * two, two * two, *([] if color_distance is None else [color_distance])]
        unknown = jnp.stack(terms, axis=1)
        sums = sum_products(own[:, None] * unknown, jnp.concatenate([unknown, up[:, None]], axis=1))
        solution = solve(sums[:, :-1] + ridge, sums[:, -1:])[:, 0]
        slope = fit_slopes[None] * solution[:2]
        bent = (solution[i][None] * terms[i] for i in (2, 3, 4))
        height = rest = up - slope[0][None] * one - slope[1][None] * two - sum(bent)
        if color_distance is not None:
            rest = height - solution[5][None] * color_distance
        normal = normalize_columns(axes[2] - slope[:1] * axes[0] - slope[1:] * axes[1])
        away = sum_first(own * jnp.abs(rest)) / larger(sum_first(own) - 1, 0.5)  # the point itself is at 0
        thickness = clamp(CONSTANTS.thickness_per_deviation * away, least_thickness, CONSTANTS.thickness_bounds[1])
        return QuadricFit(Layer(normal, thickness, height), own, sums[:, :-1], solution[-1]), rest

    return jax.lax.fori_loop(0, CONSTANTS.fit_rounds, improve, (initial, initial.layer.height))[0]


def _ridge(dtype: jnp.dtype) -> Float[Array, "6 6 1"]:
    """Ridge terms of the normal equations for slopes, curvatures, and the step between two colors."""
    bend = CONSTANTS.bend_ridge
    ridge = [CONSTANTS.slope_ridge, CONSTANTS.slope_ridge, bend, CONSTANTS.mixed_ridge, bend, CONSTANTS.step_ridge]
    return jnp.diag(jnp.asarray(ridge, dtype))[..., None]


def _test_split(
    fit: QuadricFit, color_distance: Float[Array, "k block"]
) -> tuple[Bool[Array, " block"], Bool[Array, " block"]]:
    """Whether the step separates two surfaces: possibly, and certainly (the thresholds are CONSTANTS.step_...)."""
    step, own = fit.step, fit.weight
    last = jnp.zeros((6, 1, len(step)), step.dtype).at[-1].set(1)
    error = jnp.maximum(solve(fit.sums + _ridge(step.dtype), last)[-1, 0], 1e-9)
    total_weight, other_weight = sum_first(own), sum_first(own * color_distance)
    squares = sum_first(own * color_distance**2)
    # the information about the step if it were the only unknown
    step_alone = jnp.maximum(squares - other_weight**2 / jnp.maximum(total_weight, 1e-9), 1e-9)
    high = jnp.abs(step) / fit.layer.thickness
    independence = 1 / (step_alone * error)
    smaller_weight = _smaller_weight(total_weight, other_weight)
    significance = high * CONSTANTS.thickness_per_deviation / jnp.sqrt(error)
    measured = high, independence, smaller_weight, significance
    limits = CONSTANTS.step_height, CONSTANTS.step_independence, CONSTANTS.step_points, CONSTANTS.step_significant
    passed = [[value > limit[i] for value, limit in zip(measured, limits, strict=True)] for i in (0, 1)]
    return jnp.all(jnp.stack(passed[0]), axis=0), jnp.all(jnp.stack(passed[1]), axis=0)


def keep_agreed_splits(
    hood: Neighborhood,
    layer: Layer,
    split: SplitLayer,
    color_distance: Float[Array, "k block"],
    certain: Float[Array, "k block"],
) -> Layer:
    """The layers; split ones where enough neighbors of similar color are certain."""
    like = (hood.real * (1 - color_distance))[1:]
    sure = sum_first(like * certain[1:]) > CONSTANTS.split_share * jnp.maximum(sum_first(like), 1e-6)
    return jax.tree.map(lambda new, old: select(split.possible & sure, new, old), split.layer, layer)


def measure_color_distance(hood: Neighborhood, roots: Float[Array, "k 3 block"]) -> Float[Array, "k block"]:
    """Difference in color between each neighbor and the point, 0 to 1, in square roots of linear colors."""
    change = roots - roots[:1]
    return -jnp.expm1(-0.5 / CONSTANTS.color_sigma**2 * jnp.sum(change**2, axis=1)) * hood.real


def _smaller_weight(
    total_weight: Float[Array, " block"], other_weight: Float[Array, " block"]
) -> Float[Array, " block"]:
    """The smaller of two total weights: the neighbors of the point's color, and the others."""
    return jnp.minimum(other_weight, total_weight - other_weight - 1)  # the point is its own neighbor


def weigh_layer(
    hood: Neighborhood,
    layer: Layer,
    normal: Float[Array, "3 block"],
    one_sided: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
) -> Float[Array, "k block"]:
    """Weight of each neighbor as a member of the same layer: close to the quadric, normal to the same side."""
    weight = hood.real * weigh_height(layer, CONSTANTS.loose_thickness)
    weight = weight * jnp.where((one_sided > 0.5)[None], clamp(0.5 + project_on(normals, normal), 0, 1), 1)
    return jax.lax.optimization_barrier(jnp.concatenate([jnp.ones_like(weight[:1]), weight[1:]]))
