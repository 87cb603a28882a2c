"""Surfels from points: the surface around each point, estimated by one pure program over given neighbors.

neighbors   the nearest points of each point, found once on the host with a k-d tree; integers without a gradient
spacing     side of the square that a point represents, from the neighbors on the same layer of the surface
normal      given, or else that of the layer (layers.py); the outer side is found by votes (sides.py)
sided       1 where the votes agree on the outer side, 0 where both sides are equally visible (a sheet)
border      a straight border between two colors inside a disc, and the jump of color across it (discs.py)
rim, reach  where the disc ends: at the rim of the layer or where another face cuts it (discs.py)
shape       planarity and linearity: ratios of the neighbors' extents, 0 in a plane, 0 on a line
scene       surfels in the box, with the transform from the cloud's units: the renderer's input

Points are processed in blocks, one after the other, so that a million fit into memory.  A block reads its neighbors
from arrays of all points, which are (columns, points) in this file.

Gradients flow from positions, normals and colors through normals, spacings, ends of discs and colors.  Discrete choices
are constants without a gradient: the neighbors, the plane that the fit of a layer starts from, the neighbor that ends a
disc or has another color, sides and flips of normals, and visibility from each direction.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from spnr_jax.kernels.numerics import clamp, dot, frame, largest, length, measure_shape, root, smallest, unit
from spnr_jax.kernels.records import AnyArray, PointCloud, Surfels, SurfelScene
from spnr_jax.surfels import discs, layers, sides
from spnr_jax.surfels.layers import NEIGHBORS, RULES, Hood, Layer, Rules, along
from spnr_jax.surfels.sides import cell_of, grid_of, see_directions

# --- neighbors, on the host -------------------------------------------------------------------------------------------


BLOCK = 2**14  # points per query of the k-d tree


def neighbors(cloud: PointCloud) -> Int[np.ndarray, "*batch points 20"]:
    """Indices of the 20 nearest points of each point, itself first; -1 where there are fewer, and for padding.

    NumPy on the host: cannot be traced.  Clouds may have leading batch axes.
    """
    positions, mask = np.asarray(cloud.positions), np.asarray(cloud.mask)
    found = np.full((*mask.shape, NEIGHBORS), -1, np.int32)
    for cloud_index in np.ndindex(mask.shape[:-1]):
        real = np.flatnonzero(mask[cloud_index])
        if len(real):
            near = nearest(positions[cloud_index][real])
            found[cloud_index][real] = np.where(near < 0, -1, real[near])
    return found


def nearest(positions: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, "points 20"]:
    """Indices of the nearest points of real points, -1 where there are fewer; each point is its own first neighbor."""
    return _ask(cKDTree(positions), np.arange(len(positions)))


def order_in_space(
    positions: Float[np.ndarray, "points 3"],
) -> tuple[Int[np.ndarray, " points"], Int[np.ndarray, "points 20"]]:
    """An order of the points that keeps close points close in memory, and the neighbors of the points in that order.

    What a block of ordered points gathers fits into the cache.
    """
    tree = cKDTree(positions)
    order = tree.indices
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    near = _ask(tree, order)
    return order, np.where(near < 0, np.int32(-1), place[near])


def _ask(tree: cKDTree, asked: Int[np.ndarray, " some"]) -> Int[np.ndarray, "some 20"]:
    """Neighbors of the points with these indices, -1 for none; each point comes first, even among duplicates."""
    ranks = list(range(1, min(NEIGHBORS, tree.n) + 1))
    blocks = [asked[i : i + BLOCK] for i in range(0, len(asked), BLOCK)]
    found = np.concatenate([tree.query(tree.data[rows], ranks, workers=-1)[1].astype(np.int32) for rows in blocks])
    wrong = np.flatnonzero(found[:, 0] != asked)
    if len(wrong):
        own = found[wrong] == asked[wrong, None]
        lost = ~own.any(axis=1)  # the point is missing from its own list: it has too many duplicates
        own[lost, -1], found[wrong[lost], -1] = True, asked[wrong[lost]]
        found[wrong] = np.take_along_axis(found[wrong], np.argsort(~own, axis=1, kind="stable"), axis=1)
    return np.pad(found, [(0, 0), (0, NEIGHBORS - found.shape[1])], constant_values=-1)


# --- surfels ----------------------------------------------------------------------------------------------------------


class Points(NamedTuple):
    """All points of a cloud as columns, zeros for padding, and the indices of their neighbors.

    `given` says which points came with an oriented normal.
    """

    number: Int[Array, "k points"]
    mask: Bool[Array, " points"]
    given: Bool[Array, " points"]
    position: Float[Array, "3 points"]
    color: Float[Array, "3 points"]


def estimate_surfels(cloud: PointCloud, neighbors: Int[Array, "points 20"], rules: Rules = RULES) -> Surfels:
    """Surfels of the points of a cloud (unbatched) in the box [-1, 1]^3; pure, differentiable, one structure.

    One surfel per point, in the same order; `mask` is False for padding.
    `neighbors` are those of `spnr_jax.neighbors`: each point itself first, -1 for none.  A given normal may have any
    length; length 0 means that it is not given.
    """
    mask = jnp.asarray(cloud.mask)

    def columns(values: AnyArray) -> Array:
        return layers.select(mask, jnp.asarray(values).T, 0)

    normals = None if cloud.normals is None else unit(columns(cloud.normals))
    points = Points(
        number=layers.select(mask, jnp.asarray(neighbors).T, -1),
        mask=mask,
        given=jnp.zeros_like(mask) if normals is None else dot(normals, normals) > 0.5,
        position=columns(cloud.positions),
        color=columns(cloud.base_color),
    )
    raw, layer = find_layers(points, normals, sided=True, sheets=normals is None, rules=rules)
    seen = estimate_visibility(points, layer.normal, raw, rules)
    normal, sided = find_sides(points, raw, layer, seen, rules)
    fields = describe(points, raw, layer, normal, sided, seen, rules)
    known = jnp.ones_like(raw) if cloud.materials_known is None else columns(cloud.materials_known)
    learned = jnp.zeros_like(raw) if cloud.invented is None else columns(cloud.invented)
    fields |= {"roughness": columns(cloud.roughness), "metallic": columns(cloud.metallic)}
    fields |= {"guessed": 1 - known, "invented": learned}
    fields |= {"position": points.position, "normal": normal, "base_color": points.color, "sided": sided}
    fields = {name: jnp.moveaxis(layers.select(mask, values, 0), -1, 0) for name, values in fields.items()}
    fields["spacing"] = jnp.where(mask, fields["spacing"], 1)  # its logarithm is taken
    return Surfels(**fields, mask=mask)


def median(values: Float[Array, " points"], mask: Bool[Array, " points"]) -> Float[Array, ""]:
    """Median of the values where the mask is True; of none, 1."""
    count = jnp.sum(mask)
    ordered = jnp.sort(jnp.where(mask, values, jnp.inf))
    both = ordered[jnp.stack([jnp.maximum(count - 1, 0) // 2, jnp.minimum(count // 2, len(values) - 1)])]
    return jnp.where(count > 0, jnp.mean(jnp.where(count > 0, both, 1)), 1)


def map_blocks(
    work: Callable[..., Any], points: Points, columns: Float[Array, "columns points"], rules: Rules, *own: Any
) -> Any:
    """The results of `work` for all blocks of points, concatenated.

    `work` receives the neighborhoods of a block (with these columns of the neighbors), the neighbors' indices, and the
    block's part of the `own` arrays (..., points).  All values of a block travel in one array.  For the gradient, only
    the inputs of a block are kept, and the block is computed again.
    """
    count = points.mask.shape[0]
    size = min(rules.block, count)
    table = jnp.concatenate([points.position, columns])
    number, packed = points.number, _pack((points.position, own))
    forms: list[Any] = []

    def compute(number: Array, packed: Array) -> Array:
        place, values = _unpack(packed, (points.position, own))
        out = work(layers.look_around(number, place, table), number, *values)
        forms.append(out)
        return _pack(out)

    def skip(number: Array, packed: Array) -> Array:
        rows = sum(leaf.size // size for leaf in jax.tree.leaves(forms[-1]))
        return jnp.zeros((rows, size), packed.dtype)

    def one(block: tuple[Array, Array]) -> Array:
        return jax.lax.cond(jnp.any(block[0] >= 0), compute, skip, *block)  # blocks of padding cost nothing

    if size == count:
        return _unpack(jax.checkpoint(compute)(number, packed), forms[-1])

    found = jax.lax.map(jax.checkpoint(one), (_split(number, size, -1), _split(packed, size, 0)))
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
    points: Points,
    normals: Float[Array, "3 points"] | None,
    *,
    sided: bool,
    sheets: bool,
    rules: Rules = RULES,
) -> tuple[Float[Array, " points"], Layer]:
    """First spacings, and layers from unit normals (0 where there is none).

    Normals are kept.  If `sided`, they are oriented, and separate the two sides of a wall.  With `sheets`, a point near
    two sheets closer than the thickness of a layer is assigned to one of them by its linear color.
    """
    roots = root(points.color)

    def fit(hood: Hood, number: Array, *own: Array) -> tuple[Array, Layer, layers.Sheets | None]:
        raw = discs.first_spacing(hood, rules)
        weight = layers.weigh_near(hood, raw, rules)
        first, firm = layers.begin_normals(hood, raw, *own, rules=rules)
        if sided and own:
            weight = weight * jnp.where(firm[None], clamp(0.5 + along(hood.columns[:, 3:], first), 0, 1), 1)
        unlike = layers.compare_colors(hood, hood.columns[:, :3], rules) if sheets else None
        return raw, *layers.fit_layers(hood, raw, first, weight, firm, unlike, rules)

    given = () if normals is None else (normals,)
    raw, layer, found = map_blocks(fit, points, jnp.concatenate([roots, *given]), rules, *given)
    if found is None:
        return raw, layer

    def agree(hood: Hood, number: Array, layer: Layer, found: layers.Sheets) -> Layer:
        unlike = layers.compare_colors(hood, hood.columns[:, :3], rules)
        return layers.agree_on_sheets(hood, layer, found, unlike, hood.columns[:, 3], rules)

    table = jnp.concatenate([roots, found.certain[None].astype(raw.dtype)])
    layer = jax.lax.cond(
        jnp.any(found.certain), lambda: map_blocks(agree, points, table, rules, layer, found), lambda: layer
    )
    return raw, layer


def estimate_visibility(
    points: Points, normal: Float[Array, "3 points"], spacing: Float[Array, " points"], rules: Rules = RULES
) -> Float[Array, "64 points"]:
    """Visibility of each point from each of 64 directions."""
    middle, grid = median(spacing, points.mask), grid_of(points.mask.shape[0])
    low, high = rules.bounds_seen
    bounded = jnp.clip(spacing, low * middle, high * middle)
    return see_directions(points.position, normal, bounded, points.mask, cell_of(middle, grid), grid=grid)


def find_sides(
    points: Points,
    raw: Float[Array, " points"],
    layer: Layer,
    seen: Float[Array, "64 points"],
    rules: Rules = RULES,
) -> tuple[Float[Array, "3 points"], Float[Array, " points"]]:
    """Normals that point outward, and the confidence in that (`sided`)."""
    turned, fixed = layer.normal, jax.lax.stop_gradient((points.position, raw, layer))
    position, raw, layer = fixed
    points = points._replace(position=position)
    front, back = sides.count_facing(layer.normal, seen)

    def vote(votes: Array, first: Array) -> tuple[Array, None]:
        def share(hood: Hood, number: Array, raw: Array, layer: Layer, given: Array) -> Array:
            normals, votes = hood.columns[:, :3], hood.columns[:, 3]
            walls = sides.vote_of_walls(hood, layer, raw, normals, given, rules)
            return sides.share_votes(hood, layer, raw, normals, votes, rules) + first * walls

        table = jnp.concatenate([layer.normal, votes[None]])
        return jnp.clip(map_blocks(share, points, table, rules, raw, layer, points.given), -1, 1), None

    leans = (front - back) / (front + back + rules.evidence)
    towards, _ = jax.lax.scan(vote, leans, jnp.asarray([1, 0], raw.dtype))
    return sides.turn_outward(turned, towards, points.given, rules)


def describe(
    points: Points,
    raw: Float[Array, " points"],
    layer: Layer,
    normal: Float[Array, "3 points"],
    sided: Float[Array, " points"],
    seen: Float[Array, "64 points"],
    rules: Rules = RULES,
) -> dict[str, Array]:
    """The fields of `Surfels` that follow from layers and sides (..., points)."""
    rough, weight, random = find_spacings(points, raw, layer, normal, sided, rules)

    def work(
        hood: Hood, number: Array, raw: Array, layer: Layer, weight: Array, normal: Array, sided: Array
    ) -> dict[str, Array]:
        normals, colors, sides, spacings = jnp.split(hood.columns, [3, 6, 7], axis=1)
        axes, spacing = frame(normal), discs.smooth_spacing(weight, spacings[:, 0], rules)
        flat = jnp.stack([along(hood.offset, axis) for axis in axes[:2]], axis=1)
        wider = discs.bridge_gaps(flat / spacing[None, None], weight, rules)
        spacing = spacing * jnp.where(random, wider, 1)
        place = jax.lax.optimization_barrier(flat / spacing[None, None])
        there = (weight > 0.5) & (hood.squared < (rules.rim_within * spacing[None]) ** 2)
        ends = discs.find_farthest(jnp.where(there[:, None], place, 0)) + rules.beyond
        cuts = discs.find_cuts(hood, axes, spacing, sided, normals, sides[:, 0], rules)
        rim, reach = discs.find_rims(ends, cuts, axes, rules)
        fitted = discs.find_border(place, weight, spacing, axes, colors, rules)
        own = layers.weigh_near(hood, raw, rules) * layers.weigh_height(layer)
        return fitted | {
            "spacing": spacing,
            "shape": measure_shape(layers.measure_covariance(hood, raw, own)),
            "rim": rim,
            "reach": reach,
        }

    table = jnp.concatenate([normal, points.color, sided[None], rough[None]])
    fields = map_blocks(work, points, table, rules, raw, layer, weight, normal, sided)
    return fields | {"visible": average_seen(points, weight, seen, rules)}


def average_seen(
    points: Points, weight: Float[Array, "k points"], seen: Float[Array, "64 points"], rules: Rules = RULES
) -> Float[Array, "64 points"]:
    """Visibility averaged over the nearest neighbors on the same layer: a depth buffer of points is noisy."""
    size, rows, weight = min(rules.block, len(points.mask)), seen.T, jax.lax.stop_gradient(weight)

    def one(block: tuple[Array, Array]) -> Array:
        return discs.average(*block, rows)

    near = _split(points.number[: rules.smoothed], size, -1), _split(weight[: rules.smoothed], size, 1)
    return jax.lax.map(one, near).reshape(-1, len(seen))[: len(points.mask)].T


def find_spacings(
    points: Points,
    raw: Float[Array, " points"],
    layer: Layer,
    normal: Float[Array, "3 points"],
    sided: Float[Array, " points"],
    rules: Rules = RULES,
) -> tuple[Float[Array, " points"], Float[Array, "k points"], Bool[Array, ""]]:
    """Spacings, weights of the neighbors as members of the same layer, and whether the points are random (not even)."""

    def weigh(
        hood: Hood, number: Array, raw: Array, layer: Layer, normal: Array, sided: Array
    ) -> tuple[Array, Array, Array]:
        weight = layers.weigh_layer(hood, layer, normal, sided, hood.columns, rules)
        spacing = discs.own_spacing(hood, weight, raw, rules)
        return spacing, weight, discs.measure_evenness(*jax.lax.stop_gradient((hood, weight, spacing)))

    rough, weight, evenness = map_blocks(weigh, points, normal, rules, raw, layer, normal, sided)
    random = median(evenness, points.mask) < rules.even
    return jnp.where(random, rough, jnp.minimum(rough, rules.most_even * raw)), weight, random


# --- scenes -----------------------------------------------------------------------------------------------------------


def encode(params: Any, cloud: PointCloud, neighbors: Int[AnyArray, "points 20"]) -> SurfelScene:
    """The surfels of a cloud (unbatched, any units, y up); pure: jit, vmap over equally padded clouds, grad, float64.

    `neighbors` are `spnr_jax.neighbors(cloud)`.  Positions, normals and colors must be finite, also in
    padding.  Surfels do not use `params`; the argument is there for networks that encode.  The result has the same
    structure with and without normals.  Gradients also flow through the normalisation: a shift of all points moves the
    scene's centre.  The docstring of `geometry.py` lists what has no gradient.
    """
    del params
    inside, centre, scale = move_into_box(cloud)
    return make_scene(inside, neighbors, centre, scale, RULES)


def move_into_box(cloud: PointCloud) -> tuple[PointCloud, Float[Array, "3"], Float[Array, ""]]:
    """The cloud normalised to the box [-1, 1]^3, and the centre and scale of this transform."""
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
    cloud: PointCloud, neighbors: Int[AnyArray, "points 20"], centre: Array, scale: Array, rules: Rules
) -> SurfelScene:
    """The scene of a cloud that is already in the box; centre and scale are those of its transform."""
    surfels = estimate_surfels(cloud, jnp.asarray(neighbors), rules)
    spacing = median(jnp.asarray(surfels.spacing), jnp.asarray(surfels.mask))
    return SurfelScene(surfels=surfels, spacing=spacing, centre=centre, scale=scale)
