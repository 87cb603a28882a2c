"""A view's own light comes from where its map says."""

import numpy as np
import trimesh
from support.command_line import spnr_data
from support.handmade import ball

from spnr_jax.formats import data_sets
from spnr_jax.surfels.lighting import directions

SMALL = ["--resolution", 32, "--points", 64, "--spp", 16, "--visibility-grid", 2]


def test_a_view_is_brighter_where_its_light_is(tmp_path):
    """A ball in a light of its own is brightest in the picture where the kept map says that it comes from."""
    (tmp_path / "meshes").mkdir()
    part = ball(radius=0.5)
    trimesh.Trimesh(part.positions, part.faces, process=False).export(tmp_path / "meshes" / "ball.ply")
    options = [*SMALL, "--views", 6, "--workers", 1, "--lights", "random", "--test-fraction", 0, "--val-fraction", 0]
    assert spnr_data("generate", tmp_path / "set", "--meshes", tmp_path / "meshes", *options) == 0
    assert spnr_data("check", tmp_path / "set") == 0
    dataset = data_sets.open_dataset(tmp_path / "set")
    assert dataset.settings["environment_map"]["kinds"] == [{"name": "random"}]
    item = data_sets.read_object(dataset, "ball")
    assert len({light.tobytes() for light in item.lights}) == len(item.lights) == 6
    area = np.sin(np.pi * (np.arange(32) + 0.5) / 32)[:, None, None]
    np.testing.assert_allclose((item.lights * area).mean(axis=(1, 2, 3)) / area.mean(), 0.6, rtol=0.02)
    assert item.own_lights[0].tables.shape == (7, 32, 64, 3)
    agreeing = []
    for view, light in enumerate(item.lights):
        weight = np.sin(np.pi * (np.arange(32) + 0.5) / 32)[:, None] * light.mean(axis=-1)
        across = (weight[..., None] * directions(32)).sum(axis=(0, 1)) @ item.camera.cam_to_world[view][:, :3]
        image, inside = item.images[view, ..., :3].mean(axis=-1), item.images[view, ..., 3] > 250
        grid = np.stack(np.meshgrid(np.arange(32) - 15.5, 15.5 - np.arange(32)), axis=-1)
        gradient = np.linalg.lstsq(grid[inside], image[inside] - image[inside].mean(), rcond=None)[0]
        agreeing.append(gradient @ across[:2] > 0)
    assert np.mean(agreeing) > 0.8
