"""Laws of the environment light: where a map's directions point, and how bright it is made."""

import numpy as np
import pytest
from support.handmade import ball, plain

from data_gen.render import light, variant, views
from spnr_jax.formats.assets import Asset
from spnr_jax.surfels.lighting import texel_directions
from spnr_jax.surfels.sides import spiral
from spnr_jax.surfels.skies import indoor_envmap


def test_a_white_diffuse_sphere_averages_0_6_under_the_scaled_map():
    mi = variant.mitsuba_module()
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2, "hide_emitters": True},
            "light": {"type": "envmap", "bitmap": mi.Bitmap(light.scale_to_white(7 * indoor_envmap(64)))},
            "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 1.0}},
        }
    )
    config = views.ViewConfig(resolution=16, spp=64)
    poses = [views.look_at(config.distance * eye) for eye in spiral(24)]
    sensors = [views.make_sensor(pose, config, config.resolution) for pose in poses]
    pictures = np.array([np.array(mi.render(scene, sensor=sensors[i], spp=64, seed=i)) for i in range(24)], np.float64)
    assert pictures[..., :3].mean(-1).sum() / pictures[..., 3].sum() == pytest.approx(0.6, rel=0.01)


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


def test_random_maps_follow_from_their_generator_and_differ():
    maps = [light.random_map(np.random.default_rng(seed)) for seed in (0, 0, 1, 2, 3)]
    np.testing.assert_array_equal(maps[0], maps[1])
    assert all(np.isfinite(x).all() and x.min() >= 0 and x.max() > 0 for x in maps)
    assert len({x.tobytes() for x in maps}) == 4
