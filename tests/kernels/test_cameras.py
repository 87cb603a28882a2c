"""Poses, pixel grids, projection and the ray/box interval."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers

from spnr_jax.kernels import cameras
from spnr_jax.kernels.cameras import (
    camera_rays,
    look_at,
    pinhole,
    project,
    resize,
)

EYES = 3 * numbers(0, 2, 3, 3) + 0.1
POSES = jax.jit(look_at)(EYES, jnp.zeros((2, 3, 3)), jnp.array([[[0.0, 1.0, 0.0]]]))
intersect_box, orbit = jax.jit(cameras.intersect_box), jax.jit(cameras.orbit)


@jax.jit
def camera():
    return pinhole(POSES, 0.8, 4, 6)


class TestRays:
    def test_the_field_of_view_is_the_angle_between_the_left_and_right_border(self):
        rays = np.asarray(jax.jit(lambda pose: camera_rays(pinhole(pose, 0.8, 1, 1000)).directions[0])(POSES[0, 0]))
        assert np.arccos(rays[0] @ rays[-1]) == pytest.approx(0.8, rel=2e-3)

    def test_resizing_keeps_the_view(self):
        @jax.jit
        def corners(view):  # rays through the corners of the image: half a pixel outside the first and last centres
            local = jnp.array([[0.0, 0.0, 1.0], [view.width, 0.0, 1.0], [view.width, view.height, 1.0]])
            return jnp.linalg.solve(view.intrinsics, jnp.broadcast_to(local.T, view.intrinsics.shape))

        small = resize(camera(), 2, 12)
        assert (small.height, small.width) == (2, 12)
        close(corners(small), corners(camera()))
        close(resize(small, 4, 6).intrinsics, camera().intrinsics)


class TestProject:
    @pytest.mark.parametrize("depth", [0.0, 2.0], ids=["at the eye's plane", "behind it"])
    def test_a_point_not_in_front_has_no_pixel_and_no_gradient(self, depth):
        view = pinhole(jnp.concatenate([jnp.eye(3), jnp.zeros((3, 1))], axis=1), 0.8, 4, 4)

        @jax.jit
        def pixels_distance_gradient(positions):
            (pixels, distance), pull_back = jax.vjp(lambda p: project(view, p), positions)
            return pixels, distance, pull_back((jnp.ones_like(pixels), jnp.zeros_like(distance)))[0]

        positions = jnp.array([[0.5, 0.2, depth]])
        pixels, distance, gradient = pixels_distance_gradient(positions)
        assert (pixels == -jnp.inf).all()
        assert distance[0] == pytest.approx(np.linalg.norm(positions))
        assert (gradient == 0).all()

    def test_a_point_in_the_eye_has_distance_zero_and_no_gradient(self):
        view = pinhole(POSES[0, 0], 0.8, 4, 4)
        distance, gradient = jax.value_and_grad(lambda p: jnp.sum(project(view, p)[1]))(EYES[0, 0][None])
        assert distance == 0
        assert (gradient == 0).all()


class TestBox:
    @pytest.mark.parametrize(
        ("origin", "direction", "expected"),
        [
            ((0, 0, 3), (0, 0, -1), (2, 4)),  # parallel to two pairs of faces
            ((2, 0, 3), (0, 0, -1), None),  # parallel and beside the box
            ((0, 0, 0), (0, 1, 0), (0, 1)),  # from inside
            ((0, 0, 1), (0, 0, -1), (0, 2)),  # from a face inwards
            ((0, 0, 1), (0, 0, 1), None),  # from a face outwards
            ((1, 0, 3), (0, 0, -1), (2, 4)),  # along a face, in it
            ((-1, -1, 3), (0, 0, -1), (2, 4)),  # along an edge, in it
            ((0, 0, 3), (0, 0, 1), None),  # the box lies behind
            ((2, 2, 2), (-1, -1, -1), (1, 3)),  # through two corners
            ((2, 0, 0), (-1, 1, 0), None),  # touches an edge
            ((0, 0, 3e8), (0, 0, -1), (3e8, 3e8)),  # so far away that the box has no depth in float32
        ],
    )
    def test_special_rays_are_finite_and_right(self, origin, direction, expected):
        near, far, hit = intersect_box(jnp.array(origin, jnp.float32), jnp.array(direction, jnp.float32))
        if expected and expected[0] < expected[1]:
            assert bool(hit)
            close((near, far), (jnp.float32(expected[0]), jnp.float32(expected[1])))
        else:
            assert not hit
            assert near == far == 0


class TestOrbit:
    @pytest.mark.parametrize("elevation", [-np.pi / 2, -0.4, 0.0, 1.2, np.pi / 2])
    def test_looks_at_the_centre_from_the_distance_azimuth_from_z_towards_x_even_from_straight_above(self, elevation):
        centre = jnp.array([0.3, -0.2, 0.1])
        pose = np.float64(orbit(2.5, elevation, 3.0, centre))
        close(pose[:, 3], centre + 3.0 * pose[:, 2], atol=1e-5)
        close(pose[[0, 2], 3] - centre[jnp.array([0, 2])], 3 * np.cos(elevation) * np.array([np.sin(2.5), np.cos(2.5)]))
        close(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-5)
        assert pose[1, 3] - centre[1] == pytest.approx(3 * np.sin(elevation), abs=1e-5)

    def test_poses_are_continuous_over_the_poles(self):
        for azimuth, pole in itertools.product((0.0, 1.0, 4.0), (-np.pi / 2, np.pi / 2, 1.5 * np.pi)):
            poses = [np.asarray(orbit(azimuth, pole + step, 3.0, jnp.zeros(3))) for step in (-2e-3, 0, 2e-3)]
            close(np.diff(poses, axis=0), np.zeros((2, 3, 4)), atol=1e-2)
