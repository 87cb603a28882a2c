"""The few delicate primitives that the other kernels share.

`gather_rows` and `scatter_rows` are each other's transpose.  Both flatten mapped axes into one longer table under vmap:
XLA lowers a batched scatter on CPU to a loop about four times slower than a flat one (32^3 voxels, 2 objects).  On a
mesh there is one table for each group of objects: in a common one XLA would not know that rows stay on their device.
Subnormal numbers (below 1.2e-38) are zeros to XLA.
"""

from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from spnr_jax.devices.placement import object_groups

# log1p(e) / e on [0, 1], highest power first: Chebyshev interpolation of degree 8, relative error 3e-8
LOG1P = (
    *(5.2534577954e-03, -2.9588507387e-02, 7.8361668009e-02, -1.3674769705e-01, 1.9111431080e-01),
    *(-2.4844369892e-01, 3.3319271342e-01, -4.9999501517e-01, 9.9999997054e-01),
)


def safe_divide(numerator: Float[Array, "*batch"], denominator: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """numerator / denominator, and 0 where the denominator is 0; finite in value and gradient there.

    Elsewhere it is the quotient: gradients by denominators below 1e-19 overflow, as 1 / denominator^2 does.
    """
    valid = denominator != 0
    return jnp.where(valid, numerator / jnp.where(valid, denominator, 1), 0)


@jax.custom_jvp
def softplus(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """log(1 + exp(x)), finite everywhere, relative error 2e-7; gradient a sigmoid.

    log1p(e) of e = exp(-|x|) in (0, 1] is e times a polynomial: on a CPU 0.4 of the time of XLA's log1p.
    """
    e = jnp.exp(-jnp.abs(x))
    ratio = jnp.full_like(e, LOG1P[0])
    for coefficient in LOG1P[1:]:
        ratio = ratio * e + coefficient
    return jnp.maximum(x, 0) + e * ratio


@softplus.defjvp
def _softplus_jvp(primals, tangents):
    return softplus(*primals), jax.nn.sigmoid(*primals) * tangents[0]


@jax.custom_jvp
def one_minus_exp(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """1 - exp(-x), exact for small x too; gradient exp(-x).

    JAX's derivative of expm1 adds 1 to its value, which leaves no digit of it from x = 17 on.
    """
    return -jnp.expm1(-x)


@one_minus_exp.defjvp
def _one_minus_exp_jvp(primals, tangents):
    return one_minus_exp(*primals), jnp.exp(-primals[0]) * tangents[0]


def clamp(
    x: Float[Array, "*shape"], low: Float[Array, "*shape"] | float | int, high: Float[Array, "*shape"] | float | int
) -> Float[Array, "*shape"]:
    """x between low and high, jnp.clip with a gradient that is always that of x, of low or of high.

    jnp.clip asks in its gradient whether x equals the result; a compiler that computes x twice, once with a fused
    multiply-add, answers no and loses the gradient of some elements.
    """
    return jnp.where(x < low, low, jnp.where(x > high, high, x))


def larger(a: Float[Array, "*shape"], b: Float[Array, "*shape"] | float | int) -> Float[Array, "*shape"]:
    """The larger of two, jnp.maximum with a gradient that is always that of one of them (as in `clamp`)."""
    return jnp.where(a > b, a, b)


def smaller(a: Float[Array, "*shape"], b: Float[Array, "*shape"] | float | int) -> Float[Array, "*shape"]:
    """The smaller of two, likewise."""
    return jnp.where(a < b, a, b)


def root(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root; 0 with zero gradient where x is 0 or, by rounding, below."""
    valid = x > 0
    return jnp.where(valid, jnp.sqrt(jnp.where(valid, x, 1)), 0)


def namespace(*values: Any) -> ModuleType:
    """jax.numpy if any of the values is an array of JAX, traced or not; NumPy, which compiles nothing, otherwise."""
    return jnp if any(isinstance(x, jax.Array) for x in values) else np


def columns(x: Float[Array, "*batch features"]) -> list[Float[Array, "*batch"]]:
    """The features one by one; their gradients are put side by side once, where those of slices are padded and added.

    Of twenty columns XLA's CPU compiler computes the sum of the padded ones five times as long.
    """
    return [part[..., 0] for part in jnp.split(x, x.shape[-1], axis=-1)]


def with_gradient(function: Callable, pull_back: Callable) -> Callable:
    """The function of arrays with the gradient `pull_back(primals, cotangents)`, for both modes of differentiation.

    `pull_back` is linear in the cotangents, a tuple as the outputs are.  A tangent is its transpose; transposed again,
    as reverse mode does, that is `pull_back` itself, operation by operation.
    """
    differentiable = jax.custom_jvp(function)

    def pushed_forward(primals: tuple, tangents: tuple) -> tuple:
        out = differentiable(*primals)
        return out, jax.linear_transpose(lambda *given: pull_back(primals, given), *out)(tangents)

    differentiable.defjvp(pushed_forward)
    return differentiable


def normalize(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Vectors scaled to unit length; the zero vector stays zero with zero gradient."""
    vectors = vectors / _largest(vectors)
    squared = jnp.sum(vectors**2, axis=-1, keepdims=True)
    valid = squared > 0
    return jnp.where(valid, vectors * jax.lax.rsqrt(jnp.where(valid, squared, 1)), 0)


def length(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Euclidean lengths; that of the zero vector is 0 with zero gradient."""
    scale = _largest(vectors)
    squared = jnp.sum((vectors / scale) ** 2, axis=-1)
    valid = squared > 0
    return jnp.where(valid, scale[..., 0] * jnp.sqrt(jnp.where(valid, squared, 1)), 0)


def _largest(vectors):
    """Largest component of each vector (1 of the zero vector): divided by it, squares neither overflow nor vanish.

    A constant to the gradient: lengths and directions do not depend on the scale that they are computed at.
    """
    largest = jnp.max(jnp.abs(jax.lax.stop_gradient(vectors)), axis=-1, keepdims=True)
    return jnp.where(largest > 0, largest, 1)


def per_feature(vector: Shaped[Array, " features"], like: Array) -> Shaped[Array, "*ones features"]:
    """A vector over the last axis, with as many axes as `like` (ranks are never promoted silently)."""
    return vector.reshape(*[1] * (like.ndim - 1), -1)


def compute_once(x: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """x, through a product with the identity matrix; for few and finite numbers that much else is computed from.

    XLA's CPU compiler computes elementwise results anew in every loop that reads them, and drops optimization_barrier.
    """
    return jnp.matmul(x, jnp.eye(x.shape[-1], dtype=x.dtype), precision="highest")


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
