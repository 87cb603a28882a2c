import numpy as np
import pytest

from spnr_jax.kernels.facing import facing, planes, seen_from, spacing_of
from spnr_jax.surfels.visibility import spiral


def test_normals_of_a_ball_point_to_a_sensor_in_its_middle_or_far_from_it():
    points = spiral(3000)
    from_within = facing(points, points, np.zeros(3))
    np.testing.assert_allclose(from_within, -points, atol=0.03)
    front = points[points[:, 2] > 0.2][::7]
    np.testing.assert_allclose(facing(front, points, np.array([0, 0, 9.0])), front, atol=0.03)


@pytest.mark.parametrize("count", [1, 2, 3, 40])
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e30])
def test_points_that_span_no_plane_have_some_normal_of_unit_length(count, size):
    points = size * np.linspace([0, 0, 0], [1, 2, 3], count)
    np.testing.assert_allclose(np.linalg.norm(facing(points, points, np.array([0, 0, 1.0])), axis=1), 1, atol=1e-6)


def test_a_sensor_sees_the_near_cap_of_a_ball_and_nothing_from_the_place_of_the_points():
    points, place = spiral(5000), np.array([0, 3.0, 0])
    spacing = spacing_of(points)
    np.testing.assert_allclose(spacing, np.sqrt(4 * np.pi / 5000), rtol=0.1)
    seen, height = seen_from(points, place, spacing, 4), points[:, 1]
    assert seen[height > 0.5].all()
    assert not seen[height < 0].any()
    assert not seen_from(np.ones((5, 3)), np.ones(3), 0.1, 2.0).any()
    assert spacing_of(np.zeros((1, 3))) == 0


def test_noise_tilts_normals_less_because_more_points_are_asked():
    points = spiral(8000)
    noise = 0.4 * spacing_of(points)
    noisy = points + np.random.default_rng(0).normal(size=points.shape) * noise
    told, untold = (1 - np.abs(np.sum(planes(noisy, noisy, sigma) * points, axis=1)) for sigma in (4 * noise, 0.0))
    assert np.median(told) < 0.25 * np.median(untold) < 0.01
    assert np.median(np.sum(facing(noisy, noisy, np.zeros(3)) * -points, axis=1)) > 0.98


def test_steps_of_a_sensors_depth_hardly_tilt_normals():
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(0, 1, 100)]))
    steps = np.stack([x, y, np.round(0.3 * x / 0.012) * 0.012], axis=1)
    true = np.array([-0.3, 0, 1]) / np.hypot(0.3, 1)
    seen, flat = facing(steps, steps, np.array([0, 0, 9.0])) @ true, np.abs(planes(steps, steps) @ true)
    assert np.degrees(np.arccos(np.median(seen))) < 0.5 * np.degrees(np.arccos(np.median(flat)))


def test_points_at_an_edge_have_the_normals_of_its_faces():
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 2, 120)))
    points = np.concatenate([np.stack([x, y, 0 * x], 1), np.stack([0 * x, y, x + 0.5 / 60], 1)])
    true = np.repeat([[0, 0, 1], [1, 0, 0]], len(x), axis=0)
    cosine = np.abs(np.sum(planes(points, points) * true, axis=1))
    assert np.quantile(cosine, 0.02) > 0.9
    assert np.median(cosine) > 0.9999
