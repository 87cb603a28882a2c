"""Points to volume and back (scatter to voxels, trilinear lookup), and empty-space skipping.

A scatter is a sum: each point adds its features, over the number of points in its voxel, to the voxel
(`mean_contributions`).  `gather_rows` and `scatter_rows` are each other's transpose.  Under vmap, either is one
gather or scatter in the concatenated tables of all batch elements, because XLA's batched scatter on a CPU is a loop,
about four times slower (32^3 voxels, 2 objects).  On a device mesh each group of objects has its own table, else XLA
could not know that rows stay on their device.

A volume covers the box [-1, 1]^3 with D voxels along each axis and is indexed (z, y, x, features); voxel i of an axis
covers [-1 + 2 i / D, -1 + 2 (i + 1) / D].  Positions are (x, y, z).  In grid coordinates, (position + 1) * D / 2, voxel
centres lie at i + 0.5.  Leading batch axes pair a volume with its positions.

A ray is cut into equal cells; cells whose middle is in a voxel near points are `open` (occupied segments).  `travelled`
is the length of the open cells up to a distance.  Samples lie in the concatenated open segments, so none falls into a
gap, and a gap adds no interval length.  Outside the open cells, density is 0 by definition.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.devices.programs import object_groups
from spnr_jax.errors import UserError
from spnr_jax.kernels import sampling
from spnr_jax.kernels.numerics import clamp
from spnr_jax.kernels.records import Rays, Record

NEIGHBORS = tuple((z, y, x) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1))

# --- rows -------------------------------------------------------------------------------------------------------------


def _end_to_end(function, table, index, *values):
    """`function` of mapped tables (b, rows, c), concatenated to (b * rows, c), and of indices (b, *shape) into that."""
    offsets = table.shape[1] * jnp.arange(len(table), dtype=index.dtype).reshape(-1, *[1] * (index.ndim - 1))
    return function(table.reshape(-1, *table.shape[2:]), index + offsets, *values)


def _by_group(function, plain, *arguments):
    """`function` of the concatenated tables of all objects; on a device mesh, `plain` of those of each group."""
    groups = object_groups(len(arguments[0]))
    if groups == 1:
        return _end_to_end(function, *arguments)
    return jax.vmap(partial(_end_to_end, plain))(*(x.reshape(groups, -1, *x.shape[1:]) for x in arguments))


def _plain_gather(table, index):
    return table.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _plain_scatter(table, index, values):
    return table.at[index].add(values, mode="promise_in_bounds", wrap_negative_indices=False)


_gather = jax.custom_batching.custom_vmap(_plain_gather)
_scatter = jax.custom_batching.custom_vmap(_plain_scatter)


@_gather.def_vmap
def _gather_vmap(axis_size, in_batched, table, index):
    if not in_batched[0]:
        return _gather(table, index), True
    if not in_batched[1]:
        index = jnp.broadcast_to(index, (axis_size, *index.shape))
    rows = _by_group(_gather, _plain_gather, table, index)
    return rows.reshape(*index.shape, *table.shape[2:]), True


@_scatter.def_vmap
def _scatter_vmap(axis_size, in_batched, *arguments):
    def broadcast(x, batched):
        return x if batched else jnp.broadcast_to(x, (axis_size, *x.shape))

    arguments = tuple(map(broadcast, arguments, in_batched))
    return _by_group(_scatter, _plain_scatter, *arguments).reshape(arguments[0].shape), True


@jax.custom_vjp
def gather_rows(table: Float[Array, "rows features"], index: Int[Array, "*batch"]) -> Float[Array, "*batch features"]:
    """table[index]; every index must be in [0, rows)."""
    return _gather(table, index)


def _gather_fwd(table, index):
    return gather_rows(table, index), (index, table.shape[0])


def _gather_bwd(residuals, cotangent):
    index, rows = residuals
    return scatter_rows(index, cotangent, rows), np.zeros(index.shape, jax.dtypes.float0)


gather_rows.defvjp(_gather_fwd, _gather_bwd)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def scatter_rows(
    index: Int[Array, "*batch"], values: Float[Array, "*batch features"], rows: int
) -> Float[Array, "rows features"]:
    """Table whose row r is the sum of the values with index r; every index must be in [0, rows)."""
    return _scatter(jnp.zeros((rows, values.shape[-1]), values.dtype), index, values)


scatter_rows.defvjp(
    lambda index, values, rows: (scatter_rows(index, values, rows), index),
    lambda rows, index, cotangent: (np.zeros(index.shape, jax.dtypes.float0), gather_rows(cotangent, index)),
)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def blend_rows(
    table: Float[Array, "rows features"],
    lowest: Int[Array, " batch"],
    weights: Float[Array, "batch k"],
    steps: tuple[int, ...],
) -> Float[Array, "batch features"]:
    """Sum over k of weights[:, k] * table[lowest + steps[k]]; every row must be in the table.

    The gradient adds all k shares to one table, where the gradient of k gathers would add up k tables.
    """
    out = jnp.zeros((lowest.shape[0], table.shape[1]), table.dtype)
    for k, step in enumerate(steps):
        out = out + weights[:, k, None] * _gather(table, lowest + step)
    return out


def _blend_fwd(table, lowest, weights, steps):
    return blend_rows(table, lowest, weights, steps), (table, lowest, weights)


def _blend_bwd(steps, residuals, cotangent):
    table, lowest, weights = residuals
    sums, shares = jnp.zeros_like(table), []
    for k, step in enumerate(steps):
        sums = _scatter(sums, lowest + step, weights[:, k, None] * cotangent)
        shares.append(jnp.sum(cotangent * _gather(table, lowest + step), axis=-1))
    return sums, np.zeros(lowest.shape, jax.dtypes.float0), jnp.stack(shares, axis=-1)


blend_rows.defvjp(_blend_fwd, _blend_bwd)


# --- voxels -----------------------------------------------------------------------------------------------------------


def locate(
    positions: Float[Array, "*batch 3"], resolution: int
) -> tuple[Int[Array, "*batch 3"], Float[Array, "*batch 3"]]:
    """Voxel (x, y, z) of each position, clamped to the grid, and the offset from its centre in voxels."""
    cell = voxel_of(positions, resolution)
    return cell, (positions + 1) * (0.5 * resolution) - cell - 0.5


def voxel_of(positions: Float[Array, "*batch"], resolution: int) -> Int[Array, "*batch"]:
    """Number of the voxel along an axis, clamped to the grid, of each position along it in [-1, 1]."""
    cell = jnp.floor((positions + 1) * (0.5 * resolution))
    return jnp.clip(cell, 0, resolution - 1).astype(jnp.int32)


def row_of(cell: Int[Array, "*batch 3"], valid: Bool[Array, "*batch"], resolution: int) -> Int[Array, "*batch"]:
    """Row of each voxel in the flattened volume; invalid voxels go to the spare row resolution ** 3."""
    return jnp.where(valid, row_at(cell[..., 0], cell[..., 1], cell[..., 2], resolution), resolution**3)


def row_at(x: Int[Array, "*batch"], y: Int[Array, "*batch"], z: Int[Array, "*batch"], resolution: int):
    """Row of the voxel x, y, z in the flattened volume, with the shape of x."""
    return (z * resolution + y) * resolution + x


def voxel_rows(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"], resolution: int
) -> tuple[Int[Array, " points"], Bool[Array, " points"]]:
    """Row of each point in the flattened volume, and whether it counts: not if masked or outside the box."""
    valid = mask & jnp.all(jnp.abs(positions) <= 1, axis=-1)
    return row_of(locate(positions, resolution)[0], valid, resolution), valid


def mark_occupied(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"], resolution: int
) -> Bool[Array, "d d d"]:
    """Whether each voxel holds a point; masked points and points outside the box do not count."""
    rows, _ = voxel_rows(positions, mask, resolution)
    return jnp.zeros(resolution**3 + 1, bool).at[rows].set(True)[:-1].reshape(*[resolution] * 3)


def mean_contributions(
    positions: Float[Array, "points 3"],
    features: Float[Array, "points features"],
    mask: Bool[Array, " points"],
    resolution: int,
) -> tuple[Int[Array, " points"], Float[Array, "points features+1"]]:
    """Rows of the flattened volume, and each point's contribution to the means of features and to occupancy."""
    rows, valid = voxel_rows(positions, mask, resolution)
    ones = valid.astype(positions.dtype)
    count = gather_rows(scatter_rows(rows, ones[:, None], resolution**3 + 1), rows)[:, 0]
    share = ones / jnp.maximum(count, 1)
    return rows, jnp.concatenate([features, jnp.ones_like(features[..., :1])], axis=-1) * share[:, None]


