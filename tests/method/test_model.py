"""The handle: any units, any number of points, one camera or many, and the same picture whatever the memory allows."""

import dataclasses

import jax
import numpy as np
import pytest
from support import tiny_dataset, tiny_model, tiny_untrained
from support.laws import close
from support.surfel_clouds import cloud

import spnr_jax
from spnr_jax.config import SamplingConfig
from spnr_jax.formats import data_sets
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import LARGEST_REACH, Volume
from spnr_jax.method import model, paper_method


@pytest.fixture(scope="module")
def handle():
    return spnr_jax.load(tiny_untrained.run())


def example_cloud(count=40, seed=0):
    rng = np.random.default_rng(seed)
    columns = {"base_color": rng.random((count, 3)), "roughness": rng.random(count), "metallic": rng.random(count)}
    return cloud(rng.uniform(-0.5, 0.5, (count, 3)), **columns)


@pytest.mark.parametrize(("factor", "shift"), [(8.0, (16, -4, 2)), (1e-30, (0, 0, 0)), (1e30, (0, 0, 0))])
def test_moving_and_scaling_the_cloud_changes_only_the_unit_of_depth(handle, factor, shift):
    cloud = example_cloud()
    moved = dataclasses.replace(cloud, positions=np.float32(factor * np.float64(cloud.positions) + shift))
    volumes = [handle.encode(points) for points in (cloud, moved)]
    one, other = (handle.render(volume, handle.camera(volume, 40.0, 25.0)) for volume in volumes)
    close((other.image, other.acc), (one.image, one.acc), rtol=0, atol=2e-4)
    close(other.depth / np.float32(factor), one.depth, rtol=2e-4)


def test_the_cameras_of_the_handle_look_at_the_middle_of_the_cloud(handle):
    cloud = example_cloud()
    volume = handle.encode(dataclasses.replace(cloud, positions=cloud.positions * 5 + 30))
    for azimuth, elevation in ((0.0, 0.0), (130.0, 50.0), (10.0, 90.0), (10.0, -90.0)):
        camera = handle.camera(volume, azimuth, elevation, resolution=32)
        pixels, _ = cameras.project(camera, volume.centre[None])
        close(pixels[0], np.float32([16, 16]), atol=1e-3)


def test_an_axis_of_views_holds_what_each_camera_sees_alone(handle):
    volume = handle.encode(example_cloud())
    single = [handle.camera(volume, azimuth, 20.0) for azimuth in (0.0, 100.0)]
    together = handle.render(volume, jax.tree.map(lambda *x: jax.numpy.stack(x), *single))
    for i, camera in enumerate(single):
        close(jax.tree.map(lambda x, i=i: x[i], together), handle.render(volume, camera), atol=1e-5)
    poses = np.stack([camera.cam_to_world for camera in single])
    shared = handle.render(volume, single[0].replace(cam_to_world=poses))  # one lens for all views
    jax.tree.map(np.testing.assert_array_equal, shared, together)


def test_the_handle_shows_what_the_evaluation_shows(handle):
    item = data_sets.read_object(tiny_dataset.dataset(), "ball_000004")
    expected = model.render_views(handle.params, tiny_dataset.CONFIG.model, item.cloud, item.camera)
    encoded = tiny_model.encode(
        handle.params, jax.tree.map(lambda x: jax.numpy.asarray(x)[None], item.cloud), config=handle.config
    )
    scene = jax.tree.map(lambda x: x[0], encoded)
    volume = Volume(scene=scene, centre=jax.numpy.zeros(3), scale=jax.numpy.ones(()))
    views = jax.tree.map(jax.numpy.asarray, item.camera)
    close(handle.render(volume, views, "trained"), expected, atol=1e-5)


def test_points_that_are_masked_do_not_count(handle):
    cloud = example_cloud(40)
    longer = jax.tree.map(lambda x: np.concatenate([x, x[:5]]), cloud)
    longer.mask[40:] = False
    longer.positions[40:] = 1e6
    close(handle.encode(longer), handle.encode(cloud))


def test_an_odd_picture_is_refused_where_the_network_doubles(handle):
    volume = handle.encode(example_cloud())
    with pytest.raises(ValueError, match="25 x 25 pixels must be even"):
        handle.render(volume, handle.camera(volume, resolution=25))


def test_a_run_without_a_checkpoint_says_how_to_get_one(tmp_path):
    (tmp_path / "config.json").write_text((tiny_untrained.run() / "config.json").read_text())
    with pytest.raises(ValueError, match="no checkpoint yet.*spnr train"):
        spnr_jax.load(tmp_path)


class TestQuality:
    @pytest.mark.parametrize(("quality", "samples"), [("draft", 2), ("balanced", 4), ("best", 8), ("trained", None)])
    def test_a_quality_is_a_share_of_the_samples_near_the_points_or_what_the_training_took(self, quality, samples):
        config = dataclasses.replace(tiny_dataset.CONFIG.model, sampling=SamplingConfig(num_coarse=4, num_fine=4))
        expected = SamplingConfig(num_coarse=samples, num_fine=0, reach=3) if samples else config.sampling
        assert paper_method.choose_samples(config, quality, 3) == dataclasses.replace(config, sampling=expected)

    def test_reach_follows_the_distance_between_the_points(self):
        grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 3), axis=-1).reshape(-1, 3)  # a quarter apart
        assert [paper_method.estimate_reach(grid, resolution) for resolution in (4, 8, 16, 64)] == [1, 2, 4, 4]
        assert paper_method.estimate_reach(grid[:1], 32) == LARGEST_REACH
