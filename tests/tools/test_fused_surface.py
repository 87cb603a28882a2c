"""What pictures with known depth say is solid: a ball, a plate thinner than the band, what no picture sees."""

import dataclasses
import functools
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from support import splat_balls
from support.solid_ball import ball_cloud

from spnr_jax.kernels.cameras import camera_rays
from spnr_jax.kernels.records import Volume
from spnr_jax.surfels.gaussians import View
from spnr_jax.tools import mesh_export
from spnr_jax.tools.mesh_export import mesh_of

SIZE, RESOLUTION = 160, 49
STEP = 2 / (RESOLUTION - 1)
DEEP = (mesh_export.BAND + 1) * STEP
RADIUS = 0.7
HALF = np.array([0.6, 0.5, 0.5 * STEP])  # of the plate's sides; as thick as a step of the grid


def ball(origin, direction):
    """Distance to the ball along rays, NaN where they miss it."""
    along = -np.sum(origin * direction, axis=-1)
    left = RADIUS**2 - (np.sum(origin**2, axis=-1) - along**2)
    return np.where(left > 0, along - np.sqrt(np.maximum(left, 0)), np.nan)


def plate(origin, direction):
    """Distance to the plate."""
    with np.errstate(divide="ignore"):
        ends = np.stack([(-HALF - origin) / direction, (HALF - origin) / direction])
    enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    return np.where(enter < leave, enter, np.nan)


@functools.cache
def views(shape, elevations=(-75, -40, -10, 10, 40, 75)):
    """Pictures of it from all around."""
    found = []
    for turn, elevation in enumerate(elevations):
        for azimuth in range(0, 360, 60):
            camera = splat_balls.camera(float(azimuth + 17 * turn), float(elevation), SIZE)
            rays = camera_rays(camera)
            depth = shape(*(np.asarray(x, np.float64) for x in (rays.origins, rays.directions))).astype(np.float32)
            hit = np.isfinite(depth).astype(np.float32)
            found.append(View(jax.tree.map(np.asarray, camera), np.ones((SIZE, SIZE, 3), np.float32), hit, depth))
    return found


def fused(seen):
    """The grid in a box around (1, 2, 3) that is half as large in the file."""
    volume = Volume(scene=None, centre=jnp.array([1.0, 2, 3]), scale=jnp.float32(2), reach=1)
    placed = dataclasses.replace(ball_cloud(), up="y", rotation=np.eye(3), origin=np.zeros(3))
    return mesh_export.solidity(seen, volume, placed, RESOLUTION)


@pytest.fixture(scope="module")
def axes():
    return np.stack(np.meshgrid(*[np.linspace(-1, 1, RESOLUTION)] * 3, indexing="ij"), axis=-1)


def test_a_ball_is_solid_inside_also_where_no_picture_looks_and_its_surface_lies_within_a_step(axes):
    grid = fused(views(ball))
    np.testing.assert_allclose(grid.lowest, [0.5, 1.5, 2.5])
    np.testing.assert_allclose(grid.lowest + grid.spacing * (RESOLUTION - 1), [1.5, 2.5, 3.5])
    distance = np.linalg.norm(axes, axis=-1)
    assert (grid.values[distance < RADIUS - DEEP] == 1).all()
    assert (grid.values[distance > RADIUS + DEEP] == 0).all()
    solid = mesh_of(grid, ball_cloud())
    assert solid.watertight
    vertices = trimesh.load(io.BytesIO(solid.content), file_type="glb").to_geometry().vertices
    np.testing.assert_allclose(2 * np.linalg.norm(vertices - [1, 2, 3], axis=1), RADIUS, atol=STEP)


def test_the_far_side_of_a_thin_plate_does_not_fill_what_lies_before_it(axes):
    grid = fused(views(plate))
    inside = (np.abs(axes[..., 0]) < HALF[0] - 3 * STEP) & (np.abs(axes[..., 1]) < HALF[1] - 3 * STEP)
    assert (grid.values[inside & (axes[..., 2] == 0)] > 0.5).all()
    beside = np.abs(axes[..., 2]) > 1.5 * STEP
    assert (grid.values[beside] < 0.5).all()


def test_what_few_pictures_are_against_stays(axes):
    seen = views(ball)
    spoilt = [view._replace(depth=np.full_like(view.depth, np.nan)) for view in seen[: mesh_export.AGREE - 1]]
    grid = fused([*spoilt, *seen[mesh_export.AGREE - 1 :]])
    assert (grid.values[np.linalg.norm(axes, axis=-1) < RADIUS - DEEP] == 1).all()
