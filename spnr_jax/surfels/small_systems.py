"""Sums, linear systems and eigenvectors with a few unknowns, one for each point; the points are the last axis.

Every step is one pass over all points of a block, which a CPU vectorises; LAPACK and batched matrix products take ten
times as long.
"""

from functools import partial, reduce
from operator import add

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.numerics import larger, root, smaller

ROUND = 1e-4  # of the trace, added to variances before they are inverted
SQUARINGS = 5  # after which a variance that is a tenth larger than another weighs twenty times as much
SHORTEST = 1e-9  # vector that has a direction
POINT = 1e-9  # trace of a covariance without extent: the square of smaller ones, which a gradient divides by, vanishes
SMALLEST = 1e-7  # of the trace, below which a variance is rounding


def total(values: Float[Array, "k ..."]) -> Float[Array, "..."]:
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
    """Gauss-Jordan elimination, which needs no pivots for positive definite systems."""
    places = jnp.arange(len(matrix))[:, None, None]

    def eliminate(pivot: Array, rows: Array) -> Array:
        row = rows[pivot] / rows[pivot, pivot][None]
        return jnp.where(places == pivot, row[None], rows - rows[:, pivot][:, None] * row[None])

    rows = jnp.concatenate([matrix, right], axis=1)
    return jax.lax.fori_loop(0, len(matrix), eliminate, rows)[:, len(matrix) :]


def dot(one: Float[Array, "3 ..."], two: Float[Array, "3 ..."]) -> Float[Array, "..."]:
    """Scalar products."""
    return one[0] * two[0] + one[1] * two[1] + one[2] * two[2]


def cross(one: Float[Array, "3 points"], two: Float[Array, "3 points"]) -> Float[Array, "3 points"]:
    """Vector products."""
    return jnp.stack([one[i - 2] * two[i - 1] - one[i - 1] * two[i - 2] for i in range(3)])


@jax.custom_jvp
def largest(values: Float[Array, "k ..."]) -> Float[Array, "..."]:
    """Largest along the first axis; its gradient is the mean of those that are as large but for rounding.

    That of jnp.max asks which equal the result: a compiler that computes them twice finds none, and divides by 0.
    """
    return jnp.max(values, axis=0)


@largest.defjvp
def _largest_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (values,), (change,) = primals, tangents
    most = largest(values)
    near = values >= (most - 8 * jnp.finfo(values.dtype).eps * jnp.abs(most))[None]
    share = near / jnp.maximum(jnp.sum(near, axis=0, dtype=values.dtype), 1)[None]
    return most, jnp.sum(share * change, axis=0)


def smallest(values: Float[Array, "k ..."]) -> Float[Array, "..."]:
    """Smallest along the first axis, likewise."""
    return -largest(-values)


def unit(vectors: Float[Array, "dimensions points"]) -> Float[Array, "dimensions points"]:
    """Vectors of length 1; 0 where they are shorter than SHORTEST, whose gradient overflows."""
    squared = jnp.sum(vectors * vectors, axis=0, keepdims=True)
    valid = squared > SHORTEST**2
    return jnp.where(valid, vectors * jax.lax.rsqrt(jnp.where(valid, squared, 1)), 0)


def frame(normal: Float[Array, "3 points"]) -> Float[Array, "3 3 points"]:
    """Two tangents and the unit normal (Duff et al. 2017)."""
    x, y, z = normal
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(normal.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x**2 * a, sign * b, -sign * x])
    return jnp.stack([first, jnp.stack([b, sign + y**2 * a, -y]), normal])


def project_largest(matrix: Float[Array, "3 3 points"]) -> Float[Array, "3 3 points"]:
    """Onto the eigenvector of the largest eigenvalue of positive matrices: their powers, of trace 1.

    Where two are alike it is a mean of both projections, so it is smooth, as its gradient is.
    """

    def square(_: Array, power: Array) -> Array:
        power = multiply(power, power)
        return power / (power[0, 0] + power[1, 1] + power[2, 2])[None, None]

    scaled = matrix / (matrix[0, 0] + matrix[1, 1] + matrix[2, 2])[None, None]
    return jax.lax.fori_loop(0, SQUARINGS, square, scaled)


def split_variances(
    matrix: Float[Array, "3 3 points"],
) -> tuple[Float[Array, "3 3 points"], Float[Array, "3 3 points"], Float[Array, "3 3 points"]]:
    """Covariances at trace 1 (0 without extent), projections onto the narrowest axis and onto the widest."""
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    extended = trace > POINT
    scaled = jnp.where(extended[None, None], matrix / jnp.where(extended, trace, 1)[None, None], 0)
    ones = jnp.broadcast_to(jnp.eye(3, dtype=matrix.dtype)[..., None], matrix.shape)
    both = jnp.concatenate([solve(scaled + ROUND * ones, ones), scaled + ROUND * ones], axis=2)
    narrowest, widest = jnp.split(project_largest(both), 2, axis=2)
    return scaled, narrowest, widest


def find_narrowest(matrix: Float[Array, "3 3 points"]) -> Float[Array, "3 points"]:
    """Unit vectors, of either sign, along which points with these covariances spread least."""
    _, (x, y, z), _ = split_variances(matrix)
    last = jnp.where(y[1] > z[2], y, z)
    return unit(jnp.where((x[0] > y[1]) & (x[0] > z[2]), x, last))


def measure_shape(matrix: Float[Array, "3 3 points"]) -> Float[Array, "2 points"]:
    """Ratios of the standard deviations along the axes: planarity, 0 in a plane, and linearity, 0 on a line."""
    scaled, narrowest, widest = split_variances(matrix)
    least, most = (jnp.sum(x * scaled, axis=(0, 1)) for x in (narrowest, widest))
    middle = scaled[0, 0] + scaled[1, 1] + scaled[2, 2] - least - most
    ratios = jnp.stack([least, middle]) / larger(jnp.stack([middle, most]), SMALLEST)
    return root(jnp.where(jnp.stack([least, middle]) > SMALLEST, smaller(ratios, 1), 0))
