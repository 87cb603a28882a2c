"""True depth is the distance along the ray, and an object's mesh is made again from its record or refused."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.handmade import ball, box

from data_gen.make import objects
from data_gen.plan.tasks import Task
from data_gen.render import views
from spnr_jax.formats import surface_points
from spnr_jax.formats.assets import Asset
from spnr_jax.kernels import cameras

EYE, SIZE = jnp.array([1.3, 0.8, 2.5]), 24
SEED = 3


def rays():
    pose = cameras.look_at(EYE, jnp.zeros(3), jnp.array([0.0, 1.0, 0.0]))
    found = cameras.camera_rays(cameras.pinhole(pose, 0.7, SIZE, SIZE))
    return jax.tree.map(lambda x: np.asarray(x).reshape(-1, 3), found)


def test_the_depth_of_a_box_is_the_distance_along_each_ray_to_its_nearest_side():
    found = views.caster(Asset(parts=(box(),)))(rays().origins, rays().directions)
    near, _, hit = map(
        np.asarray, cameras.intersect_box(*map(jnp.asarray, (rays().origins, rays().directions)), -0.5, 0.5)
    )
    assert 0.1 < np.mean(hit) < 0.9
    np.testing.assert_array_equal(np.isfinite(found), hit)
    np.testing.assert_allclose(found[hit], near[hit], rtol=1e-5)


def test_the_depth_of_a_ball_is_that_of_the_sphere():
    radius = 0.6
    found = views.caster(Asset(parts=(ball(radius=radius, rows=128),)))(rays().origins, rays().directions)
    along = -(rays().origins * rays().directions).sum(1)
    beside = (rays().origins ** 2).sum(1) - along**2
    hit = beside < (0.98 * radius) ** 2  # away from the outline, where a flat face is far from the sphere
    np.testing.assert_allclose(found[hit], (along - np.sqrt(np.maximum(radius**2 - beside, 0)))[hit], atol=1e-3)
    assert np.isinf(found[beside > radius**2]).all()


def test_faces_are_met_from_inside_and_whichever_way_they_are_turned():
    turned = dataclasses.replace(box(), faces=box().faces[:, ::-1])
    ray = np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32)
    for part in (box(), turned):
        np.testing.assert_allclose(views.caster(Asset(parts=(part,)))(*ray), [0.5], rtol=1e-6)


def made(task, count=50):
    """An object, its object.json and the points that lie beside it."""
    seeds = objects.object_seeds(SEED, task.object_id)
    asset, done = objects.make_asset(task, SEED)
    details = json.loads(json.dumps(objects.object_details(task, asset, seeds) | done))
    return asset, details, surface_points.sample_surface(asset, count, seeds["points"]).positions


def write_cube(path, height):
    """A mesh file of a box of this height."""
    path.parent.mkdir(exist_ok=True)
    corners = [(x, height * y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    faces = [(1, 2, 4), (1, 4, 3), (5, 7, 8), (5, 8, 6), (1, 5, 6), (1, 6, 2)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")


LAMP = Task(object_id="lamp_000004", category="lamp")
VARIANT = Task(object_id="lamp_000004--2", category="lamp", variant_of="lamp_000004", colour_variant=2)


def cube(root):
    """The task of a mesh file."""
    write_cube(root / "toys" / "cube.obj", 1.0)
    return Task(object_id="cube", path=root / "toys" / "cube.obj", shown_path="toys/cube.obj")


@pytest.mark.parametrize(
    "task_in",
    [lambda _: LAMP, lambda _: VARIANT, lambda _: dataclasses.replace(VARIANT, reshaped=True), cube],
    ids=["product", "colour variant", "reshaped", "mesh file"],
)
def test_an_object_is_made_again_from_its_record(task_in, tmp_path):
    asset, details, stored = made(task_in(tmp_path))
    again = objects.original(details, SEED, stored, tmp_path)
    for part, expected in zip(again.parts, asset.parts, strict=True):
        np.testing.assert_array_equal(part.positions, expected.positions)
        np.testing.assert_array_equal(part.faces, expected.faces)
        np.testing.assert_array_equal(part.material.base_color, expected.material.base_color)


def test_another_shape_under_the_same_name_and_a_mesh_that_is_not_there_are_refused(tmp_path):
    _, details, stored = made(LAMP)
    with pytest.raises(ValueError, match=r"^object lamp_000004: its points do not lie on the mesh[^\n]*generate"):
        objects.original(details, SEED + 1, stored)
    _, details, stored = made(cube(tmp_path))
    with pytest.raises(ValueError, match=r"^object cube was made from toys/cube.obj: [^\n]*--meshes$"):
        objects.original(details, SEED, stored)
    with pytest.raises(ValueError, match=r"cube.obj: the mesh of object cube is not there; [^\n]*--meshes$"):
        objects.original(details, SEED, stored, tmp_path / "elsewhere")
    write_cube(tmp_path / "toys" / "cube.obj", 1.5)
    with pytest.raises(ValueError, match="do not lie on the mesh"):
        objects.original(details, SEED, stored, tmp_path)
