"""Scenes that nobody meant to render, through the whole generator: what they look like, and gradients that stay finite.

Every scene has the shapes of the others, so one compilation renders all of them, in training mode: there the statistics
of the points are those of the scene.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import surfel_clouds, tiny_model
from support.laws import close, numbers

from spnr_jax.kernels import losses
from spnr_jax.kernels.cameras import camera_rays, intersect_box, resize
from spnr_jax.method import inference

pytestmark = pytest.mark.ci
MODEL, SIZE, NUM_POINTS = tiny_model.MODEL, tiny_model.SIZE, 32
RANDOM = 0.6 * np.asarray(numbers(0, NUM_POINTS, 3))
FIRST = np.arange(NUM_POINTS) == 0


def cloud(positions=RANDOM, mask=None, **materials):
    """One object (1, points, ...); materials are grey unless they are given."""
    points = surfel_clouds.cloud(positions, **materials)
    return jax.tree.map(lambda x: jnp.asarray(x)[None], points if mask is None else points.replace(mask=mask))


def camera(eye=(0.5, 0.8, 3.0), target=(0.0, 0.0, 0.0), field_of_view=0.9):
    """One view (1, 1, ...) of one object."""
    return jax.tree.map(lambda x: x[None, None], surfel_clouds.camera(SIZE, eye, field_of_view, target))


@pytest.fixture(scope="module")
def variables():
    fresh = jax.jit(inference.network(MODEL).init)(jax.random.key(0), cloud(), camera())
    return tiny_model.wobbled(fresh, 4)


@jax.jit
def rendered(variables, cloud, camera):
    """The rendering of a training step, and the gradients of an L1 loss by weights and by every number of the scene."""
    inputs = {f.name: getattr(cloud, f.name) for f in dataclasses.fields(cloud) if f.name != "mask"}
    inputs |= {"cam_to_world": camera.cam_to_world, "intrinsics": camera.intrinsics}

    def loss(params, inputs):
        places = {name: inputs[name] for name in ("cam_to_world", "intrinsics")}
        points = {name: x for name, x in inputs.items() if name not in places}
        rendering, _ = inference.network(MODEL).apply(
            variables | {"params": params},
            dataclasses.replace(cloud, **points),
            dataclasses.replace(camera, **places),
            train=True,
            mutable=["batch_stats"],
        )
        return losses.l1(rendering.image, jnp.full(rendering.image.shape, 0.3)), rendering

    gradients, rendering = jax.grad(loss, (0, 1), has_aux=True)(variables["params"], inputs)
    return rendering, gradients


def see(variables, cloud, camera):
    """(rendering, gradients by weights, gradients by inputs), after the laws that every scene obeys."""
    rendering, (by_weights, by_inputs) = jax.tree.map(np.asarray, rendered(variables, cloud, camera))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((rendering, by_weights, by_inputs)))
    assert ((rendering.image_lr >= -1e-6) & (rendering.image_lr <= 1 + 1e-6)).all()
    assert ((rendering.acc >= 0) & (rendering.acc <= 1 + 1e-6)).all()
    rays = camera_rays(resize(camera, *rendering.acc.shape[-2:]))
    near, far, hit = map(np.asarray, intersect_box(rays.origins, rays.directions))
    slack = 1e-5 * (1 + far)
    assert ((rendering.depth >= near - slack) & (rendering.depth <= far + slack)).all()
    assert (rendering.image_lr[~hit] == 1).all()
    return rendering, by_weights, by_inputs


SCENES = {
    "one point": (cloud(mask=FIRST), camera()),
    "equal points": (cloud(np.tile(RANDOM[:1], (NUM_POINTS, 1))), camera()),
    "two places": (cloud(np.repeat(RANDOM[:2], NUM_POINTS // 2, axis=0)), camera()),
    "a line": (cloud(np.linspace(-0.9, 0.9, NUM_POINTS)[:, None] * [1, 0.3, -0.5]), camera()),
    "a plane": (cloud(RANDOM * [1, 0, 1]), camera()),
    "the faces of the box": (cloud(np.sign(RANDOM)), camera()),
    "borders of voxels": (cloud(np.round(4 * RANDOM) / 4), camera()),
    "outside the box": (cloud(RANDOM + 3), camera()),
    "far outside the box": (cloud(1e30 * RANDOM), camera()),
    "no point": (cloud(mask=np.zeros(NUM_POINTS, bool)), camera()),
    "black": (cloud(base_color=np.zeros((NUM_POINTS, 3))), camera()),
    "white": (cloud(base_color=np.ones((NUM_POINTS, 3))), camera()),
    "a mirror": (cloud(roughness=np.zeros(NUM_POINTS), metallic=np.ones(NUM_POINTS)), camera()),
    "chalk": (cloud(roughness=np.ones(NUM_POINTS)), camera()),
    "inside the object": (cloud(), camera(eye=(0.0, 0.1, 0.2))),
    "on a point": (cloud(), camera(eye=RANDOM[0])),
    "on a face": (cloud(), camera(eye=(0.0, 0.0, 1.0))),
    "on a face, looking along it": (cloud(), camera(eye=(0.0, 0.0, 1.0), target=(1.0, 0.0, 1.0))),
    "on a corner": (cloud(), camera(eye=(1.0, 1.0, 1.0))),
    "along an axis": (cloud(), camera(eye=(0.0, 0.0, 3.0), field_of_view=0.0)),
    "in a face": (cloud(), camera(eye=(1.0, 0.0, 3.0), target=(1.0, 0.0, 0.0), field_of_view=0.0)),
    "along an edge": (cloud(), camera(eye=(1.0, 1.0, 3.0), target=(1.0, 1.0, 0.0), field_of_view=0.0)),
    "through an edge": (cloud(), camera(eye=(3.0, 0.0, 3.0), field_of_view=0.0)),
    "through two corners": (cloud(), camera(eye=(2.0, 2.0, 2.0), field_of_view=0.0)),
    "past an edge": (cloud(), camera(eye=(2.0, 0.0, 0.0), target=(1.0, 1.0, 0.0), field_of_view=0.0)),
    "half a sphere": (cloud(), camera(field_of_view=3.1)),
    "without a direction": (cloud(), camera(eye=(0.0, 0.0, 3.0), target=(0.0, 0.0, 3.0))),
    "upright": (cloud(), camera(eye=(0.0, 3.0, 0.0))),
    "far away": (cloud(), camera(eye=(0.0, 0.0, 1e6), field_of_view=1e-6)),
    "out of sight": (cloud(), camera(eye=(0.0, 0.0, 1e30))),
}


@pytest.mark.parametrize("name", SCENES)
def test_any_points_materials_and_camera_have_a_finite_picture_and_finite_gradients(variables, name):
    rendering, _, by_inputs = see(variables, *SCENES[name])
    if name in ("inside the object", "on a point", "along an axis", "through an edge", "through two corners"):
        assert (rendering.acc > 0).all(), "every ray passes the volume"
    if name in ("along an axis", "through an edge", "through two corners"):
        close(rendering.image_lr, np.broadcast_to(rendering.image_lr[..., :1, :1, :], rendering.image_lr.shape))
    if name in ("without a direction", "out of sight", "past an edge"):
        assert (rendering.image_lr == 1).all()
    if name in ("outside the box", "far outside the box"):  # points there are no points
        close(rendering, see(variables, *SCENES["no point"])[0], rtol=0, atol=0)
        assert all((by_inputs[field] == 0).all() for field in ("positions", "base_color", "roughness", "metallic"))


def test_looking_away_is_exactly_white_and_pulls_at_nothing_in_the_scene(variables):
    rendering, by_weights, by_inputs = see(variables, cloud(), camera(target=(1.0, 1.6, 6.0)))
    assert (rendering.image_lr == 1).all()
    assert (rendering.acc == 0).all()
    assert (rendering.depth == 0).all()
    assert all((x == 0).all() for x in jax.tree.leaves(by_inputs))
    assert all((x == 0).all() for part in ("encoder", "field") for x in jax.tree.leaves(by_weights[part]))
