"""Poisson surfaces beside the networks: in the light of the data set, or empty where there is none."""

import importlib.util
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from support.handmade import RED, ball, enclosed_volume, plain
from support.surfel_clouds import cloud

from data_gen.render import light, views
from experiments.comparison import poisson
from experiments.comparison.study_objects import cut
from spnr_jax.formats import data_sets, surface_points
from spnr_jax.formats.assets import Asset
from spnr_jax.kernels import cameras
from spnr_jax.kernels.triangles import vertex_normals
from spnr_jax.surfels.sides import spiral
from spnr_jax.surfels.skies import indoor_envmap

COUNT, QUICK, RADIUS = 500, poisson.Surface(depth=6), 0.7
needs_solver = pytest.mark.skipif(importlib.util.find_spec("pymeshlab") is None, reason="pymeshlab is not installed")
VIEW = views.ViewConfig(resolution=32, spp=16, views=2)
SETTINGS = {"settings": vars(VIEW), "environment_map": {"name": "procedural room", "sha256": None}}


def red_ball():
    """A red ball in the procedural room, as a data set holds it."""
    asset = Asset(parts=(ball(radius=0.7, material=plain(RED)),))
    surface = surface_points.sample_surface(asset, COUNT, 0)
    poses = views.random_viewpoints(VIEW.views, VIEW.distance, np.random.default_rng(5))
    images, conditions = views.render_views(asset, surface, poses, [light.scale_to_white(indoor_envmap())], VIEW, 6)
    camera = cameras.pinhole(jnp.asarray(poses[:, :3], jnp.float32), np.radians(VIEW.fov), 32, 32)
    points = cloud(surface.positions, base_color=surface.base_color, roughness=surface.roughness)
    return data_sets.ObjectData(name="ball", cloud=points, camera=camera, images=images, conditions=conditions)


@needs_solver
def test_a_ball_is_rendered_as_its_reference_and_a_line_is_an_empty_picture(monkeypatch):
    monkeypatch.setitem(poisson.SURFACES, "poisson", QUICK)
    item, along = red_ball(), np.linspace(-0.9, 0.9, COUNT)
    line = replace(item, name="line", cloud=cloud(np.stack([0 * along, along, 0 * along], -1)))
    renderer = poisson.Renderer(SETTINGS, variant="scalar_rgb")
    method = renderer.method("poisson")
    shown, empty = method.show(item), method.show(line)
    assert -10 * np.log10(np.square(shown.image - data_sets.on_white(item.images)).mean()) > 30
    assert (empty.acc == 0).all()
    assert (empty.image == 1).all()
    half = renderer.draw(poisson.reconstruct(item.cloud, QUICK), cut(item, None, 1, 16))
    assert half.shape == (1, 16, 16, 4)
    np.testing.assert_allclose(half[..., 3].mean() / 255, shown.acc[0].mean(), atol=0.02)


def test_the_light_has_to_be_that_of_the_data_set(tmp_path):
    other = tmp_path / "room.hdr"
    described = {"name": "studio.hdr", "sha256": "0" * 64}
    with pytest.raises(ValueError, match=r"--envmap: give studio.hdr"):
        poisson.unscaled_light(described, None)
    with pytest.raises(ValueError, match="leave the option out"):
        poisson.unscaled_light({"name": "procedural room", "sha256": None}, other)
    with pytest.raises(ValueError, match="each view of the data set has its own light"):
        poisson.unscaled_light({"kinds": [{"name": "random"}]}, None)
    views.mitsuba_module().Bitmap(np.ones((4, 8, 3), np.float32)).write(str(other))
    with pytest.raises(ValueError, match=r"not the studio.hdr"):
        poisson.unscaled_light(described, other)


def test_a_data_set_without_a_renderer_setting_is_refused_by_name():
    with pytest.raises(ValueError, match="fov"):
        poisson.view_config({"settings": {k: v for k, v in vars(VIEW).items() if k != "fov"}})
    assert poisson.view_config({"settings": {**vars(VIEW), "seed": 3}}) == replace(VIEW, views=views.ViewConfig.views)