def scatter_mean(
    positions: Float[Array, "*batch points 3"],
    features: Float[Array, "*batch points features"],
    mask: Bool[Array, "*batch points"],
    resolution: int,
) -> tuple[Float[Array, "*batch d d d features"], Float[Array, "*batch d d d"]]:
    """Mean of the point features in each voxel (0 where there is none), and 1 where a voxel holds a point.

    Masked points and points outside the box are dropped.  ValueError for arrays of other numbers of points.
    """
    shapes = positions.shape[:-1], features.shape[:-1], mask.shape
    if len(set(shapes)) > 1:
        raise UserError(f"scatter_mean: positions, features and mask are of {shapes} points; expected the same")
    if positions.ndim > 2:
        return jax.vmap(lambda p, f, m: scatter_mean(p, f, m, resolution))(positions, features, mask)
    rows, values = mean_contributions(positions, features, mask, resolution)
    summed = scatter_rows(rows, values, resolution**3 + 1)[:-1].reshape(*[resolution] * 3, -1)
    return summed[..., :-1], summed[..., -1]


def scatter_conv(
    rows: Int[Array, " points"],
    values: Float[Array, "points features"],
    kernel: Float[Array, "3 3 3 features out"],
    resolution: int,
) -> Float[Array, "d d d out"]:
    """3^3 convolution (zero padding) of the volume that `values` sum to, computed from the occupied voxels only.

    The result equals a convolution of the scattered volume: each point adds its 27 products to the neighbours of its
    voxel.  With 1024 points 3 % of a 32^3 grid is occupied.
    """
    products = jnp.einsum("pf,tfo->pto", values, kernel.reshape(27, *kernel.shape[3:]), precision="highest")
    # the output at voxel v reads voxel v + n through tap n: a point contributes to its neighbours at -n
    steps = -jnp.array([NEIGHBORS], jnp.int32)
    cell = jnp.stack([rows // resolution**2, rows // resolution % resolution, rows % resolution], axis=-1)
    cell = cell[:, None] + steps
    valid = (rows < resolution**3)[:, None] & jnp.all((cell >= 0) & (cell < resolution), axis=-1)
    target = row_of(cell[..., ::-1], valid, resolution)
    volume = scatter_rows(target.reshape(-1), products.reshape(-1, products.shape[-1]), resolution**3 + 1)
    return volume[:-1].reshape(*[resolution] * 3, -1)


def trilinear(
    volume: Float[Array, "*objects d d d features"],
    positions: Float[Array, "*batch 3"],
    objects: Int[Array, "*batch"] | None = None,
) -> Float[Array, "*batch features"]:
    """Features interpolated between the eight nearest voxel centres; zero outside [-1, 1]^3.

    The first axes of the positions are the objects of the volume, unless `objects` gives each position's
    object.  Within half a voxel of the border, the outermost centres are used.
    """
    if volume.ndim > 4 and objects is None:
        return jax.vmap(trilinear)(volume, positions)
    resolution = volume.shape[-2]
    lowest, weights, steps = find_corners(positions, resolution)
    if objects is not None:
        lowest = lowest + objects.reshape(-1) * resolution**3
    out = blend_rows(volume.reshape(-1, volume.shape[-1]), lowest, weights, steps)
    return out.reshape(*positions.shape[:-1], volume.shape[-1])


def find_corners(
    positions: Float[Array, "*batch 3"], resolution: int
) -> tuple[Int[Array, " n"], Float[Array, "n 8"], tuple[int, ...]]:
    """First row of the eight nearest voxel centres in the flattened volume, their weights, and the steps between them.

    Positions are flattened; weights sum to 1, and are 0 outside the box.
    """
    inside = jnp.all(jnp.abs(positions) <= 1, axis=-1)
    grid = clamp((positions + 1) * (0.5 * resolution) - 0.5, 0, resolution - 1)
    cell = jnp.clip(jnp.floor(grid), 0, max(resolution - 2, 0))
    upper = grid - jax.lax.stop_gradient(cell)
    x, y, z = (cell[..., axis].reshape(-1).astype(jnp.int32) for axis in range(3))
    lowest = row_at(x, y, z, resolution)
    places = list(itertools.product((0, 1), repeat=3))
    x, y, z = (jnp.stack([1 - upper[..., axis], upper[..., axis]]) for axis in range(3))
    weights = jnp.stack([jnp.where(inside, x[i] * y[j] * z[k], 0) for i, j, k in places], axis=-1)
    next_voxel = min(resolution - 1, 1)  # a volume of one voxel has no next one
    steps = tuple(next_voxel * (i + resolution * (j + resolution * k)) for i, j, k in places)
    return lowest, weights.reshape(-1, 8), steps


# --- empty space ------------------------------------------------------------------------------------------------------


class RayPath(Record):
    """Cells along rays: their sorted `edges`, distances along the ray, and the open length up to each edge."""

    edges: Float[Array, "*batch cells+1"]
    travelled: Float[Array, "*batch cells+1"]


def dilate(occupied: Bool[Array, "*batch d d d"], reach: int) -> Bool[Array, "*batch d d d"]:
    """Voxels within `reach` voxels, along every axis, of an occupied one."""
    for axis in (-3, -2, -1):
        window, padding = [1] * occupied.ndim, [(0, 0)] * occupied.ndim
        window[axis], padding[axis] = 2 * reach + 1, (reach, reach)
        occupied = jax.lax.reduce_window(occupied, False, jax.lax.bitwise_or, window, [1] * occupied.ndim, padding)
    return occupied


def open_path(
    near_points: Bool[Array, "*objects d d d"],
    rays: Rays,
    near: Float[Array, "*batch"],
    far: Float[Array, "*batch"],
    num_cells: int,
    objects: Int[Array, "*batch"] | None = None,
) -> RayPath:
    """Cells between near and far; the first axes of the rays are the objects of `near_points`.  No gradient.

    With `objects`, the object of each ray, the rays may have any axes.  A cell is open if the voxel at its middle is
    near points; on a face between two voxels, rounding decides.
    """
    if near_points.ndim > 3 and objects is None:
        return jax.vmap(partial(open_path, num_cells=num_cells))(near_points, rays, near, far)
    near, far = near[..., None], far[..., None]
    fractions = jnp.arange(num_cells + 1, dtype=near.dtype).reshape(*[1] * (near.ndim - 1), -1) / num_cells
    edges = near + (far - near) * fractions
    middles = 0.5 * (edges[..., 1:] + edges[..., :-1])
    resolution = near_points.shape[-1]
    # an axis at a time: the voxels of all cells are then found in one loop
    x, y, z = (
        voxel_of(rays.origins[..., i, None] + middles * rays.directions[..., i, None], resolution) for i in range(3)
    )
    first = 0 if objects is None else objects[..., None] * resolution**3
    is_open = gather_rows(near_points.reshape(-1, 1).astype(near.dtype), first + row_at(x, y, z, resolution))[..., 0]
    # count equal cells by a matrix product: a running sum is slower on a CPU, docs/lab/cpu_forms.md
    count = is_open @ jnp.triu(jnp.ones((num_cells, num_cells + 1), near.dtype), 1)
    return jax.lax.stop_gradient(RayPath(edges=edges, travelled=count * ((far - near) / num_cells)))


def whole_path(near: Float[Array, "*batch"], far: Float[Array, "*batch"]) -> RayPath:
    """The whole ray between near and far as one open cell."""
    return RayPath(
        edges=jnp.stack([near, far], axis=-1), travelled=jnp.stack([jnp.zeros_like(near), far - near], axis=-1)
    )


def distance_at(path: RayPath, travelled: Float[Array, "*batch samples"]) -> Float[Array, "*batch samples"]:
    """Distance along the ray at which the open length is `travelled`; at a gap, the end of the cell in front of it.

    Values beyond the open length of the ray end at the last edge.
    """
    ends = path.travelled[..., 1:]
    if ends.shape[-1] == 1:
        return jnp.clip(path.edges[..., :1] + travelled, path.edges[..., :1], path.edges[..., 1:])
    index = jnp.minimum(sampling.count_at_most(ends, travelled, strictly=True), ends.shape[-1] - 1)
    start, behind = (jnp.take_along_axis(x[..., :-1], index, axis=-1) for x in (path.edges, path.travelled))
    end = jnp.take_along_axis(path.edges[..., 1:], index, axis=-1)
    return jnp.clip(start + travelled - behind, start, end)


def map_existing(function: Callable, exists: Bool[Array, " rows"], inputs: Any, empty: Any, block: int) -> Any:
    """Applies `function` to the rows where `exists`, in blocks of `block` rows; the other rows get `empty`.

    Existing rows are packed first and empty blocks skipped: time depends on the existing rows, memory on the block.
    The gradient recomputes each block.
    """
    total = exists.shape[0]
    block = min(block, total)
    size = total + -total % block
    (order,) = jnp.nonzero(exists, size=size, fill_value=total)  # existing rows first; `total` is no row
    count = jnp.sum(exists)

    @jax.checkpoint
    def one_block(start: Array, rows: Int[Array, " block"]) -> Any:
        taken = jnp.minimum(rows, total - 1)
        return jax.lax.cond(
            start < count,
            lambda: function(*jax.tree.map(lambda x: x[taken], inputs)),
            lambda: jax.tree.map(lambda x: jnp.zeros_like(x[taken]), empty),
        )

    blocks = jax.lax.map(lambda x: one_block(*x), (jnp.arange(0, size, block), order.reshape(-1, block)))
    return jax.tree.map(
        lambda background, x: background.at[order].set(x.reshape(size, *x.shape[2:]), mode="drop"), empty, blocks
    )
