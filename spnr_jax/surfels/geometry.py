"""Surfels from points: the surface around each point, estimated by one pure program over given neighbors.

neighbors   near points of each point, found once on the host (neighbors.py); integers without a gradient
spacing     side of the square that a point represents.  Three estimates follow each other: the raw spacing from 6
            neighbors on any layer, the spacing from the neighbors on the same layer, and its mean over 9 of these
normal      given, or else that of the layer (layers.py); the outer side is found by votes (sides.py)
one_sided   1 where the votes agree on the outer side, 0 where both sides are equally visible (a two-sided disc)
color_edge  a straight edge between two colors inside a disc; color_jump is the change of color across it (discs.py)
rim         where the disc ends: at the rim of the layer or where another face cuts it (discs.py)
shape       ratios of the neighbors' deviations: thickness / width (0 in a plane), width / length (0 on a line)

Points are processed in blocks, one after the other, so that a million fit into memory.  A block reads its neighbors
from arrays of all points, which are (columns, points) in this file.

Gradients flow from positions, normals and colors through normals, spacings, ends of discs and colors.  Discrete choices
have no gradient: the neighbors, the plane that the fit of a layer starts from, the neighbor that ends a disc or has
another color, sides and flips of normals, and visibility from each direction.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.kernels.numerics import (
    clamp,
    dot,
    measure_shape,
    normalize,
    safe_sqrt,
    split_blocks,
    tangent_frame,
)
from spnr_jax.kernels.records import AnyArray, PointCloud, Surfels
from spnr_jax.surfels import discs, layers, sides
from spnr_jax.surfels.constants import CONSTANTS
from spnr_jax.surfels.layers import Layer, Neighborhood, project_on
from spnr_jax.surfels.neighbors import measure_evenness, median
from spnr_jax.surfels.sides import choose_cell, choose_grid, compute_visibility

# --- surfels ----------------------------------------------------------------------------------------------------------


class PointColumns(NamedTuple):
    """All points of a cloud as columns, zeros for padding; their neighbors; and which came with an oriented normal."""

    neighbors: Int[Array, "k points"]
    mask: Bool[Array, " points"]
    oriented: Bool[Array, " points"]
    position: Float[Array, "3 points"]
    color: Float[Array, "3 points"]


def estimate_surfels(cloud: PointCloud, neighbors: Int[Array, "points 20"]) -> Surfels:
    """Surfels of the points of a cloud (unbatched) in the box [-1, 1]^3; pure, differentiable, one structure.

    One surfel per point, in the same order; `mask` is False for padding.
    `neighbors` are those of `spnr_jax.neighbors`: each point itself first, -1 for none.  Given normals are scaled to
    length 1; where one is 0, none is given.
    """
    mask = jnp.asarray(cloud.mask)

    def columns(values: AnyArray) -> Array:
        return layers.select(mask, jnp.asarray(values).T, 0)

    normals = None if cloud.normals is None else normalize(columns(cloud.normals).T).T
    points = PointColumns(
        neighbors=layers.select(mask, jnp.asarray(neighbors).T, -1),
        mask=mask,
        oriented=jnp.zeros_like(mask) if normals is None else dot(normals, normals) > 0.5,
        position=columns(cloud.positions),
        color=columns(cloud.base_color),
    )
    raw_spacing, layer = find_layers(points, normals, split_by_color=normals is None)
    visibility = estimate_visibility(points, layer.normal, raw_spacing)
    normal, one_sided = orient_layers(points, raw_spacing, layer, visibility)
    layer_spacing, weight = measure_spacings(points, raw_spacing, layer, normal, one_sided)
    random = jnp.asarray(measure_evenness(cloud, neighbors)) < CONSTANTS.even
    disc = describe_discs(points, raw_spacing, layer, normal, one_sided, layer_spacing, weight, random)
    ones = jnp.ones_like(raw_spacing)

    def rows(values: Array) -> Array:
        return jnp.moveaxis(layers.select(mask, values, 0), -1, 0)

    return Surfels(
        position=rows(points.position),
        normal=rows(normal),
        spacing=jnp.where(mask, disc.spacing, 1),  # its logarithm is taken
        one_sided=rows(one_sided),
        shape_ratios=rows(disc.shape_ratios),
        base_color=rows(points.color),
        roughness=rows(columns(cloud.roughness)),
        metallic=rows(columns(cloud.metallic)),
        materials_unknown=rows(0 * ones if cloud.materials_known is None else 1 - columns(cloud.materials_known)),
        learned=rows(0 * ones if cloud.learned is None else columns(cloud.learned)),
        visibility=rows(average_visibility(points, weight, visibility)),
        rim_tangent=rows(disc.rim_tangent),
        rim_distances=rows(disc.rim_distances),
        color_edge=rows(disc.color_edge),
        color_jump=rows(disc.color_jump),
        mask=mask,
    )


def map_blocks(
    work: Callable[..., Any],
    points: PointColumns,
    columns: Float[Array, "columns points"],
    *own: Any,
) -> Any:
    """The results of `work` for all blocks of points, concatenated.

    `work` receives the neighborhoods of a block (with these columns of the neighbors) and the block's part of the `own`
    arrays (..., points).  All values of a block are packed into one array, so that the loop has one input and one
    output.  The gradient keeps the inputs of a block and recomputes the rest.
    """
    count = points.mask.shape[0]
    size = min(CONSTANTS.block_size, count)
    table = jnp.concatenate([points.position, columns])
    neighbors, packed = points.neighbors, _pack((points.position, own))
    forms: list[Any] = []  # structure of the results, known once `compute` is traced: lax.cond traces it before `skip`

    def compute(neighbors: Array, packed: Array) -> Array:
        real = neighbors[0] >= 0
        first = jnp.argmax(real)  # padding repeats this point: NaN there would reach the gradient of the cloud's first
        neighbors, packed = (jnp.where(real, x, jnp.take(x, first, axis=1)[:, None]) for x in (neighbors, packed))
        positions, values = _unpack(packed, (points.position, own))
        out = work(layers.gather_neighborhoods(neighbors, positions, table), *values)
        forms.append(jax.eval_shape(lambda: out))  # no traced values: they must not leave the function
        return _pack(out)

    def skip(neighbors: Array, packed: Array) -> Array:
        rows = sum(leaf.size // size for leaf in jax.tree.leaves(forms[-1]))
        return jnp.zeros((rows, size), packed.dtype)

    def one(block: tuple[Array, Array]) -> Array:
        return jax.lax.cond(jnp.any(block[0] >= 0), compute, skip, *block)  # blocks of padding cost nothing

    if size == count:
        return _unpack(jax.checkpoint(compute)(neighbors, packed), forms[-1])

    found = jax.lax.map(jax.checkpoint(one), (split_blocks(neighbors, size, -1), split_blocks(packed, size, 0)))
    return _unpack(jnp.moveaxis(found, 0, 1).reshape(found.shape[1], -1)[:, :count], forms[-1])


def _pack(tree: Any) -> Float[Array, "columns points"]:
    """All arrays (..., points) of a pytree stacked into one; booleans become 0 and 1."""
    leaves = jax.tree.leaves(tree)
    kind = jnp.result_type(*(leaf.dtype for leaf in leaves if leaf.dtype != bool))
    return jnp.concatenate([leaf.reshape(-1, leaf.shape[-1]).astype(kind) for leaf in leaves])


def _unpack(packed: Float[Array, "columns points"], form: Any) -> Any:
    """The pytree that was packed, restored to the structure of `form`, for any number of points."""
    leaves, structure = jax.tree.flatten(form)
    found, first = [], 0
    for leaf in leaves:
        rows = leaf.size // leaf.shape[-1]
        values = packed[first : first + rows].reshape(*leaf.shape[:-1], packed.shape[-1])
        found.append(values > 0.5 if leaf.dtype == bool else values)
        first += rows
    return jax.tree.unflatten(structure, found)


def find_layers(
    points: PointColumns,
    normals: Float[Array, "3 points"] | None,
    *,
    split_by_color: bool,
) -> tuple[Float[Array, " points"], Layer]:
    """Raw spacings, and layers from unit normals (0 where there is none).

    Normals are kept; oriented ones separate the two sides of a thin wall.  With `split_by_color`, a point near two
    surfaces closer than the thickness of a layer is assigned to one of them by its linear color.
    """
    roots = safe_sqrt(points.color)

    def fit(hood: Neighborhood, oriented: Array, *own: Array) -> tuple[Array, Layer, layers.SplitLayer | None]:
        raw_spacing = discs.measure_raw_spacing(hood)
        weight = layers.weigh_distance(hood, raw_spacing)
        first, fixed = layers.init_normals(hood, raw_spacing, *own)
        if own:
            weight = weight * jnp.where(oriented[None], clamp(0.5 + project_on(hood.columns[:, 3:], first), 0, 1), 1)
        color_distance = layers.measure_color_distance(hood, hood.columns[:, :3]) if split_by_color else None
        return raw_spacing, *layers.fit_layers(hood, raw_spacing, first, weight, fixed, color_distance)

    given = () if normals is None else (normals,)
    table = jnp.concatenate([roots, *given])
    raw_spacing, layer, split = map_blocks(fit, points, table, points.oriented, *given)
    if split is None:
        return raw_spacing, layer

    def keep_agreed(hood: Neighborhood, layer: Layer, split: layers.SplitLayer) -> Layer:
        color_distance = layers.measure_color_distance(hood, hood.columns[:, :3])
        return layers.keep_agreed_splits(hood, layer, split, color_distance, hood.columns[:, 3])

    table = jnp.concatenate([roots, split.certain[None].astype(raw_spacing.dtype)])
    layer = jax.lax.cond(
        jnp.any(split.certain), lambda: map_blocks(keep_agreed, points, table, layer, split), lambda: layer
    )
    return raw_spacing, layer


def estimate_visibility(
    points: PointColumns,
    normal: Float[Array, "3 points"],
    spacing: Float[Array, " points"],
) -> Float[Array, "64 points"]:
    """Visibility of each point from each of 64 directions."""
    middle, grid = jnp.asarray(median(spacing, points.mask)), int(choose_grid(points.mask.shape[0]))
    cell = choose_cell(middle, jnp.sum(points.mask))
    low, high = CONSTANTS.visibility_spacing_bounds
    bounded = jnp.clip(spacing, low * middle, high * middle)
    return compute_visibility(points.position, normal, bounded, points.mask, cell, grid=grid)


def orient_layers(
    points: PointColumns,
    raw_spacing: Float[Array, " points"],
    layer: Layer,
    visibility: Float[Array, "64 points"],
) -> tuple[Float[Array, "3 points"], Float[Array, " points"]]:
    """Normals that point outward, and the confidence in that (`one_sided`); votes have no gradient."""
    normal, oriented = layer.normal, points.oriented
    position, raw_spacing, layer = jax.lax.stop_gradient((points.position, raw_spacing, layer))
    points = points._replace(position=position)

    def vote(votes: Array, first: Array) -> tuple[Array, None]:
        def combine(hood: Neighborhood, raw_spacing: Array, layer: Layer, oriented: Array) -> Array:
            normals, votes = hood.columns[:, :3], hood.columns[:, 3]
            walls = sides.vote_by_thin_walls(hood, layer, raw_spacing, normals, oriented)
            return sides.average_votes(hood, layer, raw_spacing, normals, votes) + first * walls

        table = jnp.concatenate([layer.normal, votes[None]])
        return jnp.clip(map_blocks(combine, points, table, raw_spacing, layer, oriented), -1, 1), None

    front, back = sides.sum_visibility(layer.normal, visibility)
    votes = (front - back) / (front + back + CONSTANTS.vote_ridge)
    # two rounds of one compiled program; walls count in the first alone
    votes, _ = jax.lax.scan(vote, votes, jnp.asarray([1, 0], raw_spacing.dtype))
    return sides.orient_normals(normal, votes, oriented)


class Discs(NamedTuple):
    """The fields of `Surfels` that follow from layers and sides, as columns."""

    spacing: Float[Array, " points"]
    shape_ratios: Float[Array, "2 points"]
    rim_tangent: Float[Array, "3 points"]
    rim_distances: Float[Array, "4 points"]
    color_edge: Float[Array, "4 points"]
    color_jump: Float[Array, "3 points"]


def describe_discs(
    points: PointColumns,
    raw_spacing: Float[Array, " points"],
    layer: Layer,
    normal: Float[Array, "3 points"],
    one_sided: Float[Array, " points"],
    layer_spacing: Float[Array, " points"],
    weight: Float[Array, "k points"],
    random: Bool[Array, ""],
) -> Discs:
    """Size, rim and colors of each disc; gaps of random points are covered."""

    def describe(
        hood: Neighborhood,
        raw_spacing: Array,
        layer: Layer,
        weight: Array,
        normal: Array,
        one_sided: Array,
    ) -> Discs:
        normals, colors, neighbors_one_sided, spacings = jnp.split(hood.columns, [3, 6, 7], axis=1)
        axes, spacing = tangent_frame(normal), discs.smooth_spacing(weight, spacings[:, 0])
        flat = jnp.stack([project_on(hood.offset, axis) for axis in axes[:2]], axis=1)
        wider = discs.bridge_gaps(flat / spacing[None, None], weight)
        wider = jnp.where(random, wider, 1)
        spacing = spacing * wider
        uv = jax.lax.optimization_barrier(flat / spacing[None, None])
        nearby = (weight > 0.5) & (hood.squared < (CONSTANTS.rim_radius * spacing[None]) ** 2)
        ends = discs.find_farthest(jnp.where(nearby[:, None], uv, 0)) + (CONSTANTS.rim_margin / wider)[None]
        clip_lines = discs.find_clip_lines(hood, axes, spacing, one_sided, normals, neighbors_one_sided[:, 0])
        own = layers.weigh_distance(hood, raw_spacing) * layers.weigh_height(layer)
        shape_ratios = measure_shape(layers.measure_covariance(hood, raw_spacing, own))
        rims = discs.find_rims(ends, clip_lines, axes)
        return Discs(spacing, shape_ratios, *rims, *discs.find_color_edge(uv, weight, spacing, axes, colors))

    table = jnp.concatenate([normal, points.color, one_sided[None], layer_spacing[None]])
    return map_blocks(describe, points, table, raw_spacing, layer, weight, normal, one_sided)


def average_visibility(
    points: PointColumns,
    weight: Float[Array, "k points"],
    visibility: Float[Array, "64 points"],
) -> Float[Array, "64 points"]:
    """Visibility averaged over the nearest neighbors on the same layer: a depth buffer of points is noisy."""
    size, rows, weight = min(CONSTANTS.block_size, len(points.mask)), visibility.T, jax.lax.stop_gradient(weight)

    def one(block: tuple[Array, Array]) -> Array:
        return discs.average_rows(*block, rows)

    count = CONSTANTS.averaged_neighbors
    near = split_blocks(points.neighbors[:count], size, -1), split_blocks(weight[:count], size, 1)
    return jax.lax.map(one, near).reshape(-1, len(visibility))[: len(points.mask)].T


def measure_spacings(
    points: PointColumns,
    raw_spacing: Float[Array, " points"],
    layer: Layer,
    normal: Float[Array, "3 points"],
    one_sided: Float[Array, " points"],
) -> tuple[Float[Array, " points"], Float[Array, "k points"]]:
    """Spacings, and weights of the neighbors as members of the same layer."""

    def weigh(
        hood: Neighborhood, raw_spacing: Array, layer: Layer, normal: Array, one_sided: Array
    ) -> tuple[Array, Array]:
        weight = layers.weigh_layer(hood, layer, normal, one_sided, hood.columns)
        return discs.measure_layer_spacing(hood, weight, raw_spacing), weight

    return map_blocks(weigh, points, normal, raw_spacing, layer, normal, one_sided)
