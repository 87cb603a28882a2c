"""Laws of the reconstruction: a sphere of points is a sphere again, facing outwards, in the colours of its points."""

import importlib.util

import numpy as np
import pytest
from support.handmade import ball, plain
from support.surfel_clouds import cloud

from data_gen.render import poisson_surface, views
from data_gen.render.poisson_surface import NoSurface, PoissonConfig
from spnr_jax.formats.assets import Asset

needs_solver = pytest.mark.skipif(importlib.util.find_spec("pymeshlab") is None, reason="pymeshlab is not installed")
RADIUS, COUNT = 0.7, 600
QUICK = PoissonConfig(depth=6)


def directions(count=COUNT, seed=0):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def cloud_of(positions, seed=1):
    rng, count = np.random.default_rng(seed), len(positions)
    columns = {"base_color": rng.random((count, 3)), "roughness": rng.random(count), "metallic": rng.random(count)}
    return cloud(positions, **columns)


SPHERE = cloud_of(RADIUS * directions())


def test_the_normals_of_a_sphere_point_outwards_wherever_it_stands():
    for centre in ([0, 0, 0], [5.0, -3, 2]):
        found = poisson_surface.orient_normals(RADIUS * directions() + centre)
        assert (found * directions()).sum(1).min() > 0.97


def test_the_normals_of_two_separate_boxes_point_out_of_their_own_box():
    rng = np.random.default_rng(3)
    faces = rng.uniform(-1, 1, (2, 400, 3))
    axis, side = rng.integers(0, 3, (2, 400)), rng.choice([-1.0, 1.0], (2, 400))
    np.put_along_axis(faces, axis[..., None], side[..., None], axis=-1)
    outwards = side.ravel()[:, None] * np.eye(3)[axis.ravel()]
    found = poisson_surface.orient_normals((faces + [[[0, 0, 0]], [[9, 0, 0]]]).reshape(-1, 3), 10)
    middle = (np.sort(np.abs(faces), axis=-1)[..., 1] < 0.7).ravel()  # away from the edges, where planes are mixed
    assert (found * outwards).sum(1)[middle].min() > 0.9


def test_the_normals_of_an_open_dome_point_away_from_its_middle_wherever_it_stands():
    dome = directions()[directions()[:, 2] > 0.3]
    for centre in ([0, 0, 0], [0, 0, -9]):
        assert (poisson_surface.orient_normals(RADIUS * dome + centre) * dome).sum(1).min() > 0.8


def test_the_order_of_the_points_does_not_matter_to_their_normals():
    positions, order = RADIUS * directions(), np.random.default_rng(2).permutation(COUNT)
    found, shuffled = (poisson_surface.orient_normals(x) for x in (positions, positions[order]))
    np.testing.assert_allclose(shuffled, found[order], atol=1e-9)


@pytest.mark.parametrize(
    "positions",
    [np.zeros((1, 3)), np.ones((50, 3)), np.eye(3)[:2], np.outer(np.linspace(-1, 1, 100), [1.0, 2.0, 3.0])],
    ids=["one point", "one place", "two points", "a line"],
)
def test_points_that_span_no_surface_are_refused_in_one_line(positions):
    with pytest.raises(NoSurface, match=f"^{len(positions)} points[^\n]*a surface needs[^\n]*$"):
        poisson_surface.reconstruct(cloud_of(positions), QUICK)


def test_masked_points_are_no_points():
    with pytest.raises(NoSurface, match="^1 points"):
        poisson_surface.reconstruct(SPHERE.replace(mask=np.arange(COUNT) < 1), QUICK)


def test_trimming_cuts_off_the_least_supported_vertices_and_the_faces_on_them():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [2, 4, 3]])
    vertices, kept = poisson_surface.trim(square, faces, np.array([4.0, 5, 6, 7, 1]), 0.2)
    np.testing.assert_array_equal(vertices, square[:4])
    np.testing.assert_array_equal(kept, faces[:2])
    np.testing.assert_array_equal(poisson_surface.trim(square, faces, np.zeros(5), 0.0)[1], faces)


def test_the_normal_of_a_vertex_is_the_mean_of_its_faces_by_area_and_no_face_gives_the_y_axis():
    corners = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 1], [5, 5, 5]], float)
    found = poisson_surface.vertex_normals(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    np.testing.assert_allclose(found[0], np.array([1, 0, 2]) / np.sqrt(5))
    np.testing.assert_allclose(found[1], [0, 0, 1])
    np.testing.assert_allclose(found[4], [0, 1, 0])


@needs_solver
def test_a_sphere_of_points_is_a_closed_sphere_that_faces_outwards_in_the_colours_of_the_nearest_points():
    asset = poisson_surface.reconstruct(SPHERE, QUICK)
    (part,) = asset.parts
    edges = np.sort(part.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # watertight
    assert np.abs(np.linalg.norm(part.positions, axis=1) - RADIUS).max() < 0.03 * RADIUS
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    volume = np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)  # and positive: faces turn outwards
    assert (part.normals * part.positions).sum(1).min() > 0.9 * RADIUS
    nearest = np.linalg.norm(part.positions[:, None] - np.asarray(SPHERE.positions)[None], axis=-1).argmin(1)
    np.testing.assert_array_equal(part.colors, SPHERE.base_color[nearest])
    np.testing.assert_array_equal(part.material.roughness, SPHERE.roughness[nearest])
    np.testing.assert_array_equal(part.material.metallic, SPHERE.metallic[nearest])
    np.testing.assert_array_equal(part.material.base_color, 1)


def test_a_missing_solver_is_one_line_that_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pymeshlab", None)
    with pytest.raises(ValueError, match=r"^Poisson[^\n]*pip install[^\n]*baselines[^\n]*$"):
        poisson_surface.reconstruct(SPHERE, QUICK)


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
