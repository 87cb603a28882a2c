"""Empty space, where nothing is evaluated: which voxels lie near points, and the parts of rays that cross them.

A ray is cut into equal cells; those whose middle lies in a voxel near points are `open` (occupied segments).
`travelled` is the length of the open cells up to a place: samples lie in the concatenated segments, so that none falls
into a gap, and a gap adds no interval length.  Density is 0 outside, by definition.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.kernels import sampling
from spnr_jax.kernels.numerics import gather_rows
from spnr_jax.kernels.records import Rays
from spnr_jax.kernels.voxels import row_at, voxel_of


@no_type_check  # pytree transformations rebuild records with leaves that are no arrays
@struct.dataclass
class Path:
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
) -> Path:
    """Cells between near and far; the first axes of the rays are the objects of `near_points`.  No gradient.

    With `objects`, which says to which object each ray belongs, the rays have any axes.  A cell is as open as the voxel
    of its middle; on a face between two voxels, rounding decides which.
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
    # equal cells are counted, in a product: a running sum takes a CPU longer, docs/lab/cpu_forms.md
    count = is_open @ jnp.triu(jnp.ones((num_cells, num_cells + 1), near.dtype), 1)
    return jax.lax.stop_gradient(Path(edges=edges, travelled=count * ((far - near) / num_cells)))


def whole_path(near: Float[Array, "*batch"], far: Float[Array, "*batch"]) -> Path:
    """All of the ray between near and far, as one open cell."""
    return Path(edges=jnp.stack([near, far], axis=-1), travelled=jnp.stack([jnp.zeros_like(near), far - near], axis=-1))


def distance_at(path: Path, travelled: Float[Array, "*batch samples"]) -> Float[Array, "*batch samples"]:
    """Distance along the ray with so much open length behind it; the end of a cell, not the start of the next.

    What exceeds the open length of the ray ends at the last edge.
    """
    ends = path.travelled[..., 1:]
    if ends.shape[-1] == 1:
        return jnp.clip(path.edges[..., :1] + travelled, path.edges[..., :1], path.edges[..., 1:])
    index = jnp.minimum(sampling.count_at_most(ends, travelled, strictly=True), ends.shape[-1] - 1)
    start, behind = (jnp.take_along_axis(x[..., :-1], index, axis=-1) for x in (path.edges, path.travelled))
    end = jnp.take_along_axis(path.edges[..., 1:], index, axis=-1)
    return jnp.clip(start + travelled - behind, start, end)


def map_existing(function: Callable, exists: Bool[Array, " rows"], inputs: Any, empty: Any, block: int) -> Any:
    """`function` of the rows of the inputs that exist, `empty`'s rows for the others, `block` rows at a time.

    Blocks beyond the last existing row are skipped: time follows what there is, memory is that of a block.  The
    gradient computes a block again rather than keep what it computed.
    """
    total = exists.shape[0]
    block = min(block, total)
    size = total + -total % block
    (order,) = jnp.nonzero(exists, size=size, fill_value=total)  # what exists comes first; `total` is no row
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
