"""Numerically delicate primitives that other kernels share: functions of numbers and vectors, small linear systems.

Vectors are the last axis.  In sums, systems and eigenvectors with few unknowns per point, the points are the last axis
instead: every step is one pass over all points of a block, which a CPU vectorises; LAPACK and batched matrix products
take ten times as long.  XLA flushes subnormal numbers (below 1.2e-38) to zero.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import add
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from spnr_jax.errors import UserError

# --- numbers and vectors ----------------------------------------------------------------------------------------------


# log1p(e) / e on [0, 1], highest power first: Chebyshev interpolation of degree 8, relative error 3e-8
LOG1P = (
    *(5.2534577954e-03, -2.9588507387e-02, 7.8361668009e-02, -1.3674769705e-01, 1.9111431080e-01),
    *(-2.4844369892e-01, 3.3319271342e-01, -4.9999501517e-01, 9.9999997054e-01),
)


def safe_divide(numerator: Float[Array, "*batch"], denominator: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """numerator / denominator, and 0 where the denominator is 0; finite in value and gradient there.

    Elsewhere it is the quotient; its gradient by denominators below 1e-19 overflows, as 1 / denominator^2 does.
    """
    valid = denominator != 0
    return jnp.where(valid, numerator / jnp.where(valid, denominator, 1), 0)


@jax.custom_jvp
def softplus(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """log(1 + exp(x)), finite everywhere, relative error 2e-7; gradient a sigmoid.

    log1p(e) of e = exp(-|x|) in (0, 1] is e times a polynomial: XLA's log1p on a CPU makes the error of a rendering's
    gradient five times as large, and takes 2.5 times as long.
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

    JAX's derivative of expm1 adds 1 to its value, which loses all digits for x above 17.
    """
    return -jnp.expm1(-x)


@one_minus_exp.defjvp
def _one_minus_exp_jvp(primals, tangents):
    return one_minus_exp(*primals), jnp.exp(-primals[0]) * tangents[0]


def clamp(
    x: Float[Array, "*shape"], low: Float[Array, "*shape"] | float | int, high: Float[Array, "*shape"] | float | int
) -> Float[Array, "*shape"]:
    """x between low and high: jnp.clip with a gradient that is always that of exactly one of x, low and high.

    The gradient of jnp.clip tests whether x equals the result.  A compiler that computes x twice, once with a fused
    multiply-add, finds them different and loses the gradient of some elements.
    """
    return jnp.where(x < low, low, jnp.where(x > high, high, x))


def larger(a: Float[Array, "*shape"], b: Float[Array, "*shape"] | float | int) -> Float[Array, "*shape"]:
    """max(a, b), whose gradient goes to exactly one of them, also under fused recomputation (see `clamp`)."""
    return jnp.where(a > b, a, b)


def smaller(a: Float[Array, "*shape"], b: Float[Array, "*shape"] | float | int) -> Float[Array, "*shape"]:
    """min(a, b), whose gradient goes to exactly one of them."""
    return jnp.where(a < b, a, b)


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root; 0 with zero gradient where x is 0 or, by rounding, negative."""
    valid = x > 0
    return jnp.where(valid, jnp.sqrt(jnp.where(valid, x, 1)), 0)


def check_alike(where: str, image: Any, reference: Any) -> None:
    """ValueError unless two pictures have the same shape and are floating-point: others would broadcast, or wrap."""
    shapes, kinds = [np.shape(x) for x in (image, reference)], [jnp.result_type(x) for x in (image, reference)]
    if shapes[0] != shapes[1]:
        raise UserError(f"{where}: expected two arrays of the same shape, got {shapes[0]} and {shapes[1]}")
    if not all(jnp.issubdtype(kind, jnp.floating) for kind in kinds):
        raise UserError(f"{where}: expected floats in [0, 1], got {kinds[0]} and {kinds[1]}")


