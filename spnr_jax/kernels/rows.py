"""Tables of rows that are read and added to at computed places, as features of voxels are.

`gather_rows` and `scatter_rows` are each other's transpose.  Both flatten mapped axes into one longer table under vmap:
XLA lowers a batched scatter on CPU to a loop about four times slower than a flat one (32^3 voxels, 2 objects).  On a
mesh there is one table for each group of objects: in a common one XLA would not know that rows stay on their device.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spnr_jax.devices.placement import object_groups


def _end_to_end(function, table, index, *values):
    """`function` of mapped tables (b, rows, c) as one table (b * rows, c), and of indices (b, *shape) into that."""
    offsets = table.shape[1] * jnp.arange(len(table), dtype=index.dtype).reshape(-1, *[1] * (index.ndim - 1))
    return function(table.reshape(-1, *table.shape[2:]), index + offsets, *values)


def _by_group(function, plain, *arguments):
    """`function` of the tables of all objects end to end; on a mesh `plain` of those of each group of objects."""
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
    def spread(x, batched):
        return x if batched else jnp.broadcast_to(x, (axis_size, *x.shape))

    arguments = tuple(map(spread, arguments, in_batched))
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


def scatter_rows(
    index: Int[Array, "*batch"], values: Float[Array, "*batch features"], rows: int
) -> Float[Array, "rows features"]:
    """Table whose row r is the sum of the values with index r; every index must be in [0, rows)."""
    return _scatter_rows(rows, index, values)


def _scatter_zeros(rows, index, values):
    return _scatter(jnp.zeros((rows, values.shape[-1]), values.dtype), index, values)


_scatter_rows = jax.custom_vjp(_scatter_zeros, nondiff_argnums=(0,))
_scatter_rows.defvjp(
    lambda rows, index, values: (_scatter_rows(rows, index, values), index),
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
