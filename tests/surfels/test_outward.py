"""Normals of points: towards the sensor that saw them, or away from their middle."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from spnr_jax.kernels import cloud_arrays
from spnr_jax.kernels.cleaning import Cleaned
from spnr_jax.surfels import normals
from spnr_jax.surfels.normals import (
    estimate_normals,
    face_sensor,
    find_visible,
    measure_spacing,
    outward_normals,
    thin_cloud,
)
from spnr_jax.surfels.sides import spiral


def test_normals_of_a_ball_point_to_a_sensor_in_its_middle_or_far_from_it():
    points = spiral(3000)
    from_within = face_sensor(points, points, np.zeros(3))
    np.testing.assert_allclose(from_within, -points, atol=0.03)
    front = points[points[:, 2] > 0.2][::7]
    np.testing.assert_allclose(face_sensor(front, points, np.array([0, 0, 9.0])), front, atol=0.03)


@pytest.mark.parametrize("count", [1, 2, 3, 40])
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e30])
def test_points_that_span_no_plane_have_some_normal_of_unit_length(count, size):
    points = size * np.linspace([0, 0, 0], [1, 2, 3], count)
    np.testing.assert_allclose(np.linalg.norm(face_sensor(points, points, np.array([0, 0, 1.0])), axis=1), 1, atol=1e-6)


def test_a_sensor_sees_the_near_cap_of_a_ball_and_nothing_from_the_place_of_the_points():
    points, place = spiral(5000), np.array([0, 3.0, 0])
    spacing = measure_spacing(cKDTree(points))
    np.testing.assert_allclose(spacing, np.sqrt(4 * np.pi / 5000), rtol=0.1)
    seen, height = find_visible(points, place, spacing, 4), points[:, 1]
    assert seen[height > 0.5].all()
    assert not seen[height < 0].any()
    assert not find_visible(np.ones((5, 3)), np.ones(3), 0.1, 2.0).any()
    assert measure_spacing(cKDTree(np.zeros((1, 3)))) == 0


@pytest.mark.ci
def test_noise_tilts_normals_less_because_more_points_are_asked():
    points = spiral(8000)
    noise = 0.4 * measure_spacing(cKDTree(points))
    noisy = points + np.random.default_rng(0).normal(size=points.shape) * noise
    told, untold = (
        1 - np.abs(np.sum(estimate_normals(noisy, cKDTree(noisy), sigma) * points, axis=1))
        for sigma in (4 * noise, 0.0)
    )
    assert np.median(told) < 0.25 * np.median(untold) < 0.01
    assert np.median(np.sum(face_sensor(noisy, noisy, np.zeros(3)) * -points, axis=1)) > 0.98


def test_steps_of_a_sensors_depth_hardly_tilt_normals():
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(0, 1, 100)]))
    steps = np.stack([x, y, np.round(0.3 * x / 0.012) * 0.012], axis=1)
    true = np.array([-0.3, 0, 1]) / np.hypot(0.3, 1)
    seen, flat = (
        face_sensor(steps, steps, np.array([0, 0, 9.0])) @ true,
        np.abs(estimate_normals(steps, cKDTree(steps)) @ true),
    )
    assert np.degrees(np.arccos(np.median(seen))) < 0.5 * np.degrees(np.arccos(np.median(flat)))


def test_points_at_an_edge_have_the_normals_of_its_faces():
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 2, 120)))
    points = np.concatenate([np.stack([x, y, 0 * x], 1), np.stack([0 * x, y, x + 0.5 / 60], 1)])
    true = np.repeat([[0, 0, 1], [1, 0, 0]], len(x), axis=0)
    cosine = np.abs(np.sum(estimate_normals(points, cKDTree(points)) * true, axis=1))
    assert np.quantile(cosine, 0.02) > 0.99  # without weights by height: 0.95
    assert np.median(cosine) > 0.9999


def normals_of(points, kept, noise=0.0):
    """Of points of one colour."""
    return outward_normals(points, np.full((len(points), 3), 0.5), kept, noise)


def test_normals_of_a_ball_point_away_from_its_middle_in_the_order_of_the_points_kept(monkeypatch):
    monkeypatch.setattr(normals, "VOTERS", 4000)  # of some points alone
    count = 4500
    points = 40 + 7 * spiral(count).astype(np.float64)
    kept = np.random.default_rng(0).permutation(count)[:500]
    np.testing.assert_allclose(normals_of(points, kept), spiral(count)[kept], atol=0.05)


@pytest.mark.parametrize("size", [1e-25, 1e25])
def test_the_unit_of_length_does_not_matter(size):
    points = spiral(3000).astype(np.float64) * [1, 2, 0.5]
    kept = np.arange(0, 3000, 9)
    np.testing.assert_allclose(normals_of(size * points, kept), normals_of(points, kept), atol=1e-4)


@pytest.mark.parametrize("count", [1, 3000])
def test_points_that_coincide_have_some_normal_of_unit_length(count, monkeypatch):
    monkeypatch.setattr(cloud_arrays, "SMALLEST_BUCKET", 4096)  # few programs
    found = normals_of(np.zeros((count, 3)), np.arange(min(count, 3)))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def test_thinned_points_keep_the_normals_of_their_file_and_else_get_those_of_all_points():
    ball, kept = spiral(3000), np.arange(0, 3000, 11)
    given = np.roll(ball, 1, axis=0)
    flat = {name: np.full(3000, 0.5) for name in ("roughness", "metallic")} | {"base_color": np.abs(ball)}
    for values, expected in (({"normals": given}, given[kept]), ({}, normals_of(ball, kept))):
        cloud = thin_cloud(Cleaned(ball, flat | values, [], 0.0), kept)
        np.testing.assert_array_equal(cloud.positions, ball[kept])
        np.testing.assert_array_equal(cloud.base_color, np.abs(ball[kept]))
        np.testing.assert_allclose(cloud.normals, expected, atol=1e-6)
    assert thin_cloud(Cleaned(ball, flat, [], 0.0), np.arange(3000)).normals is None
