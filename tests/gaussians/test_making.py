"""Splats of a ball whose pictures are known exactly: where they lie, what colour they have, what they look like."""

import functools

import jax
import numpy as np
import pytest
from support import splat_balls, splat_twin
from support.surfel_clouds import estimate

from spnr_jax.kernels.cameras import camera_rays
from spnr_jax.surfels import gaussians
from spnr_jax.surfels.gaussians import (
    C0,
    count_coefficients,
    degree_of,
    evaluate_harmonics,
    half_turn_signs,
    rotation_matrices,
)
from spnr_jax.surfels.sides import spiral

RADIUS, SIZE, MOST = 0.8, 48, 500
PIXEL = 3 / (0.5 * SIZE / np.tan(np.deg2rad(20)))


def view(azimuth, elevation):
    """The ball as it is: colours by its normal, a white background."""
    camera = splat_balls.camera(azimuth, elevation, SIZE)
    rays = camera_rays(camera)
    origin, direction = (np.asarray(x, np.float64) for x in (rays.origins, rays.directions))
    along = -np.sum(origin * direction, axis=-1)
    left = RADIUS**2 - (np.sum(origin**2, axis=-1) - along**2)
    depth = np.where(left > 0, along - np.sqrt(np.maximum(left, 0)), np.nan)
    hit = np.isfinite(depth)
    normal = (origin + np.where(hit, depth, 0)[..., None] * direction) / RADIUS
    image = np.where(hit[..., None], 0.5 + 0.3 * normal, 1).astype(np.float32)
    camera = jax.tree.map(np.asarray, camera)
    return gaussians.View(camera, image, hit.astype(np.float32), depth.astype(np.float32))


@functools.cache
def views():
    around = [view(azimuth, 20.0 * (-1) ** i) for i, azimuth in enumerate(range(0, 360, 45))]
    return [*around, view(0, 85), view(0, -85)]


@functools.cache
def surfels():
    return estimate(RADIUS * spiral(600), normals=spiral(600))


@functools.cache
def placed():
    return gaussians.place_splats(gaussians.collect_surface(views(), surfels()), most=MOST, pixel=PIXEL)


@functools.cache
def colored():
    return gaussians.color_splats(placed()[0], views(), side=placed()[1], degree=1)


def test_splats_lie_on_the_surface_and_along_it():
    splats, side = placed()
    distance = np.linalg.norm(splats.position, axis=1)
    assert 0.6 * MOST < len(distance) <= MOST
    np.testing.assert_allclose(distance, RADIUS - gaussians.INSET * PIXEL, atol=0.03)
    normal = rotation_matrices(splats.rotation)[:, :, 2]
    assert (np.abs(np.sum(normal * splats.position, axis=1)) / distance).min() > 0.97
    assert side >= gaussians.FINEST * PIXEL


@pytest.mark.parametrize("most", [6, 13, 29, 57, 120, 399])
def test_splats_are_as_wide_as_the_cubes_that_they_stand_for(most):
    surface = gaussians.collect_surface(views(), surfels())
    splats, side = gaussians.place_splats(surface, most=most, pixel=PIXEL)
    assert len(splats.position) <= most
    assert gaussians._group_pixels(surface, surface.position.min(axis=0), side)[0] == len(splats.position)
    shares = np.array([[gaussians.WIDTH, gaussians.WIDTH, gaussians.THICKNESS]])
    np.testing.assert_allclose(splats.scale, np.repeat(side * shares, len(splats.scale), axis=0), rtol=1e-6)


def test_fewer_splats_than_sides_are_refused():
    with pytest.raises(ValueError, match="most=5, expected 6 or more"):
        gaussians.place_splats(gaussians.collect_surface(views(), surfels()), most=5, pixel=PIXEL)


def test_pixels_far_from_every_surfel_are_no_surface():
    outside = [seen._replace(depth=seen.depth - np.float32(0.5)) for seen in views()]
    with pytest.raises(ValueError, match="no surface"):
        gaussians.collect_surface(outside, surfels())


def test_the_quaternions_turn_the_third_axis_to_the_normal():
    normal = np.random.default_rng(0).normal(size=(200, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[:2] = [0, 0, 1], [0, 0, -1]
    axis = rotation_matrices(gaussians.rotate_to(normal))[:, :, 2]
    np.testing.assert_allclose(axis, normal, atol=1e-6)


def test_colours_are_those_of_the_pictures():
    splats = colored()
    wanted = 0.5 + 0.3 * splats.position / np.linalg.norm(splats.position, axis=1, keepdims=True)
    inside = np.stack([splat_twin.color(splats, i, np.array([0, 0, 3])) for i in range(len(wanted))])  # any eye
    facing = splats.position[:, 2] > 0.3
    np.testing.assert_allclose(inside[facing], wanted[facing], atol=0.06)
    np.testing.assert_allclose(0.5 + C0 * splats.harmonics[:, 0], wanted, atol=0.12)


def test_splats_that_stick_out_of_the_silhouettes_are_left_out():
    splats, side = placed()
    out = splats.replace(position=splats.position * np.where(np.arange(len(splats.position)) < 20, 1.5, 1)[:, None])
    kept = gaussians.color_splats(out, views(), side=side, degree=0)
    assert np.linalg.norm(kept.position, axis=1).max() < 1.05 * RADIUS


def test_splats_look_like_the_pictures_that_they_are_made_from():
    for seen in views()[::4]:
        image, opacity = splat_twin.draw(colored(), seen.camera)
        inside = (seen.opacity > 0) & (opacity > 0.5)
        assert inside.sum() > 0.9 * seen.opacity.sum()
        assert -10 * np.log10(np.mean((image - seen.image)[inside] ** 2)) > 27
        assert -10 * np.log10(np.mean((image - seen.image) ** 2)) > 19


def test_harmonics_are_orthonormal_and_turn_half_around_by_signs():
    nodes = np.random.default_rng(0).normal(size=(200_000, 3))
    nodes /= np.linalg.norm(nodes, axis=1, keepdims=True)
    values = evaluate_harmonics(nodes, 3)
    np.testing.assert_allclose(4 * np.pi * values.T @ values / len(nodes), np.eye(16), atol=0.03)
    np.testing.assert_allclose(evaluate_harmonics(nodes * [1, -1, -1], 3), values * half_turn_signs(3), atol=1e-12)
    assert [degree_of(count_coefficients(degree)) for degree in range(4)] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="got 5"):
        degree_of(5)
