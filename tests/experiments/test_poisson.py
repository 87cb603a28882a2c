"""Poisson surfaces beside the networks: in the light of the data set, or empty where there is none."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from support.handmade import RED, ball, plain

from data_gen.render import light, views
from data_gen.render.poisson_surface import PoissonConfig
from data_gen.store import layout
from experiments.comparison import poisson
from experiments.comparison.study_objects import cut
from spnr_jax.formats import data_sets
from spnr_jax.formats.mesh import surface_points
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.surfels.skies import indoor_envmap

needs_solver = pytest.mark.skipif(importlib.util.find_spec("pymeshlab") is None, reason="pymeshlab is not installed")
RADIUS, COUNT = 0.7, 600


VIEW = views.ViewConfig(resolution=32, spp=16, views=2)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A data set of one red ball and one line of points, lit by the procedural room."""
    folder = tmp_path_factory.mktemp("poisson") / "data"
    asset = Asset(parts=(ball(radius=RADIUS, material=plain(RED)),))
    surface = surface_points.sample_surface(asset, COUNT, 0)
    poses = views.random_viewpoints(VIEW.views, VIEW.distance, np.random.default_rng(5))
    lamp = light.scale_to_white(indoor_envmap())
    images, conditions = views.render_views(asset, surface, poses, [lamp], VIEW, 6)
    packed = layout.pack_points(surface)
    line = packed.copy()
    line["x"], line["y"], line["z"] = 0, np.linspace(-0.9, 0.9, COUNT), 0
    for name, content in (("ball", packed), ("line", line)):
        layout.write_object(
            folder,
            name,
            layout.ObjectRecord(
                points=content,
                transforms=layout.nerf_transforms(poses, VIEW.resolution, VIEW.fov, VIEW.focal_length),
                images=images,
                conditions=conditions,
                details={},
            ),
        )
    for split, names in (("train", ""), ("val", ""), ("test", "ball\nline\n")):
        layout.write_text(folder / "splits" / f"{split}.txt", names)
    description = {
        "schema_version": layout.SCHEMA_VERSION,
        "settings": vars(VIEW),
        "environment_map": {"name": "procedural room", "sha256": None},
    }
    layout.write_text(folder / "dataset.json", layout.json_text(description))
    return folder


@needs_solver
def test_a_ball_is_rendered_as_its_reference_and_a_line_is_an_empty_picture(dataset, tmp_path):
    found = data_sets.open_dataset(dataset)
    items = {name: cut(data_sets.read_object(found, name), 500) for name in ("ball", "line")}
    renderer = poisson.Renderer(found.settings, variant="scalar_rgb")
    method = poisson.keep_pictures(renderer, PoissonConfig(depth=6), tmp_path)
    shown = {name: method.show(item) for name, item in items.items()}
    error = shown["ball"].image - data_sets.on_white(items["ball"].images)
    assert -10 * np.log10(np.square(error).mean()) > 30
    assert (shown["line"].acc == 0).all()
    assert (shown["line"].image == 1).all()
    assert "500 points on one line" in poisson.reconstruct(items["line"].cloud, PoissonConfig(depth=6))
    assert min(poisson.seconds_per_view(tmp_path, items)) > 0
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    method.show(items["ball"])  # nothing is left to do
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    half = renderer.draw(
        poisson.reconstruct(items["ball"].cloud, PoissonConfig(depth=6)), cut(items["ball"], None, 1, 16)
    )
    assert half.shape == (1, 16, 16, 4)
    np.testing.assert_allclose(half[..., 3].mean() / 255, shown["ball"].acc[0].mean(), atol=0.02)


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
