"""Laws of the environment light: where a map's directions point, and how bright it is made."""

import numpy as np
import pytest
from support.handmade import ball, plain

from data_gen.render import light, views
from spnr_jax.formats.assets import Asset
from spnr_jax.surfels.lighting import texel_directions
from spnr_jax.surfels.skies import indoor_envmap


def solid_angle_mean(envmap):
    """The mean radiance over all directions: what a white diffuse sphere shows on average, in closed form."""
    theta = np.pi * (np.arange(len(envmap)) + 0.5) / len(envmap)
    weights = np.broadcast_to(np.sin(theta)[:, None], envmap.shape[:2])
    return float((envmap.mean(-1) * weights).sum() / weights.sum())


@pytest.fixture(scope="module")
def room():
    return indoor_envmap(64)


def test_a_white_diffuse_sphere_averages_0_6_under_the_scaled_map(room):
    scaled = light.scale_to_white(room)
    assert light.white_sphere_radiance(scaled, num_views=24, seed=5) == pytest.approx(0.6, rel=0.01)
    assert solid_angle_mean(scaled) == pytest.approx(0.6, rel=0.01)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_light_from_a_direction_of_the_map_falls_on_that_side_of_an_object(axis, sign):
    towards = sign * np.eye(3)[axis]
    envmap = (texel_directions(32) @ towards > 0.8)[..., None] * np.ones(3, np.float32) * 5
    scene = views.build_scene(Asset(parts=(ball(radius=0.6, material=plain()),)), envmap)
    config = views.ViewConfig(resolution=8, spp=16)
    lit = views.render_view(scene, views.look_at(3 * towards + 0.01), config, 0)
    dark = views.render_view(scene, views.look_at(-3 * towards + 0.01), config, 0)
    assert lit[..., :3].mean() > 10 * dark[..., :3].mean()
