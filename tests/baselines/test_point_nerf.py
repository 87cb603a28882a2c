"""Point-NeRF: the picture of plain loops, exact neighbours, and nothing at all where no point is in reach."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_model
from support.laws import close
from support.tiny_baselines import POINT_NERF
from support.tiny_model import NUM_POINTS, camera, cloud, wobbled
from support.tiny_training import BATCH, L1_ONLY, create, step

from experiments.baselines import point_nerf
from experiments.baselines.point_nerf import PointNeRF, PointNeRFConfig, published
from spnr_jax.config import LossConfig
from spnr_jax.kernels import cameras
from spnr_jax.method import inference, pixels
from spnr_jax.training import optimisation

pytestmark = pytest.mark.ci  # it trains a baseline

CONFIG = POINT_NERF
MODULE = PointNeRF(CONFIG)
TRAINING = dataclasses.replace(
    L1_ONLY,
    model=dataclasses.replace(CONFIG, image_resolution=tiny_model.SIZE),
    loss=LossConfig(l1_weight=1.0, adversarial_weight=0.0, pixel="mse", masked=True),
    pixel_stride=3,
)


@pytest.fixture(scope="module")
def variables():
    return wobbled(jax.jit(MODULE.init)(jax.random.key(0), cloud(), camera()), 4)


@jax.jit
def whole(variables, cloud, camera):
    return MODULE.apply(variables, cloud, camera)


def chunked(variables, cloud, camera, ray_chunk):
    config = dataclasses.replace(CONFIG, ray_chunk=ray_chunk)
    return inference.jitted_render(variables, cloud, camera, config=config)


def waves(x, frequencies):
    return [f(v * 2**k) for k in range(frequencies) for f in (np.sin, np.cos) for v in x]


def layers(params, name, x, last=None):
    count = sum(key.startswith(f"{name}_") and key.endswith("kernel") for key in params)
    for i in range(count):
        x = np.asarray(x) @ np.float64(params[f"{name}_{i}_kernel"]) + np.float64(params[f"{name}_{i}_bias"])
        x = x if i == count - 1 and last else np.where(x > 0, x, 0.01 * x)
    return x


def loop_shade(params, one, place, direction, axes):
    """Density and RGB at one place, by the book: every point's distance, the nearest of those in the ball."""
    near = [(np.linalg.norm(place - p), i) for i, p in enumerate(np.float64(one.positions)) if one.mask[i]]
    near = sorted((away, i) for away, i in near if away <= CONFIG.radius)[: CONFIG.num_neighbors]
    if not near:
        return 0.0, np.zeros(3)
    total, densities, features = 0.0, 0.0, 0.0
    for away, i in near:
        offset = place - np.float64(one.positions[i])
        materials = [*np.float64(one.base_color[i]), float(one.roughness[i]), float(one.metallic[i])]
        both = [*offset, *(axes.T @ offset)]
        inputs = [*materials, *waves(materials, CONFIG.feature_frequencies), *waves(both, CONFIG.offset_frequencies)]
        feature = layers(params, "colored", [*layers(params, "near", inputs), *materials[:3]])
        raw = layers(params, "density", feature, last=True)[0]
        share = 1 / max(away, 1e-6)
        total, densities = total + share, densities + share * 3 * np.log1p(np.exp(raw - 1))
        features = features + share * feature
    rgb = layers(params, "color", [*features / total, *waves(direction, CONFIG.direction_frequencies)], last=True)
    return densities / total, 1.002 / (1 + np.exp(-rgb)) - 0.001


def loop_render(params, one, view):
    """RGB, depth and opacity of every pixel, candidate by candidate."""
    rays = jax.tree.map(np.float64, cameras.camera_rays(view))
    axes = np.float64(view.cam_to_world[:, :3])
    voxel, count = CONFIG.radius / 4, CONFIG.num_candidates
    out = np.empty((view.height, view.width, 5))
    for place in np.ndindex(view.height, view.width):
        origin, direction = rays.origins[place], rays.directions[place]
        near, far, hit = cameras.intersect_box(*(jnp.asarray(x, jnp.float32) for x in (origin, direction)))
        kept = []
        for i in range(count):
            t = float(near) + (float(far) - float(near)) * (i + 0.5) / count
            away = np.linalg.norm(origin + t * direction - np.float64(one.positions), axis=-1)
            if hit and len(kept) < CONFIG.num_samples and (away[one.mask] <= CONFIG.radius).any():
                kept.append(t)
        light, color, depth = 1.0, np.zeros(3), 0.0
        for i, t in enumerate(kept):
            density, rgb = loop_shade(params, one, origin + t * direction, direction, axes)
            step = kept[i + 1] - t if i + 1 < len(kept) else voxel
            alpha = 1 - np.exp(-density * (voxel if step > 2 * voxel else step))
            color, depth, light = color + light * alpha * rgb, depth + light * alpha * t, light * (1 - alpha)
        out[place] = [*color + light, depth + light * float(far), 1 - light]
    return out


