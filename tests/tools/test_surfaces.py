"""The surface that pictures show: its depth, what they say is solid, and a closed mesh in the file's frame that wears
the materials of the nearest points."""

import dataclasses
import functools
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from support import splat_balls, tiny_untrained
from support.solid_ball import CENTRE, RADIUS, ball_cloud, ball_grid
from support.surfel_clouds import cloud

import spnr_jax
from spnr_jax.formats.meshes import load_mesh
from spnr_jax.kernels.cameras import camera_rays
from spnr_jax.kernels.records import Rendering, Volume
from spnr_jax.surfels.gaussians import View
from spnr_jax.tools import surfaces
from spnr_jax.tools.surfaces import Grid, mesh_of, surface_depth

UNIT = 10.0  # half diagonal of the cloud, in its own units


@pytest.fixture(scope="module")
def scene():
    """Volume and camera of a cube of points that is large and far from 0."""
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3) * UNIT / np.sqrt(3)
    model = spnr_jax.load(tiny_untrained.run())
    volume = model.encode(cloud(corners + [50, 0, -20]))
    return volume, model.camera(volume, 0.0, 0.0, 24)


def rendering(depth, acc):
    image = np.zeros((*depth.shape, 3), np.float32)
    return Rendering(image=image, image_lr=image, depth=np.float32(depth), acc=np.float32(acc))


def test_the_background_that_shines_through_is_taken_out_again(scene):
    volume, camera = scene
    size = (5, 5)  # the middle pixel looks along the axis: the box's back is at 3 + 1 units of the box
    acc = np.random.default_rng(0).uniform(0.55, 1, size)
    distance, back = 3.2 * UNIT, 4 * UNIT
    mean = acc * distance + (1 - acc) * back
    hit = surface_depth(rendering(mean, acc), camera, volume)
    np.testing.assert_allclose(hit[2, 2], distance, rtol=1e-4)
    opaque = surface_depth(rendering(np.full(size, distance), np.ones(size)), camera, volume)
    np.testing.assert_allclose(opaque, distance, rtol=1e-6)


def test_what_lets_most_of_the_light_pass_has_no_depth(scene):
    volume, camera = scene
    acc = np.array([[0.0, 0.49], [0.51, 1.0]])
    hit = surface_depth(rendering(np.full((2, 2), 30.0), acc), camera, volume)
    np.testing.assert_array_equal(np.isnan(hit), acc < 0.5)


# what pictures with known depth say is solid: a ball, a plate thinner than the band


SIZE, RESOLUTION = 160, 49
STEP = 2 / (RESOLUTION - 1)
DEEP = (surfaces.BAND + 1) * STEP
SOLID = 0.7  # radius in the box
HALF = np.array([0.6, 0.5, 0.5 * STEP])  # of the plate's sides; as thick as a step of the grid


def ball(origin, direction):
    """Distance to the ball along rays, NaN where they miss it."""
    along = -np.sum(origin * direction, axis=-1)
    left = SOLID**2 - (np.sum(origin**2, axis=-1) - along**2)
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
    return surfaces.solidity(seen, volume, placed, RESOLUTION)


@pytest.fixture(scope="module")
def axes():
    return np.stack(np.meshgrid(*[np.linspace(-1, 1, RESOLUTION)] * 3, indexing="ij"), axis=-1)


def test_a_ball_is_solid_inside_also_where_no_picture_looks_and_its_surface_lies_within_a_step(axes):
    grid = fused(views(ball))
    np.testing.assert_allclose(grid.lowest, [0.5, 1.5, 2.5])
    np.testing.assert_allclose(grid.lowest + grid.spacing * (RESOLUTION - 1), [1.5, 2.5, 3.5])
    distance = np.linalg.norm(axes, axis=-1)
    assert (grid.values[distance < SOLID - DEEP] == 1).all()
    assert (grid.values[distance > SOLID + DEEP] == 0).all()
    solid = mesh_of(grid, ball_cloud())
    assert solid.watertight
    vertices = loaded(solid.content).vertices
    np.testing.assert_allclose(2 * np.linalg.norm(vertices - [1, 2, 3], axis=1), SOLID, atol=STEP)