def sphere_cloud(kept=COUNT):
    """Points of a sphere in many colours, the first of them not masked."""
    rng = np.random.default_rng(0)
    columns = {"base_color": rng.random((COUNT, 3)), "roughness": rng.random(COUNT), "metallic": rng.random(COUNT)}
    return cloud(RADIUS * spiral(COUNT), **columns).replace(mask=np.arange(COUNT) < kept)


@pytest.mark.parametrize(
    "positions",
    [np.zeros((1, 3)), np.ones((50, 3)), np.eye(3)[:2], np.outer(np.linspace(-1, 1, 100), [1.0, 2.0, 3.0])],
    ids=["one point", "one place", "two points", "a line"],
)
def test_points_that_span_no_surface_have_none_and_masked_ones_are_none(positions):
    assert poisson.reconstruct(cloud(positions), QUICK) is None
    assert poisson.reconstruct(sphere_cloud(kept=1), QUICK) is None


def test_trimming_cuts_off_the_least_supported_vertices_and_the_faces_on_them():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [2, 4, 3]])
    vertices, kept = poisson.trim(square, faces, np.array([4.0, 5, 6, 7, 1]), 0.2)
    np.testing.assert_array_equal(vertices, square[:4])
    np.testing.assert_array_equal(kept, faces[:2])
    np.testing.assert_array_equal(poisson.trim(square, faces, np.zeros(5), 0.0)[1], faces)


def test_the_normal_of_a_vertex_is_the_mean_of_its_faces_by_area_and_no_face_gives_the_y_axis():
    corners = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 1], [5, 5, 5]], float)
    found = vertex_normals(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    np.testing.assert_allclose(found[0], np.array([1, 0, 2]) / np.sqrt(5))
    np.testing.assert_allclose(found[1], [0, 0, 1])
    np.testing.assert_allclose(found[4], [0, 1, 0])


@needs_solver
def test_a_sphere_of_points_is_a_closed_sphere_that_faces_outwards_in_the_colours_of_the_nearest_points():
    sphere = sphere_cloud()
    (part,) = poisson.reconstruct(sphere, QUICK).parts
    edges = np.sort(part.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # watertight
    assert np.abs(np.linalg.norm(part.positions, axis=1) - RADIUS).max() < 0.03 * RADIUS
    volume = enclosed_volume(part.positions, part.faces)
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)  # and positive: faces turn outwards
    assert (part.normals * part.positions).sum(1).min() > 0.9 * RADIUS
    nearest = np.linalg.norm(part.positions[:, None] - np.asarray(sphere.positions)[None], axis=-1).argmin(1)
    np.testing.assert_array_equal(part.colors, sphere.base_color[nearest])
    np.testing.assert_array_equal(part.material.roughness, sphere.roughness[nearest])
    np.testing.assert_array_equal(part.material.metallic, sphere.metallic[nearest])
    np.testing.assert_array_equal(part.material.base_color, 1)


def test_roughness_and_metal_of_vertices_are_rendered_where_they_are():
    # one half of a ball is a mirror, the other matt: it looks as the two balls of one material do
    lamp = np.random.default_rng(7).random((8, 16, 3)).astype(np.float32)
    pose = views.look_at(np.array([0.0, 0.0, 3.0]))
    half = ball(radius=RADIUS).positions[:, 0] > 0

    def picture(roughness, metallic):
        material = plain((0.8, 0.8, 0.8), roughness, metallic)
        scene = views.build_scene(Asset(parts=(ball(radius=RADIUS, material=material),)), lamp)
        return views.render_view(scene, pose, views.ViewConfig(resolution=32, spp=16, views=2), 0)[12:20]

    mixed = picture(np.where(half, 0.2, 0.9), np.where(half, 1.0, 0.0))
    mirror, matt = picture(0.2, 1.0), picture(0.9, 0.0)
    assert np.abs(mixed - mirror)[:, 20:].mean() < 1e-3  # not 0: interpolation rounds, and the path tracer draws lobes
    assert np.abs(mixed - matt)[:, :12].mean() < 1e-3
    assert min(np.abs(mirror - matt)[:, part].mean() for part in (slice(20, 32), slice(12))) > 0.02