def array_namespace(*values: Any) -> ModuleType:
    """jax.numpy if any value is or holds a JAX array, traced or not; otherwise NumPy, which compiles nothing."""
    return jnp if any(isinstance(x, jax.Array) for x in jax.tree.leaves(values)) else np


def split_columns(x: Float[Array, "*batch features"]) -> list[Float[Array, "*batch"]]:
    """The features as separate arrays; their gradients are stacked once (gradients of slices are padded and summed).

    For twenty columns, XLA's CPU compiler takes five times as long for the sum of the padded ones.
    """
    return [part[..., 0] for part in jnp.split(x, x.shape[-1], axis=-1)]


def rotate_columns(
    matrix: Float[Array | np.ndarray, "3 3"], vectors: Float[Array | np.ndarray, "points 3"]
) -> tuple[Array, Array, Array]:
    """Columns of vectors @ matrix."""
    x, y, z = split_columns(jnp.asarray(vectors))
    one, two, three = (x * matrix[0, i] + y * matrix[1, i] + z * matrix[2, i] for i in range(3))
    return one, two, three


def with_gradient(function: Callable, pull_back: Callable) -> Callable:
    """The function with a given vector-Jacobian product that also works in forward mode.

    `pull_back(primals, cotangents)` is linear in the cotangents, a tuple like the outputs.  The JVP is its transpose;
    reverse mode transposes that again, which restores `pull_back`.  Primals may be of float32 and float64.
    """
    differentiable = jax.custom_jvp(function)

    def pushed_forward(primals: tuple, tangents: tuple) -> tuple:
        def pull(*cotangents: Array) -> tuple:
            return jax.tree.map(lambda by, x: by.astype(x.dtype), pull_back(primals, cotangents), primals)

        out = differentiable(*primals)
        return out, jax.linear_transpose(pull, *out)(tangents)

    differentiable.defjvp(pushed_forward)
    return differentiable