class TestPicture:
    def test_is_that_of_the_plain_loops(self, variables):
        mask = np.random.default_rng(1).random((2, NUM_POINTS)) < 0.8
        some = dataclasses.replace(cloud(), mask=jnp.asarray(mask))
        rendering = whole(variables, some, camera())
        for i, j in ((0, 0), (1, 1)):
            one = jax.tree.map(lambda x, i=i: np.asarray(x[i]), some)
            expected = loop_render(variables["params"], one, jax.tree.map(lambda x, i=i, j=j: x[i, j], camera()))
            seen = expected[..., 4]
            assert 0.2 < (seen > 0).mean() < 0.9
            assert seen.max() > 0.2
            close(rendering.image[i, j], expected[..., :3], rtol=1e-4, atol=2e-5)
            close(rendering.depth[i, j], expected[..., 3], rtol=1e-4, atol=2e-5)
            close(rendering.acc[i, j], seen, rtol=1e-4, atol=2e-5)

    def test_chunks_of_rays_and_of_shading_points_do_not_change_it(self, variables, monkeypatch):
        expected = whole(variables, cloud(), camera())
        for ray_chunk in (CONFIG.ray_chunk, 7):
            close(chunked(variables, cloud(), camera(), ray_chunk=ray_chunk), expected, rtol=1e-4, atol=1e-5)
        monkeypatch.setattr(point_nerf, "BLOCK", 37)
        small = jax.jit(lambda *inputs: MODULE.apply(*inputs))
        close(small(variables, cloud(), camera()), expected, rtol=1e-4, atol=1e-5)

    def test_without_a_point_in_reach_it_is_exactly_white_and_empty(self, variables):
        empty = dataclasses.replace(cloud(), mask=jnp.zeros((2, NUM_POINTS), bool))
        rendering = whole(variables, empty, camera())
        assert (rendering.image == 1).all()
        assert (rendering.acc == 0).all()
        away = whole(variables, cloud(), camera(target=5.0))
        missed = np.asarray(away.acc == 0)
        assert missed.any()
        assert (np.asarray(away.image)[missed] == 1).all()


class TestSteps:
    def test_shading_points_are_the_first_in_reach_and_own_the_way_to_the_next(self):
        distances = jnp.array([1.0, 2, 3, 4, 9, 10])
        points = point_nerf.shading_points(distances, jnp.array([False, True, True, False, True, True]), 3, 1.5)
        np.testing.assert_array_equal(points.distances, [2, 3, 9])
        np.testing.assert_array_equal(points.exists, [True] * 3)
        np.testing.assert_array_equal(points.delta, [1, 1.5, 1.5])  # one step, a gap, the last
        few = point_nerf.shading_points(distances, jnp.array([False, True, True, False, False, False]), 3, 1.5)
        np.testing.assert_array_equal(few.exists, [True, True, False])
        np.testing.assert_array_equal(few.delta[:2], [1, 1.5])


class TestTraining:
    def test_the_published_sizes_have_the_published_number_of_weights(self):
        state = jax.eval_shape(lambda: optimisation.create_state(published(128)))
        assert sum(x.size for x in jax.tree.leaves(state.generator)) == 292_356
        assert state.batch_stats == {}

    def test_rays_without_a_point_in_reach_are_left_out_of_the_loss(self):
        fresh = create(TRAINING)
        _, metrics = step(fresh, TRAINING, BATCH)
        key = jax.random.fold_in(fresh.key, 0)
        key, lattice_key = jax.random.split(key)
        seen = pixels.lattice(lattice_key, BATCH, 3)
        rendering = jax.jit(PointNeRF(TRAINING.model).apply)({"params": fresh.generator}, seen.cloud, seen.camera, key)
        hit = np.asarray(rendering.acc > 0)
        assert 0.05 < hit.mean() < 0.95
        error = (np.asarray(rendering.image) - np.asarray(seen.image)) ** 2
        assert float(metrics["loss"]) == pytest.approx(error[hit].mean(), rel=1e-4)


def test_a_wrong_size_names_the_field_and_what_is_possible():
    for field, value, hint in (
        ("radius", 0.0, "positive"),
        ("num_samples", 401, "num_candidates 400"),
        ("jitter", 1.5, "a share"),
    ):
        with pytest.raises(ValueError, match=rf"{field}.*{hint}"):
            PointNeRFConfig(**{field: value})
    with pytest.raises(ValueError, match="pixel_stride 4 needs"):
        dataclasses.replace(published(128), model=PointNeRFConfig(image_resolution=126))
