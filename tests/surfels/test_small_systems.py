"""Small systems worked on by columns, beside LAPACK's one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers

from spnr_jax.surfels.small_systems import cross, find_narrowest, measure_shape, solve, sum_products


@pytest.mark.parametrize("unknowns", [1, 3, 5])
def test_solutions_are_those_of_lapack(unknowns):
    rng = np.random.default_rng(unknowns)
    root = rng.normal(size=(40, unknowns, unknowns + 2))
    matrix, right = root @ root.swapaxes(1, 2) + 1e-3 * np.eye(unknowns), rng.normal(size=(40, unknowns, 2))
    found = solve(*(jnp.asarray(np.float32(np.moveaxis(x, 0, -1))) for x in (matrix, right)))
    close(np.moveaxis(found, -1, 0), np.linalg.solve(matrix, right), rtol=2e-3, atol=2e-4)


def covariances():
    """Of clouds that are thick, flat, narrow, without extent, and round (n, 3, 3)."""
    rng = np.random.default_rng(0)
    thick = rng.normal(size=(30, 8, 3))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    places = [thick, thick * [1, 1, 1e-4] @ turn, thick * [1, 1e-5, 1e-5] @ turn, thick * [1, 0, 0] @ turn, 0 * thick]
    return np.concatenate([*(x.swapaxes(1, 2) @ x for x in places), 0.3 * np.eye(3)[None]])


def by_column(matrix):
    return jnp.asarray(np.float32(np.moveaxis(matrix, 0, -1)))


def test_the_shape_is_that_of_the_roots_of_eigenvalues_and_smooth_where_two_are_alike():
    matrix = covariances()
    extents = np.sqrt(np.maximum(np.linalg.eigvalsh(matrix), 0))
    expected = extents[:, :2] / np.maximum(extents[:, 1:], 1e-12)
    expected[expected[:, 1] < 4e-4] = 0  # of a line float32 knows no more
    clear = extents[:, 2] > 0
    found = np.asarray(measure_shape(by_column(matrix))).T
    # a hundredth where two variances are so alike that five squarings do not part them
    close(found[clear], np.where(expected < 4e-4, 0, expected)[clear], atol=0.02)
    assert np.isfinite(found).all()


def test_the_narrowest_axis_is_a_unit_vector_along_which_the_variance_is_least():
    matrix = covariances()
    axis = np.asarray(find_narrowest(by_column(matrix))).T
    close(np.linalg.norm(axis, axis=1), np.ones(len(axis)), atol=1e-5)
    least, size = np.linalg.eigvalsh(matrix)[:, 0], np.trace(matrix, axis1=1, axis2=2)
    assert np.all(np.einsum("ni,nij,nj->n", axis, matrix, axis) < 1.01 * least + 1e-6 * size + 1e-20)


def test_gradients_are_finite_without_extent_on_a_line_in_a_plane_and_in_a_ball():
    for function in (find_narrowest, measure_shape):
        gradient = jax.grad(lambda matrix, function=function: jnp.sum(function(matrix) ** 3))(by_column(covariances()))
        assert np.isfinite(gradient).all()


def test_gradients_of_the_shape_are_central_differences_where_variances_are_nearly_alike_too():
    rng = np.random.default_rng(3)
    places = rng.normal(size=(40, 12, 3)) * np.array([1, 0.9, 0.8])
    with jax.enable_x64(True):
        matrix = jnp.asarray(np.moveaxis(places.swapaxes(1, 2) @ places, 0, -1))
        way = jnp.asarray(rng.normal(size=(3, 40)))
        way = 0.1 * way[:, None] * way[None]
        slope = (measure_shape(matrix + 1e-5 * way) - measure_shape(matrix - 1e-5 * way)) / 2e-5
        close(jax.jvp(measure_shape, (matrix,), (way,))[1], slope, rtol=1e-3, atol=1e-6)


def test_sums_and_products_are_those_of_numpy():
    one, two = np.random.default_rng(1).normal(size=(2, 3, 20))
    close(cross(*map(jnp.asarray, np.float32([one, two]))), np.cross(one, two, axis=0), atol=1e-5)
    left, right = numbers(0, 20, 3, 7), numbers(1, 20, 4, 7)
    close(sum_products(left, right), np.einsum("kin,kjn->ijn", left, right), atol=1e-5)
