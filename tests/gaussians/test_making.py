"""Splats of a ball whose pictures are known exactly: where they lie, what colour they have, what refining brings."""

import functools

import jax
import numpy as np
import pytest
from support import splat_balls
from support.surfel_clouds import estimate

from spnr_jax.gaussians import coloring, drawing, placing, refining
from spnr_jax.gaussians.drawing import rotations
from spnr_jax.gaussians.harmonics import C0
from spnr_jax.kernels.cameras import camera_rays

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
    return placing.View(camera, image, hit.astype(np.float32), depth.astype(np.float32))


@functools.cache
def views():
    around = [view(azimuth, 20.0 * (-1) ** i) for i, azimuth in enumerate(range(0, 360, 45))]
    return [*around, view(0, 85), view(0, -85)]


@functools.cache
def surfels():
    turn = np.pi * (1 + 5**0.5) * np.arange(600)
    height = 1 - (2 * np.arange(600) + 1) / 600
    around = np.sqrt(1 - height**2)
    positions = RADIUS * np.stack([around * np.cos(turn), height, around * np.sin(turn)], axis=-1).astype(np.float32)
    grey = np.full((600, 3), 0.5, np.float32)
    return estimate(positions, grey, np.full(600, 0.5, np.float32), np.zeros(600, np.float32), positions / RADIUS)


@functools.cache
def placed():
    return placing.place(placing.seen_surface(views(), surfels()), most=MOST, pixel=PIXEL)


@functools.cache
def colored():
    return coloring.colored(placed()[0], views(), side=placed()[1], degree=1)


def decibels(splats):
    errors = [(drawing.draw(splats, seen.camera)[0] - seen.image) ** 2 for seen in views()[::3]]
    return -10 * np.log10(np.mean(errors))


def test_splats_lie_on_the_surface_and_along_it():
    splats, side = placed()
    distance = np.linalg.norm(splats.position, axis=1)
    assert 0.6 * MOST < len(distance) <= MOST
    np.testing.assert_allclose(distance, RADIUS - placing.INSET * PIXEL, atol=0.03)
    normal = np.asarray(rotations(splats.rotation))[:, :, 2]
    assert (np.abs(np.sum(normal * splats.position, axis=1)) / distance).min() > 0.97
    assert side >= placing.FINEST * PIXEL


def test_pixels_far_from_every_surfel_are_no_surface():
    outside = [seen._replace(depth=seen.depth - np.float32(0.5)) for seen in views()]
    with pytest.raises(ValueError, match="no surface"):
        placing.seen_surface(outside, surfels())


def test_the_quaternions_turn_the_third_axis_to_the_normal():
    normal = np.random.default_rng(0).normal(size=(200, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[:2] = [0, 0, 1], [0, 0, -1]
    axis = np.asarray(rotations(placing.turned_to(normal)))[:, :, 2]
    np.testing.assert_allclose(axis, normal, atol=1e-6)


def test_colours_are_those_of_the_pictures():
    splats = colored()
    wanted = 0.5 + 0.3 * splats.position / np.linalg.norm(splats.position, axis=1, keepdims=True)
    inside = np.asarray(drawing.colors(splats, np.float32([0, 0, 3])))  # any eye: the ball does not shine
    facing = splats.position[:, 2] > 0.3
    np.testing.assert_allclose(inside[facing], wanted[facing], atol=0.06)
    np.testing.assert_allclose(0.5 + C0 * splats.harmonics[:, 0], wanted, atol=0.12)


def test_splats_that_stick_out_of_the_silhouettes_are_left_out():
    splats, side = placed()
    out = splats.replace(position=splats.position * np.where(np.arange(len(splats.position)) < 20, 1.5, 1)[:, None])
    kept = coloring.colored(out, views(), side=side, degree=0)
    assert np.linalg.norm(kept.position, axis=1).max() < 1.05 * RADIUS


@pytest.mark.ci
def test_refining_brings_decibels_and_moves_splats_little():
    refinement = refining.Refinement(colored(), views())
    losses = [refinement.step() for _ in range(40)]
    assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:10])
    assert decibels(refinement.gaussians) > decibels(colored()) + 1.5
    assert len(refinement.gaussians.opacity) == len(colored().opacity)
    moved = np.linalg.norm(refinement.gaussians.position - colored().position, axis=1)
    assert moved.max() < 2 * placed()[1]


def test_refining_the_same_again_gives_the_same():
    first, second = (refining.Refinement(colored(), views()) for _ in range(2))
    assert [first.step() for _ in range(3)] == [second.step() for _ in range(3)]
