"""Poisson surfaces beside the networks: in the light of the data set, or empty where there is none."""

import importlib.util
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from support.handmade import RED, ball, plain
from support.surfel_clouds import cloud

from data_gen.render import light, views
from data_gen.render.poisson_surface import PoissonConfig
from experiments.comparison import poisson
from experiments.comparison.study_objects import cut
from spnr_jax.formats import data_sets, surface_points
from spnr_jax.formats.assets import Asset
from spnr_jax.kernels import cameras
from spnr_jax.surfels.skies import indoor_envmap

COUNT, QUICK = 500, PoissonConfig(depth=6)
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


@pytest.mark.skipif(importlib.util.find_spec("pymeshlab") is None, reason="pymeshlab is not installed")
def test_a_ball_is_rendered_as_its_reference_and_a_line_is_an_empty_picture(tmp_path):
    item, along = red_ball(), np.linspace(-0.9, 0.9, COUNT)
    line = replace(item, name="line", cloud=cloud(np.stack([0 * along, along, 0 * along], -1)))
    renderer = poisson.Renderer(SETTINGS, variant="scalar_rgb")
    method = poisson.keep_pictures(renderer, QUICK, tmp_path)
    shown, empty = method.show(item), method.show(line)
    assert -10 * np.log10(np.square(shown.image - data_sets.on_white(item.images)).mean()) > 30
    assert (empty.acc == 0).all()
    assert (empty.image == 1).all()
    assert "500 points on one line" in poisson.reconstruct(line.cloud, QUICK)
    assert min(poisson.seconds_per_view(tmp_path, ("ball", "line"))) > 0
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    method.show(item)  # nothing is left to do
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
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
    views.mitsuba_module().Bitmap(np.ones((4, 8, 3), np.float32)).write(str(other))
    with pytest.raises(ValueError, match=r"not the studio.hdr"):
        poisson.unscaled_light(described, other)


def test_a_data_set_without_a_renderer_setting_is_refused_by_name():
    with pytest.raises(ValueError, match="fov"):
        poisson.view_config({"settings": {k: v for k, v in vars(VIEW).items() if k != "fov"}})
    assert poisson.view_config({"settings": {**vars(VIEW), "seed": 3}}) == replace(VIEW, views=views.ViewConfig.views)
