import numpy as np
import pytest

from spnr_jax.kernels.cleaning import Cleaned
from spnr_jax.surfels.outward import VOTERS, outward_normals, thinned
from spnr_jax.surfels.visibility import spiral


def normals_of(points, kept, noise=0.0):
    """Of points of one colour."""
    return outward_normals(points, np.full((len(points), 3), 0.5), kept, noise)


@pytest.mark.parametrize("count", [3000, VOTERS + 5000])
def test_normals_of_a_ball_point_away_from_its_middle_in_the_order_of_the_points_kept(count):
    points = 40 + 7 * spiral(count).astype(np.float64)
    kept = np.random.default_rng(0).permutation(count)[:500]
    np.testing.assert_allclose(normals_of(points, kept), spiral(count)[kept], atol=0.05)


def test_both_sides_of_a_thin_plate_point_away_from_it():
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-1, 1, 100)]))
    points = np.concatenate([np.stack([x, y, z + 0 * x], 1) for z in (0.0, 0.05)])
    normals = normals_of(points, np.arange(0, len(points), 11))
    down = points[::11, 2] == 0
    inner = np.abs(points[::11, :2]).max(axis=1) < 0.9
    np.testing.assert_allclose(normals[down & inner], [[0, 0, -1]] * np.sum(down & inner), atol=0.05)
    np.testing.assert_allclose(normals[~down & inner], [[0, 0, 1]] * np.sum(~down & inner), atol=0.05)


@pytest.mark.parametrize("size", [1e-25, 1.0, 1e25])
def test_the_unit_of_length_does_not_matter(size):
    points = spiral(2000).astype(np.float64) * [1, 2, 0.5]
    kept = np.arange(0, 2000, 9)
    np.testing.assert_allclose(normals_of(size * points, kept), normals_of(points, kept), atol=1e-4)


@pytest.mark.parametrize("count", [1, 2, 5, 700])
def test_points_that_coincide_have_some_normal_of_unit_length(count):
    normals = normals_of(np.zeros((count, 3)), np.arange(min(count, 3)))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


def test_noise_that_was_averaged_makes_the_neighbourhood_wider():
    points, kept = spiral(8000).astype(np.float64), np.arange(0, 8000, 7)
    noisy = points + np.random.default_rng(0).normal(size=points.shape) * 0.01
    told, untold = (1 - np.sum(normals_of(noisy, kept, noise) * points[kept], axis=1) for noise in (0.06, 0.0))
    assert np.quantile(told, 0.97) < 0.05
    assert np.median(told) < 0.5 * np.median(untold)


def test_thinned_points_keep_the_normals_of_their_file_and_else_get_those_of_all_points():
    ball, kept = spiral(3000), np.arange(0, 3000, 11)
    normals = np.roll(ball, 1, axis=0)
    flat = {name: np.full(3000, 0.5) for name in ("roughness", "metallic")} | {"base_color": np.abs(ball)}
    for values, expected in (({"normals": normals}, normals[kept]), ({}, normals_of(ball, kept))):
        cloud = thinned(Cleaned(ball, flat | values, [], 0.0), kept)
        np.testing.assert_array_equal(cloud.positions, ball[kept])
        np.testing.assert_array_equal(cloud.base_color, np.abs(ball[kept]))
        np.testing.assert_allclose(cloud.normals, expected, atol=1e-6)
    assert thinned(Cleaned(ball, flat, [], 0.0), np.arange(3000)).normals is None
