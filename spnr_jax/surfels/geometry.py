"""Surfels from points: the surface around each point, estimated by one pure program over given neighbors.

neighbors   near points of each point, found once on the host (neighbors.py); integers without a gradient
spacing     side of the square that a point represents.  Three estimates follow each other: the raw spacing from 6
            neighbors on any layer, the spacing from the neighbors on the same layer, and its mean over 9 of these
normal      given, or else that of the layer (layers.py); the outer side is found by votes (sides.py)
one_sided   1 where the votes agree on the outer side, 0 where both sides are equally visible (a two-sided disc)
color_edge  a straight edge between two colors inside a disc; color_jump is the change of color across it (discs.py)
rim         where the disc ends: at the rim of the layer or where another face cuts it (discs.py)
shape       ratios of the neighbors' deviations: thickness / width (0 in a plane), width / length (0 on a line)
scene       surfels in the box, with the transform from the cloud's units: the renderer's input

Points are processed in blocks, one after the other, so that a million fit into memory.  A block reads its neighbors
from arrays of all points, which are (columns, points) in this file.

Gradients flow from positions, normals and colors through normals, spacings, ends of discs and colors.  Discrete choices
have no gradient: the neighbors, the plane that the fit of a layer starts from, the neighbor that ends a disc or has
another color, sides and flips of normals, and visibility from each direction.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.errors import UserError
from spnr_jax.kernels.cloud_arrays import check_cloud
from spnr_jax.kernels.numerics import (
    clamp,
    dot,
    largest,
    length,
    measure_shape,
    safe_sqrt,
    smallest,
    tangent_frame,
    unit,
)
from spnr_jax.kernels.records import AnyArray, PointCloud, Surfels, SurfelScene
from spnr_jax.surfels import discs, layers, sides
from spnr_jax.surfels.layers import CONSTANTS, NEIGHBORS, Layer, Neighborhood, project_on
from spnr_jax.surfels.neighbors import measure_evenness, median
from spnr_jax.surfels.sides import choose_cell, choose_grid, compute_visibility

# --- surfels ----------------------------------------------------------------------------------------------------------


class PointColumns(NamedTuple):
    """All points of a cloud as columns, zeros for padding, and the indices of their neighbors.

    `oriented` says which points came with an oriented normal.
    """

    neighbors: Int[Array, "k points"]
    mask: Bool[Array, " points"]
    oriented: Bool[Array, " points"]
    position: Float[Array, "3 points"]
    color: Float[Array, "3 points"]


def estimate_surfels(cloud: PointCloud, neighbors: Int[Array, "points 20"]) -> Surfels:
    """Surfels of the points of a cloud (unbatched) in the box [-1, 1]^3; pure, differentiable, one structure.

    One surfel per point, in the same order; `mask` is False for padding.
    `neighbors` are those of `spnr_jax.neighbors`: each point itself first, -1 for none.  Given normals are scaled to
    length 1; where one is shorter than 1e-9, none is given.
    """
    mask = jnp.asarray(cloud.mask)

    def columns(values: AnyArray) -> Array:
        return layers.select(mask, jnp.asarray(values).T, 0)

    normals = None if cloud.normals is None else unit(columns(cloud.normals))
    points = PointColumns(
        neighbors=layers.select(mask, jnp.asarray(neighbors).T, -1),
        mask=mask,
        oriented=jnp.zeros_like(mask) if normals is None else dot(normals, normals) > 0.5,
        position=columns(cloud.positions),
        color=columns(cloud.base_color),
    )
    raw_spacing, layer = find_layers(points, normals, oriented=True, split_by_color=normals is None)
    visibility = estimate_visibility(points, layer.normal, raw_spacing)
    normal, one_sided = orient_layers(points, raw_spacing, layer, visibility)
    random = jnp.asarray(measure_evenness(cloud, neighbors)) < CONSTANTS.even
    fields = describe_discs(points, raw_spacing, layer, normal, one_sided, visibility, random)
    known = jnp.ones_like(raw_spacing) if cloud.materials_known is None else columns(cloud.materials_known)
    learned = jnp.zeros_like(raw_spacing) if cloud.learned is None else columns(cloud.learned)
    fields |= {"roughness": columns(cloud.roughness), "metallic": columns(cloud.metallic)}
    fields |= {"materials_unknown": 1 - known, "learned": learned}
    fields |= {"position": points.position, "normal": normal, "base_color": points.color, "one_sided": one_sided}
    fields = {name: jnp.moveaxis(layers.select(mask, values, 0), -1, 0) for name, values in fields.items()}
    fields["spacing"] = jnp.where(mask, fields["spacing"], 1)  # its logarithm is taken
    return Surfels(**fields, mask=mask)


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
        positions, values = _unpack(packed, (points.position, own))
        out = work(layers.gather_neighborhoods(neighbors, positions, table), *values)
        forms.append(out)
        return _pack(out)

    def skip(neighbors: Array, packed: Array) -> Array:
        rows = sum(leaf.size // size for leaf in jax.tree.leaves(forms[-1]))
        return jnp.zeros((rows, size), packed.dtype)

    def one(block: tuple[Array, Array]) -> Array:
        return jax.lax.cond(jnp.any(block[0] >= 0), compute, skip, *block)  # blocks of padding cost nothing

    if size == count:
        return _unpack(jax.checkpoint(compute)(neighbors, packed), forms[-1])

    found = jax.lax.map(jax.checkpoint(one), (_split(neighbors, size, -1), _split(packed, size, 0)))
    return _unpack(jnp.moveaxis(found, 0, 1).reshape(found.shape[1], -1)[:, :count], forms[-1])


def _split(values: Array, size: int, fill: int) -> Array:
    """Columns of all points, padded and split into blocks of this size."""
    blocks = -(-values.shape[1] // size)
    values = jnp.pad(values, [(0, 0), (0, blocks * size - values.shape[1])], constant_values=fill)
    return jnp.moveaxis(values.reshape(len(values), blocks, size), 1, 0)


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
    oriented: bool,
    split_by_color: bool,
) -> tuple[Float[Array, " points"], Layer]:
    """Raw spacings, and layers from unit normals (0 where there is none).

    Normals are kept.  If `oriented`, they separate the two sides of a thin wall.  With `split_by_color`, a point near
    two surfaces closer than the thickness of a layer is assigned to one of them by its linear color.
    """
    roots = safe_sqrt(points.color)

    def fit(hood: Neighborhood, *own: Array) -> tuple[Array, Layer, layers.SplitLayer | None]:
        raw_spacing = discs.measure_raw_spacing(hood)
        weight = layers.weigh_distance(hood, raw_spacing)
        first, fixed = layers.init_normals(hood, raw_spacing, *own)
        if oriented and own:
            weight = weight * jnp.where(fixed[None], clamp(0.5 + project_on(hood.columns[:, 3:], first), 0, 1), 1)
        color_distance = layers.measure_color_distance(hood, hood.columns[:, :3]) if split_by_color else None
        return raw_spacing, *layers.fit_layers(hood, raw_spacing, first, weight, fixed, color_distance)

    given = () if normals is None else (normals,)
    raw_spacing, layer, split = map_blocks(fit, points, jnp.concatenate([roots, *given]), *given)
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
    """Normals that point outward, and the confidence in that (`one_sided`)."""
    normal, fixed = layer.normal, jax.lax.stop_gradient((points.position, raw_spacing, layer))
    position, raw_spacing, layer = fixed
    points = points._replace(position=position)
    front, back = sides.sum_visibility(layer.normal, visibility)

    def vote(votes: Array, first: Array) -> tuple[Array, None]:
        def combine(hood: Neighborhood, raw_spacing: Array, layer: Layer, oriented: Array) -> Array:
            normals, votes = hood.columns[:, :3], hood.columns[:, 3]
            walls = sides.vote_by_thin_walls(hood, layer, raw_spacing, normals, oriented)
            return sides.average_votes(hood, layer, raw_spacing, normals, votes) + first * walls

        table = jnp.concatenate([layer.normal, votes[None]])
        return jnp.clip(map_blocks(combine, points, table, raw_spacing, layer, points.oriented), -1, 1), None

    votes = (front - back) / (front + back + CONSTANTS.vote_ridge)
    towards, _ = jax.lax.scan(vote, votes, jnp.asarray([1, 0], raw_spacing.dtype))
    return sides.orient_normals(normal, towards, points.oriented)


def describe_discs(
    points: PointColumns,
    raw_spacing: Float[Array, " points"],
    layer: Layer,
    normal: Float[Array, "3 points"],
    one_sided: Float[Array, " points"],
    visibility: Float[Array, "64 points"],
    random: Bool[Array, ""],
) -> dict[str, Array]:
    """The fields of `Surfels` that follow from layers and sides (..., points); gaps of random points are covered."""
    layer_spacing, weight = measure_spacings(points, raw_spacing, layer, normal, one_sided)

    def work(
        hood: Neighborhood,
        raw_spacing: Array,
        layer: Layer,
        weight: Array,
        normal: Array,
        one_sided: Array,
    ) -> dict[str, Array]:
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
        rim_tangent, rim_distances = discs.find_rims(ends, clip_lines, axes)
        color_edge = discs.find_color_edge(uv, weight, spacing, axes, colors)
        own = layers.weigh_distance(hood, raw_spacing) * layers.weigh_height(layer)
        return color_edge | {
            "spacing": spacing,
            "shape_ratios": measure_shape(layers.measure_covariance(hood, raw_spacing, own)),
            "rim_tangent": rim_tangent,
            "rim_distances": rim_distances,
        }

    table = jnp.concatenate([normal, points.color, one_sided[None], layer_spacing[None]])
    fields = map_blocks(work, points, table, raw_spacing, layer, weight, normal, one_sided)
    return fields | {"visibility": average_visibility(points, weight, visibility)}


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
    near = _split(points.neighbors[:count], size, -1), _split(weight[:count], size, 1)
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


# --- scenes -----------------------------------------------------------------------------------------------------------


def encode(params: Any, cloud: PointCloud, neighbors: Int[AnyArray, "points 20"]) -> SurfelScene:
    """The surfels of a cloud (unbatched, any units, y up); pure: jit, vmap over equally padded clouds, grad, float64.

    `neighbors` are `spnr_jax.neighbors(cloud)`.  Positions, normals and colors must be finite, also in
    padding.  Surfels do not use `params`; the argument is there for networks that encode.  The result has the same
    structure with and without normals.  Gradients also flow through the normalisation: a shift of all points moves the
    scene's centre.  The docstring of `geometry.py` lists what has no gradient.
    """
    del params
    check_inputs(cloud, neighbors, "encode")
    # a cloud that a jitted function closes over is constant: XLA would take seconds to sort it while compiling
    cloud, neighbors = jax.lax.optimization_barrier((cloud, neighbors))
    inside, centre, scale = normalise_cloud(cloud)
    return make_scene(inside, neighbors, centre, scale)


def check_inputs(cloud: PointCloud, neighbors: Int[AnyArray, "points 20"], where: str) -> None:
    """ValueError, which names the function and the argument, for arrays that do not fit each other."""
    check_cloud(cloud, where)
    if np.shape(neighbors) != (wanted := (len(cloud.mask), NEIGHBORS)):
        found = f"has the shape {np.shape(neighbors)}, expected {wanted}"
        raise UserError(f"{where}: neighbors {found}; they are spnr_jax.neighbors(cloud)")
    if not isinstance(neighbors, jax.core.Tracer):
        values = np.asarray(neighbors)
        low, high = values.min(initial=-1), values.max(initial=-1)
        if not np.issubdtype(values.dtype, np.integer) or low < -1 or high >= len(cloud.mask):
            found = f"are {values.dtype} from {low} to {high}, expected indices of {len(cloud.mask)} points, or -1"
            raise UserError(f"{where}: neighbors {found}; they are spnr_jax.neighbors(cloud)")


def normalise_cloud(cloud: PointCloud) -> tuple[PointCloud, Float[Array, "3"], Float[Array, ""]]:
    """The cloud normalised to the box [-1, 1]^3, in at least float32, and the centre and scale of this transform."""

    def promote(values: AnyArray) -> Array:
        values = jnp.asarray(values)
        return values if values.dtype == jnp.bool_ else values.astype(jnp.promote_types(values.dtype, jnp.float32))

    cloud = jax.tree.map(promote, cloud)
    positions = jnp.asarray(cloud.positions)
    centre, scale = fit_box(positions, jnp.asarray(cloud.mask))
    inside = clamp((positions - centre[None]) * scale, -1, 1)
    return dataclasses.replace(cloud, positions=inside), centre, scale


def fit_box(
    positions: Float[AnyArray, "points 3"], mask: Bool[AnyArray, " points"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Centre and scale: (positions - centre) * scale has its bounding box around 0, with half diagonal 1.

    The scale of points without extent is 1.  Masked points do not count.
    """
    some = jnp.any(mask)
    low = smallest(jnp.where(mask[:, None], positions, jnp.inf))
    high = largest(jnp.where(mask[:, None], positions, -jnp.inf))
    low, high = jnp.where(some, low, 0), jnp.where(some, high, 0)
    diagonal = length(high - low)
    scale = jnp.where(diagonal > 0, 2 / jnp.where(diagonal > 0, diagonal, 1), 1)
    return low / 2 + high / 2, scale


def make_scene(
    cloud: PointCloud,
    neighbors: Int[AnyArray, "points 20"],
    centre: Array,
    scale: Array,
) -> SurfelScene:
    """The scene of a cloud that is already in the box; centre and scale are those of its transform."""
    surfels = estimate_surfels(cloud, jnp.asarray(neighbors))
    spacing = median(jnp.asarray(surfels.spacing), jnp.asarray(surfels.mask))
    return SurfelScene(surfels=surfels, spacing=spacing, centre=centre, scale=scale)