def split_blocks(values: Shaped[Array, "rows n"], size: int, fill: int) -> Shaped[Array, "blocks rows {size}"]:
    """The columns in blocks of this size, the last one padded with `fill`."""
    blocks = -(-values.shape[1] // size)
    values = jnp.pad(values, [(0, 0), (0, blocks * size - values.shape[1])], constant_values=fill)
    return jnp.moveaxis(values.reshape(len(values), blocks, size), 1, 0)


def smoothstep(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """0 below 0, 1 above 1, and a smooth cubic in between."""
    x = clamp(x, 0, 1)
    return x * x * (3 - 2 * x)


def normalize(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Vectors scaled to unit length; the zero vector stays zero with zero gradient."""
    vectors = vectors / _max_component(vectors)
    squared = jnp.sum(vectors**2, axis=-1, keepdims=True)
    valid = squared > 0
    return jnp.where(valid, vectors * jax.lax.rsqrt(jnp.where(valid, squared, 1)), 0)


def length(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Euclidean lengths; 0 with zero gradient for the zero vector."""
    scale = _max_component(vectors)
    squared = jnp.sum((vectors / scale) ** 2, axis=-1)
    valid = squared > 0
    return jnp.where(valid, scale[..., 0] * jnp.sqrt(jnp.where(valid, squared, 1)), 0)


def _max_component(vectors):
    """Largest component of each vector (1 for the zero vector); vectors divided by it have squares in range.

    Constant for gradients: lengths and directions do not depend on the scale that they are computed at.
    """
    largest = jnp.max(jnp.abs(jax.lax.stop_gradient(vectors)), axis=-1, keepdims=True)
    return jnp.where(largest > 0, largest, 1)


def per_feature(vector: Shaped[Array, " features"], like: Array) -> Shaped[Array, "*ones features"]:
    """A vector broadcast over the last axis, with as many axes as `like` (ranks are never promoted silently)."""
    return vector.reshape(*[1] * (like.ndim - 1), -1)


# --- small systems, points last ---------------------------------------------------------------------------------------


RIDGE = 1e-4  # times the trace, added to variances before they are inverted
SQUARINGS = 5  # M^(2^5): a ratio of eigenvalues of 1.1 becomes 1.1^32 = 21
LEAST_LENGTH = 1e-9  # length of a vector that has a direction
LEAST_TRACE = 1e-9  # least trace of a covariance with extent: gradients divide by its square, kept above 0
LEAST_VARIANCE = 1e-7  # times the trace: variances below are rounding


def sum_first(values: Float[Array, "k ..."]) -> Float[Array, "..."]:
    """Sum over the first axis.  The barrier keeps XLA's CPU compiler from computing the terms one number at a time."""
    return jnp.sum(jax.lax.optimization_barrier(values), axis=0)


def sum_products(
    left: Float[Array, "k rows points"], right: Float[Array, "k columns points"]
) -> Float[Array, "rows columns points"]:
    """Sums over the first axis of the products of all pairs: normal equations, moments."""

    def add(sums: Array, terms: tuple[Array, Array]) -> tuple[Array, None]:
        return sums + terms[0][:, None] * terms[1][None], None

    empty = jnp.zeros((left.shape[1], right.shape[1], left.shape[2]), left.dtype)
    return jax.lax.scan(add, empty, (left, right))[0]


def solve(
    matrix: Float[Array, "unknowns unknowns points"], right: Float[Array, "unknowns sides points"]
) -> Float[Array, "unknowns sides points"]:
    """The solution of symmetric positive definite systems; its gradients are solutions of the same systems."""
    fixed = jax.lax.stop_gradient(matrix)
    return jax.lax.custom_linear_solve(
        partial(multiply, matrix), right, lambda _, right: _eliminate(fixed, right), symmetric=True
    )


def multiply(
    left: Float[Array, "rows terms points"], right: Float[Array, "terms columns points"]
) -> Float[Array, "rows columns points"]:
    """Products of small matrices."""
    return reduce(add, (left[:, i][:, None] * right[i][None] for i in range(len(right))))


def _eliminate(matrix: Array, right: Array) -> Array:
    """Gauss-Jordan elimination; positive definite systems need no pivoting."""
    indices = jnp.arange(len(matrix))[:, None, None]

    def eliminate(pivot: Array, rows: Array) -> Array:
        row = rows[pivot] / rows[pivot, pivot][None]
        return jnp.where(indices == pivot, row[None], rows - rows[:, pivot][:, None] * row[None])

    rows = jnp.concatenate([matrix, right], axis=1)
    return jax.lax.fori_loop(0, len(matrix), eliminate, rows)[:, len(matrix) :]


def dot(
    one: Float[Array | np.ndarray, "3 ..."] | Sequence[Array], two: Float[Array | np.ndarray, "3 ..."] | Sequence[Array]
) -> Array:
    """Scalar products of vectors, given as arrays (3, ...) or as their three components."""
    return one[0] * two[0] + one[1] * two[1] + one[2] * two[2]


def cross(
    one: Float[Array, "3 points"] | Sequence[Array], two: Float[Array, "3 points"] | Sequence[Array]
) -> Float[Array, "3 points"]:
    """Vector products, likewise."""
    return jnp.stack([one[i - 2] * two[i - 1] - one[i - 1] * two[i - 2] for i in range(3)])


@jax.custom_jvp
def largest(values: Float[Array, "k ..."]) -> Float[Array, "..."]:
    """Largest along the first axis; its gradient is the mean over those that are equal to it up to rounding.

    The gradient of jnp.max tests equality with the result: a compiler that computes both finds none, and divides by 0.
    """
    return jnp.max(values, axis=0)


@largest.defjvp
def _largest_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (values,), (change,) = primals, tangents
    most = largest(values)
    near = values >= (most - 8 * jnp.finfo(values.dtype).eps * jnp.abs(most))[None]
    share = near.astype(values.dtype) / jnp.maximum(jnp.sum(near, axis=0, dtype=values.dtype), 1)[None]
    return most, jnp.sum(share * change, axis=0)


def smallest(values: Float[Array, "k ..."]) -> Float[Array, "..."]:
    """Smallest along the first axis, with the same property."""
    return -largest(-values)


def normalize_columns(vectors: Float[Array, "dimensions points"]) -> Float[Array, "dimensions points"]:
    """Vectors scaled to length 1; 0 where they are shorter than LEAST_LENGTH, as the gradient would overflow."""
    squared = jnp.sum(vectors * vectors, axis=0, keepdims=True)
    valid = squared > LEAST_LENGTH**2
    return jnp.where(valid, vectors * jax.lax.rsqrt(jnp.where(valid, squared, 1)), 0)


def tangent_frame(normal: Float[Array, "3 points"]) -> Float[Array, "3 3 points"]:
    """Two tangents and the unit normal (Duff et al. 2017)."""
    x, y, z = normal
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(normal.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x**2 * a, sign * b, -sign * x])
    return jnp.stack([first, jnp.stack([b, sign + y**2 * a, -y]), normal])


def project_largest(matrix: Float[Array, "3 3 points"]) -> Float[Array, "3 3 points"]:
    """Projections onto the eigenvector of the largest eigenvalue of positive matrices, from powers of trace 1.

    For nearly equal eigenvalues the result is a smooth mean of both projections, with a smooth gradient.
    """

    def square(_: Array, power: Array) -> Array:
        power = multiply(power, power)
        return power / (power[0, 0] + power[1, 1] + power[2, 2])[None, None]

    scaled = matrix / (matrix[0, 0] + matrix[1, 1] + matrix[2, 2])[None, None]
    return jax.lax.fori_loop(0, SQUARINGS, square, scaled)


def split_variances(
    matrix: Float[Array, "3 3 points"],
) -> tuple[Float[Array, "3 3 points"], Float[Array, "3 3 points"], Float[Array, "3 3 points"]]:
    """Covariances scaled to trace 1 (0 without extent), projections onto the narrowest and onto the widest axis."""
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    extended = trace > LEAST_TRACE
    scaled = jnp.where(extended[None, None], matrix / jnp.where(extended, trace, 1)[None, None], 0)
    ones = jnp.broadcast_to(jnp.eye(3, dtype=matrix.dtype)[..., None], matrix.shape)
    both = jnp.concatenate([solve(scaled + RIDGE * ones, ones), scaled + RIDGE * ones], axis=2)
    narrowest, widest = jnp.split(project_largest(both), 2, axis=2)
    return scaled, narrowest, widest


def find_narrowest(matrix: Float[Array, "3 3 points"]) -> Float[Array, "3 points"]:
    """Unit vectors, of either sign, along which points with these covariances have the least variance."""
    _, (x, y, z), _ = split_variances(matrix)
    last = jnp.where(y[1] > z[2], y, z)
    return normalize_columns(jnp.where((x[0] > y[1]) & (x[0] > z[2]), x, last))


def measure_shape(matrix: Float[Array, "3 3 points"]) -> Float[Array, "2 points"]:
    """Ratios of the standard deviations s1 >= s2 >= s3: s3 / s2 (0 in a plane) and s2 / s1 (0 on a line)."""
    scaled, narrowest, widest = split_variances(matrix)
    least, most = (jnp.sum(x * scaled, axis=(0, 1)) for x in (narrowest, widest))
    middle = scaled[0, 0] + scaled[1, 1] + scaled[2, 2] - least - most
    ratios = jnp.stack([least, middle]) / larger(jnp.stack([middle, most]), LEAST_VARIANCE)
    return safe_sqrt(jnp.where(jnp.stack([least, middle]) > LEAST_VARIANCE, smaller(ratios, 1), 0))
