"""Small systems worked on by columns, beside LAPACK's one by one."""

import numpy as np
import pytest
from support.laws import close

from spnr_jax.surfels.small_systems import cross, narrowest, solved, variances


@pytest.mark.parametrize("unknowns", [1, 3, 5])
def test_solutions_are_those_of_lapack(unknowns):
    rng = np.random.default_rng(unknowns)
    root = rng.normal(size=(40, unknowns, unknowns + 2))
    matrix, right = root @ root.swapaxes(1, 2) + 1e-3 * np.eye(unknowns), rng.normal(size=(40, unknowns, 2))
    found = solved(np.moveaxis(matrix, 0, -1), np.moveaxis(right, 0, -1))
    close(np.moveaxis(found, -1, 0), np.linalg.solve(matrix, right), rtol=1e-6, atol=1e-8)


def covariances():
    """Of clouds that are thick, flat, narrow, without extent, and round (n, 3, 3)."""
    rng = np.random.default_rng(0)
    thick = rng.normal(size=(30, 8, 3))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    places = [thick, thick * [1, 1, 1e-4] @ turn, thick * [1, 1e-5, 1e-5] @ turn, thick * [1, 0, 0] @ turn, 0 * thick]
    return np.concatenate([*(x.swapaxes(1, 2) @ x for x in places), 0.3 * np.eye(3)[None]])


def test_variances_rise_and_are_the_eigenvalues():
    matrix = covariances()
    found = variances(np.moveaxis(matrix, 0, -1))
    close(found.T, np.linalg.eigvalsh(matrix), atol=1e-7 * np.trace(matrix, axis1=1, axis2=2).max())


def test_the_narrowest_axis_is_a_unit_vector_along_which_the_variance_is_least():
    matrix = covariances()
    axis = narrowest(np.moveaxis(matrix, 0, -1)).T
    close(np.linalg.norm(axis, axis=1), np.ones(len(axis)), atol=1e-9)
    least, size = np.linalg.eigvalsh(matrix)[:, 0], np.trace(matrix, axis1=1, axis2=2)
    assert np.all(np.einsum("ni,nij,nj->n", axis, matrix, axis) < least + 1e-8 * size + 1e-20)


def test_products_are_at_right_angles_as_numpy_has_them():
    one, two = np.random.default_rng(1).normal(size=(2, 3, 20))
    close(cross(one, two), np.cross(one, two, axis=0), atol=1e-12)