def test_the_far_side_of_a_thin_plate_does_not_fill_what_lies_before_it(axes):
    grid = fused(views(plate))
    inside = (np.abs(axes[..., 0]) < HALF[0] - 3 * STEP) & (np.abs(axes[..., 1]) < HALF[1] - 3 * STEP)
    assert (grid.values[inside & (axes[..., 2] == 0)] > 0.5).all()
    beside = np.abs(axes[..., 2]) > 1.5 * STEP
    assert (grid.values[beside] < 0.5).all()


def test_what_few_pictures_are_against_stays(axes):
    seen = views(ball)
    spoilt = [view._replace(depth=np.full_like(view.depth, np.nan)) for view in seen[: surfaces.AGREE - 1]]
    grid = fused([*spoilt, *seen[surfaces.AGREE - 1 :]])
    assert (grid.values[np.linalg.norm(axes, axis=-1) < SOLID - DEEP] == 1).all()


# the mesh


def loaded(content: bytes) -> trimesh.Trimesh:
    """The file's only mesh in its place, just as trimesh reads it."""
    scene = trimesh.load(io.BytesIO(content), file_type="glb")
    assert len(scene.geometry) == 1
    return scene.to_geometry()


def test_a_ball_becomes_a_closed_mesh_of_its_size_in_its_place_with_the_outside_outside():
    solid = mesh_of(ball_grid(), ball_cloud())
    mesh = loaded(solid.content)
    assert len(mesh.faces) == solid.faces
    assert mesh.is_watertight
    assert solid.watertight
    np.testing.assert_allclose(mesh.volume, 4 / 3 * np.pi * RADIUS**3, rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTRE, axis=1), RADIUS, atol=0.01)


def shown_at(material, texcoords):
    """(roughness, metallic) at texture coordinates, by the bilinear rule of glTF."""
    height, width = material.roughness.shape
    places = np.clip(texcoords * [width, height] - 0.5, 0, [width - 1, height - 1])
    left = np.minimum(places.astype(int), [width - 2, height - 2])
    (a, b) = (places - left).T
    i, j = left.T
    channels = [material.roughness, material.metallic]
    rows = [[(1 - a) * c[j + k, i] + a * c[j + k, i + 1] for k in (0, 1)] for c in channels]
    return [(1 - b) * above + b * below for above, below in rows]


@pytest.mark.parametrize("up", ["y", "z", "-x"])
def test_each_place_wears_the_material_of_the_points_there_whichever_way_is_up(tmp_path, up):
    (tmp_path / "a.glb").write_bytes(mesh_of(ball_grid(), ball_cloud(up)).content)
    (part,) = load_mesh(tmp_path / "a.glb").parts
    x = part.positions[:, 0] - CENTRE[0]
    roughness, metallic = shown_at(part.material, part.texcoords)
    for side, color, shine in (x > 0.5, [1, 0, 0], (1, 0)), (x < -0.5, [0, 0, 1], (0.25, 1)):
        np.testing.assert_allclose(part.colors[side], np.broadcast_to(color, (side.sum(), 3)), atol=1e-6)
        np.testing.assert_allclose(roughness[side], shine[0], atol=1e-3)
        np.testing.assert_allclose(metallic[side], shine[1], atol=1e-3)
    outward = ((part.positions - CENTRE) * part.normals).sum(axis=1) / RADIUS
    assert outward.min() > 0.9


def test_a_mesh_far_from_the_origin_keeps_its_precision():
    origin = (500_000.0, 4_000_000.0, 100.0)
    bounds = loaded(mesh_of(ball_grid(origin), ball_cloud(origin=origin)).content).bounds
    np.testing.assert_allclose(bounds, np.array(origin) + CENTRE + [[-RADIUS] * 3, [RADIUS] * 3], atol=0.02)


def test_a_surface_at_the_edge_of_the_grid_is_closed():
    grid = Grid(values=np.ones((5, 5, 5), np.float32), lowest=np.zeros(3), spacing=1.0, origin=np.zeros(3))
    mesh = loaded(mesh_of(grid, ball_cloud()).content)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [[-0.5] * 3, [4.5] * 3])


def test_a_grid_without_a_surface_is_refused():
    grid = ball_grid()
    with pytest.raises(ValueError, match="no surface to write as a mesh: .* show nothing solid"):
        mesh_of(dataclasses.replace(grid, values=0.5 * grid.values), ball_cloud())
