"""What the ray-marching network tells of where an object is solid: its own pictures, in place, at any size."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close
from support.surfel_clouds import camera, cloud, shape

from spnr_jax.config import SOLID, RenderOptions, SurfelConfig
from spnr_jax.kernels import cameras
from spnr_jax.method import inference, solid, surfel_pictures, surfel_renderer
from spnr_jax.nn.shader import NUM_OUTPUTS, picture
from spnr_jax.surfels.features import NUM_MAPS
from spnr_jax.training import weights

NUM_POINTS, RADIUS = 700, 0.6
seen = jax.jit(solid.seen)


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
    return jax.jit(solid.encode)(trained.variables, points)


@pytest.mark.ci
def test_a_small_picture_is_the_network_s_own(trained, scene):
    view = camera(solid.MOST_PIXELS)
    found = seen(trained.variables, scene, view)
    batched = jax.tree.map(lambda x: x[None, None], view)
    twin = inference.render(trained.variables, scene, batched, config=SOLID, options=RenderOptions())
    close(found[..., 0], twin.acc[0, 0], atol=1e-5)


@pytest.mark.parametrize("size", [(128, 128), (200, 150), (64, 96)])
def test_it_lies_where_the_object_is(trained, scene, size):
    view = cameras.resize(camera(128), *size)
    found = np.asarray(seen(trained.variables, scene, view))
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


def volume_of(trained, count, params, config):
    """The handle's volume of a ball of so many points."""
    points = cloud(shape("sphere", count)[0])
    return surfel_pictures.encode_volume(params, points, np.zeros(3, np.float32), np.float32(1), config=config)


@pytest.fixture(scope="module")
def asking(trained):
    """A config that asks the ray-marching network, and its variables."""
    config = SurfelConfig(widths=(4, 4), top=4, solid=True)
    shader = jax.jit(surfel_renderer.init, static_argnums=1)(jax.random.key(0), config)
    return config, shader | {"batch_stats": trained.variables}


def test_dense_clouds_do_without(trained, asking):
    config, params = asking
    dense = volume_of(trained, solid.MOST_POINTS + 1, params, config)
    assert dense.solid is None
    assert not surfel_renderer.plan(dense.scene, camera(32)).solid


def test_the_renderer_asks_it_for_its_picture_and_the_pure_function_too(trained, asking):
    config, params = asking
    volume = volume_of(trained, NUM_POINTS, params, config)
    view = dataclasses.replace(camera(32), width=40)  # the window reaches beyond the picture
    with_rays, without = (
        surfel_pictures.draw(params, of, view, None, config=config, quality="best")
        for of in (volume, dataclasses.replace(volume, solid=None))
    )
    assert with_rays.image.shape == (32, 40, 3)
    assert np.abs(np.asarray(with_rays.acc) - np.asarray(without.acc)).max() > 0.01
    plan = surfel_renderer.plan(volume.scene, view)
    assert plan.solid
    pure = jax.jit(surfel_renderer.render, static_argnames="plan")(params, volume.scene, view, plan=plan)
    close(pure.acc, with_rays.acc, atol=0.01)


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
