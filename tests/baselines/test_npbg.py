"""NPBG: the raster of a plain loop, the published network's size, a picture that does not know the points' order."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_model
from support.laws import close, numbers
from support.tiny_model import NUM_POINTS, camera, cloud, wobbled
from support.tiny_training import BATCH, L1_ONLY, create, step

from experiments.baselines.npbg import NPBG, GatedConv, NPBGConfig, half, npbg_tiny, published, raster, visible_points
from spnr_jax.config import LossConfig
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera
from spnr_jax.training import optimisation

pytestmark = pytest.mark.ci  # it trains a baseline

CONFIG = NPBGConfig(encoder_widths=(8, 9, 10), decoder_widths=(5, 4), image_resolution=16)
SIZE = CONFIG.image_resolution
BACKGROUND = jnp.array([0.1, 0.2, 0.3, 0.4, 0.5])


@pytest.fixture(scope="module")
def variables():
    return wobbled(jax.jit(NPBG(CONFIG).init)(jax.random.key(0), cloud(), camera(SIZE)), 4)


visible = jax.jit(visible_points, static_argnums=3)
drawn = jax.jit(raster, static_argnums=3)


@jax.jit
def render(variables, cloud, camera):
    return NPBG(CONFIG).apply(variables, cloud, camera)


def odd_camera():
    """Not square, focal lengths that differ, so near that some points lie behind it and beside the picture."""
    pose = cameras.look_at(jnp.array([0.3, 0.4, 0.6]), jnp.array([0.1, 0, 0]), jnp.array([0.0, 1, 0]))
    intrinsics = jnp.array([[9.0, 0, 4.2], [0, 11, 3.1]] + [[0, 0, 1.0]])
    return Camera(cam_to_world=pose, intrinsics=intrinsics, height=7, width=9)


def loop_raster(positions, mask, view, near):
    """Point by point in float64: (index, camera depth) of what each pixel shows."""
    pose, k = np.asarray(view.cam_to_world, np.float64), np.asarray(view.intrinsics, np.float64)
    index = np.full((view.height, view.width), -1)
    depths = np.full((view.height, view.width), np.inf)
    for i, position in enumerate(np.asarray(positions, np.float64)):
        x, y, z = pose[:, :3].T @ (position - pose[:, 3])
        if not mask[i] or -z <= near:
            continue
        u, v = k[0, 0] * x / -z + k[0, 2], k[1, 1] * -y / -z + k[1, 2]
        column, row = int(np.ceil(u)) - 1, int(np.ceil(v)) - 1
        if 0 <= column < view.width and 0 <= row < view.height and -z < depths[row, column]:
            index[row, column], depths[row, column] = i, -z
    return index, depths


class TestRaster:
    @pytest.mark.parametrize("near", [0.01, 1.0])
    def test_every_pixel_shows_the_point_of_the_plain_loop(self, near):
        positions = numbers(5, 200, 3)
        mask = np.random.default_rng(6).random(200) < 0.8
        expected, _ = loop_raster(positions, mask, odd_camera(), near)
        assert 0.2 < (expected >= 0).mean() < 1
        np.testing.assert_array_equal(visible(positions, jnp.asarray(mask), odd_camera(), near), expected)

    def test_a_point_on_the_border_of_two_pixels_belongs_to_the_one_before(self):
        pose = jnp.eye(3, 4).at[2, 3].set(2.0)
        view = Camera(
            cam_to_world=pose, intrinsics=jnp.diag(jnp.array([2.0, 2, 1])).at[:2, 2].set(2), height=4, width=4
        )
        for x, column in ((0.0, 1), (1.0, 2), (1.001, 3), (0.999, 2), (-0.999, 1), (-1.0, 0), (2.0, 3)):
            index = visible(jnp.array([[x, -0.5, 0.0]]), jnp.ones(1, bool), view, 0.01)
            assert index[2, column] == 0, x
            assert (index >= 0).sum() == 1
        for x in (-2.0, 2.001):
            assert (visible(jnp.array([[x, -0.5, 0.0]]), jnp.ones(1, bool), view, 0.01) < 0).all(), x

    def test_of_equally_deep_points_the_first_shows(self):
        view = jax.tree.map(lambda x: x[0, 0], camera())
        behind, front = jnp.zeros(3), 0.3 * view.cam_to_world[:, 2]
        positions = jnp.stack([behind, front, front, behind])
        index = visible(positions, jnp.ones(4, bool), view, 0.01)
        assert set(np.unique(index)) == {-1, 1}

    def test_pixels_carry_materials_mask_and_distance_or_the_background(self):
        one, view = (
            jax.tree.map(lambda x: x[1], tree) for tree in (cloud(), jax.tree.map(lambda x: x[:, 0], camera()))
        )
        values, distance = drawn(one, view, BACKGROUND, 0.01)
        index, _ = loop_raster(one.positions, one.mask, view, 0.01)
        for place in np.ndindex(index.shape):
            i = index[place]
            if i < 0:
                expected, away = [*BACKGROUND, 0], np.inf
            else:
                expected = [*one.base_color[i], one.roughness[i], one.metallic[i], 1]
                away = np.linalg.norm(np.asarray(one.positions[i]) - np.asarray(view.cam_to_world[:, 3]))
            close(values[place], np.float32(expected))
            assert float(distance[place]) == pytest.approx(away, rel=1e-5)


class TestNetwork:
    def test_the_published_sizes_have_the_published_number_of_weights(self):
        state = jax.eval_shape(lambda: optimisation.create_state(published(128)))
        network = sum(x.size for x in jax.tree.leaves(state.generator["network"]))
        assert network == 465_769
        assert state.generator["background"].shape == (5,)
        assert state.batch_stats == {}

    def test_a_gated_convolution_is_elu_times_sigmoid_over_reflected_borders(self):
        x, module = numbers(1, 1, 4, 5, 2), GatedConv(3)
        weights = module.init(jax.random.key(1), x)
        kernel, bias = (np.float64(weights["params"][name]) for name in ("kernel", "bias"))
        assert np.abs(kernel).max() <= 18**-0.5 < 1.2 * np.abs(kernel).max()
        padded = np.pad(np.float64(x[0]), ((1, 1), (1, 1), (0, 0)), mode="reflect")
        out = np.empty((4, 5, 3))
        for row, column in np.ndindex(4, 5):
            both = np.tensordot(padded[row : row + 3, column : column + 3], kernel, 3) + bias
            feature, gate = both[:3], both[3:]
            out[row, column] = np.where(feature > 0, feature, np.expm1(feature)) / (1 + np.exp(-gate))
        close(module.apply(weights, x)[0], out)

    def test_halving_averages_squares_and_an_odd_side_is_resized_first(self):
        x = numbers(2, 1, 4, 6, 1)
        close(half(x)[0, 1, 2, 0], np.mean(x[0, 2:4, 4:6, 0]))
        ramp = jnp.arange(5.0).reshape(1, 5, 1, 1) * jnp.ones((1, 1, 4, 1))
        # five rows resized to four: row i lies at 1.25 i + 0.125
        close(half(ramp)[0, :, 0, 0], np.float32([0.125 + 0.625, 2.625 + 0.625]))


class TestPicture:
    def test_opacity_and_depth_are_those_of_the_finest_raster(self, variables):
        rendering = render(variables, cloud(), camera(SIZE))
        view = jax.tree.map(lambda x: x[1, 0], camera(SIZE))
        index, _ = loop_raster(cloud().positions[1], np.ones(NUM_POINTS, bool), view, 0.01)
        np.testing.assert_array_equal(rendering.acc[1, 0], index >= 0)
        away = np.linalg.norm(np.asarray(cloud().positions[1]) - np.asarray(view.cam_to_world[:, 3]), axis=-1)
        close(rendering.depth[1, 0][index >= 0], away[index[index >= 0]])
        rays = cameras.camera_rays(view)
        _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        close(rendering.depth[1, 0][index < 0], far[index < 0])


def test_a_wrong_size_names_the_field_and_what_is_possible():
    for field, value, hint in (
        ("encoder_widths", (16,), "one entry more"),
        ("encoder_widths", (16, 6, 48, 64, 80), "6 channels of a raster"),
        ("image_resolution", 31, "at least 32"),
    ):
        with pytest.raises(ValueError, match=rf"{field}.*{hint}"):
            NPBGConfig(**{field: value})
    with pytest.raises(ValueError, match=r"adversarial_weight 1\.0.*use 0"):
        dataclasses.replace(npbg_tiny(), loss=LossConfig())
    with pytest.raises(ValueError, match="pixel_stride 4 needs"):
        dataclasses.replace(npbg_tiny(), pixel_stride=4)


def test_the_training_step_moves_every_weight():
    config = dataclasses.replace(L1_ONLY, model=dataclasses.replace(CONFIG, image_resolution=tiny_model.SIZE))
    fresh = create(config)
    after, metrics = step(fresh, config, BATCH)
    assert set(metrics) == {"psnr", "l1", "loss", "gradient_norm"}
    moved = jax.tree.map(lambda old, new: bool(jnp.any(old != new)), fresh.generator, after.generator)
    assert all(jax.tree.leaves(moved))
