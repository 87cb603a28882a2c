"""Symmetric systems of a few unknowns, one for each point, worked on by columns: LAPACK takes ten times as long.

The points are the last axis: every step is one pass over all of them.
"""

import numpy as np
from jaxtyping import Float

APART = 1e-9  # of the trace, by which equal variances are told apart, so that there is always a narrowest axis
SMALLEST = 1e-30  # of a trace


def solved(
    matrix: Float[np.ndarray, "unknowns unknowns points"], right: Float[np.ndarray, "unknowns sides points"]
) -> Float[np.ndarray, "unknowns sides points"]:
    """The solution of positive definite systems: Gauss-Jordan elimination, which needs no pivots for these."""
    count = len(matrix)
    rows = np.concatenate([matrix, right], axis=1)
    for pivot in range(count):
        rows[pivot, pivot:] /= rows[pivot, pivot].copy()
        for other in (i for i in range(count) if i != pivot):
            rows[other, pivot + 1 :] -= rows[other, pivot] * rows[pivot, pivot + 1 :]
    return rows[:, count:]


def cross(one: Float[np.ndarray, "3 points"], two: Float[np.ndarray, "3 points"]) -> Float[np.ndarray, "3 points"]:
    """Vector products."""
    return np.stack([one[i - 2] * two[i - 1] - one[i - 1] * two[i - 2] for i in range(3)])


def variances(matrix: Float[np.ndarray, "3 3 points"]) -> Float[np.ndarray, "3 points"]:
    """Eigenvalues, rising, by the cosines of Smith (1961); of float64."""
    middle = np.trace(matrix) / 3
    rest = matrix - middle * np.eye(3)[..., None]
    size = np.sqrt(np.einsum("ijn,ijn->n", rest, rest) / 6)
    rest = rest / np.where(size > 0, size, 1)
    determinant = np.einsum("in,in->n", rest[0], cross(rest[1], rest[2]))
    angle = np.arccos(np.clip(determinant / 2, -1, 1)) / 3
    return middle + 2 * size * np.cos(angle + 2 * np.pi / 3 * np.array([[1], [2], [0]]))


def narrowest(matrix: Float[np.ndarray, "3 3 points"]) -> Float[np.ndarray, "3 points"]:
    """Unit eigenvectors of the least eigenvalue; of float64.

    Rows of the matrix less its eigenvalue span what is at right angles to it: of their products the longest is taken.
    """
    matrix = matrix + (APART * np.trace(matrix) + SMALLEST) * np.diag([0.0, 1, 2])[..., None]
    rows = matrix - variances(matrix)[0] * np.eye(3)[..., None]
    products = np.stack([cross(rows[i], rows[(i + 1) % 3]) for i in range(3)])
    size = np.einsum("pin,pin->pn", products, products)
    longest = np.take_along_axis(products, size.argmax(axis=0)[None, None], axis=0)[0]
    return longest / np.sqrt(size.max(axis=0))
