"""What the network of rays tells of where an object is solid: its own pictures, in place, at any size."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close
from support.surfel_clouds import camera, cloud, shape

from spnr_jax.config import SOLID, RenderOptions, SurfelConfig
from spnr_jax.kernels import cameras
from spnr_jax.method import inference, solid, surfel_renderer
from spnr_jax.nn.shader import NUM_OUTPUTS, picture
from spnr_jax.surfels.features import NUM_MAPS
from spnr_jax.surfels.lighting import room_light
from spnr_jax.training import weights

NUM_POINTS, RADIUS = 700, 0.6


@pytest.fixture(scope="module")
def trained():
    return weights.read_trained("near_points")


def test_its_sizes_are_those_of_the_package_s_network(trained):
    assert trained.config.model == SOLID


@pytest.fixture(scope="module")
def points():
    return cloud(shape("sphere", NUM_POINTS)[0])


@pytest.fixture(scope="module")
def scene(trained, points):
    return solid.encode(trained.variables, points, config=SOLID)


@pytest.mark.ci
def test_a_small_picture_is_the_network_s_own(trained, scene):
    view = camera(solid.MOST_PIXELS)
    found = solid.seen(trained.variables, scene, view, config=SOLID)
    batched = jax.tree.map(lambda x: x[None, None], view)
    twin = inference.render(trained.variables, scene, batched, config=SOLID, options=RenderOptions())
    close(found[..., 0], twin.acc[0, 0], atol=1e-5)


@pytest.mark.parametrize("size", [(128, 128), (200, 150), (64, 96)])
def test_it_lies_where_the_object_is(trained, scene, size):
    view = cameras.resize(camera(128), *size)
    found = np.asarray(solid.seen(trained.variables, scene, view, config=SOLID))
    assert found.shape == (*size, 2)
    rays = jax.tree.map(np.float64, cameras.camera_rays(view))
    along = -np.sum(rays.origins * rays.directions, axis=-1)
    miss = np.sqrt(np.sum(rays.origins**2, axis=-1) - along**2)
    assert found[miss < RADIUS - 0.06, 0].min() > 0.9
    assert found[miss > RADIUS + 0.06, 0].max() < 0.1
    inside = miss < RADIUS - 0.06
    distance = along - np.sqrt(np.maximum(RADIUS**2 - miss**2, 0))
    axis = -np.sum(rays.directions * np.asarray(view.cam_to_world)[:, 2], axis=-1)
    assert np.abs(found[..., 1] - distance * axis)[inside].max() < 0.1


def test_dense_clouds_do_without(trained):
    many = cloud(shape("sphere", solid.MOST_POINTS + 1)[0])
    assert solid.encode(trained.variables, many, config=SOLID) is None


def test_the_renderer_asks_it_for_its_picture(trained):
    config = SurfelConfig(widths=(4, 4), top=4, solid=True)
    variables = jax.jit(surfel_renderer.init, static_argnums=1)(jax.random.key(0), config) | {
        "batch_stats": trained.variables
    }
    points = cloud(shape("sphere", NUM_POINTS)[0])
    scene = surfel_renderer.encode(variables, points, config=config)
    view = dataclasses.replace(camera(32), width=40)  # the window reaches beyond the picture
    with_rays = surfel_renderer.render(variables, scene, view, room_light(), config=config)
    without = surfel_renderer.render(
        variables, dataclasses.replace(scene, solid=None), view, room_light(), config=config
    )
    assert with_rays.image.shape == (32, 40, 3)
    assert np.abs(np.asarray(with_rays.acc) - np.asarray(without.acc)).max() > 0.01


def test_rays_and_discs_share_the_opacity():
    rng = np.random.default_rng(0)
    maps = rng.random((1, 4, 4, NUM_MAPS)).astype(np.float32)
    ambient = np.ones((1, 9, 3), np.float32)

    def opacity(trust, changed):
        outputs = np.zeros((1, 4, 4, NUM_OUTPUTS), np.float32)
        outputs[..., 19] = trust
        return np.asarray(picture(*map(jnp.asarray, (outputs, changed, ambient)), 0)[1])

    other = maps.copy()
    other[..., 17] = rng.random((1, 4, 4))
    close(opacity(-30, maps), opacity(-30, other), atol=1e-6)  # the discs alone
    close(opacity(30, other), other[..., 17], atol=0.02)  # the rays alone, but for what keeps the odds finite
    between = opacity(0, other)
    low, high = np.minimum(opacity(-30, other), opacity(30, other)), np.maximum(opacity(-30, other), opacity(30, other))
    assert np.all((between > low - 1e-6) & (between < high + 1e-6))
