"""The published baselines: pictures of plain loops, published sizes, training steps that move every weight."""

import dataclasses
import functools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_model
from support.laws import close, numbers, same_bits
from support.tiny_baselines import HYPER, POINT_NERF, RASTERS
from support.tiny_model import NUM_POINTS, camera, cloud, wobbled
from support.tiny_training import BATCH, L1_ONLY, create, step

from experiments.baselines import npbg, point_nerf, points2nerf, ray_chunks
from experiments.baselines.npbg import NPBG, GatedConv, NPBGConfig, half, raster, visible_points
from experiments.baselines.point_nerf import PointNeRF, PointNeRFConfig
from experiments.baselines.points2nerf import Hypernetwork, Points2NeRF
from spnr_jax.config import LossConfig, OptimizerConfig
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera
from spnr_jax.method import inference
from spnr_jax.methods import from_dict, to_dict
from spnr_jax.training import optimisation

pytestmark = pytest.mark.ci  # it trains baselines

RADAM = OptimizerConfig(lr_generator=5e-3, warmup_steps=2, algorithm="radam", ema_decay=0.9)


def trained(config, stride=None, **changes):
    sizes = {"image_resolution": tiny_model.SIZE} | ({"pixel_stride": stride} if stride else {})
    return dataclasses.replace(L1_ONLY, model=dataclasses.replace(config, **sizes), **changes)


TRAININGS = {
    "npbg": trained(RASTERS),
    "point_nerf": trained(POINT_NERF, stride=3, loss=ray_chunks.SQUARES),
    "points2nerf": trained(HYPER, stride=4, loss=ray_chunks.SQUARES, optimizer=RADAM),
}


def test_views_become_one_axis_of_rays_and_images_again():
    views = camera()
    rays, flat = cameras.camera_rays(views), cameras.view_rays(views)
    images = ray_chunks.as_images(views, flat.directions, flat.origins[..., 0], flat.origins[..., 1])
    same_bits(images.image, rays.directions)
    same_bits((images.depth, images.acc), (rays.origins[..., 0], rays.origins[..., 1]))


@pytest.mark.parametrize("stride", [4, 3])
def test_a_lattice_of_a_batch_is_that_of_picture_opacity_condition_and_rays(stride):
    """Another key gives another place."""

    @jax.jit
    def made(key):
        some = ray_chunks.lattice(key, BATCH, stride)
        return some, cameras.camera_rays(some.camera).directions

    places, whole = set(), np.asarray(jax.jit(cameras.camera_rays)(BATCH.camera).directions)
    for seed in range(4):
        some, rays = made(jax.random.key(seed))
        distance = np.abs(whole[0, 0] - np.asarray(rays[0, 0, 0, 0])).sum(-1)
        row, column = np.unravel_index(distance.argmin(), distance.shape)
        places.add((row, column))
        kept = np.s_[:, :, row::stride, column::stride]
        close(rays, whole[kept], atol=1e-6)
        for name in ("image", "alpha", "condition", "condition_mask"):
            np.testing.assert_array_equal(getattr(some, name), np.asarray(getattr(BATCH, name))[kept])
        same_bits(some.cloud, BATCH.cloud)
    assert len(places) > 1


def count(tree):
    return sum(x.size for x in jax.tree.leaves(tree))


@pytest.mark.parametrize(
    ("config", "part", "expected"),
    [
        (npbg.published_config(128), "network", 465_769),
        (npbg.published_config(128), "background", 5),
        (point_nerf.published_config(128), None, 292_356),
        (points2nerf.published_config(128), "encoder", 4_901_184),
        (points2nerf.published_config(128), "hypernetwork", 184_611_128),
    ],
)
def test_the_published_sizes_have_the_published_number_of_weights(config, part, expected):
    state = jax.eval_shape(lambda: optimisation.create_state(config))
    assert count(state.generator[part] if part else state.generator) == expected
    assert state.batch_stats == {}


@pytest.mark.parametrize("name", TRAININGS)
def test_the_training_step_moves_every_weight(name):
    fresh = create(TRAININGS[name])
    after, metrics = step(fresh, TRAININGS[name], BATCH)
    for path, moved in jax.tree_util.tree_leaves_with_path(
        jax.tree.map(lambda old, new: bool(jnp.any(old != new)), fresh.generator, after.generator)
    ):
        assert moved or name == "point_nerf", jax.tree_util.keystr(path)
    if name == "points2nerf":  # the KL term is added to the error of the pixels
        assert metrics["kl"] > 0
        assert 0 < float(metrics["loss"] - metrics["kl"]) < 1
    if name == "point_nerf":  # rays without a point in reach are left out of the loss
        key, lattice_key = jax.random.split(jax.random.fold_in(fresh.key, 0))
        seen = ray_chunks.lattice(lattice_key, BATCH, 3)
        variables = {"params": fresh.generator}
        rendering = jax.jit(PointNeRF(TRAININGS[name].model).apply)(variables, seen.cloud, seen.camera, key)
        hit = np.asarray(rendering.acc > 0)
        assert 0.05 < hit.mean() < 0.95
        error = (np.asarray(rendering.image) - np.asarray(seen.image)) ** 2
        assert float(metrics["loss"]) == pytest.approx(error[hit].mean(), rel=1e-4)


def test_the_loss_of_some_pixels_is_that_of_the_lattice():
    config = TRAININGS["points2nerf"]
    variables = {"params": create(config).generator}
    rest, lattice_key = jax.random.split(jax.random.key(5))
    thinned = ray_chunks.lattice(lattice_key, BATCH, config.model.pixel_stride)
    found, _ = jax.jit(partial(points2nerf.loss, config=config))(variables, BATCH, jax.random.key(5))
    expected, _ = jax.jit(partial(inference.loss, config=config))(variables, thinned, rest)
    assert float(found) == pytest.approx(float(expected), rel=1e-5)


def test_rays_that_meet_no_point_have_a_loss_of_0_and_finite_gradients():
    config = TRAININGS["point_nerf"]
    params, away = create(config).generator, jax.tree.map(jnp.asarray, BATCH)
    away = away.replace(cloud=away.cloud.replace(mask=jnp.zeros_like(away.cloud.mask)))
    of = jax.jit(jax.value_and_grad(lambda params: point_nerf.loss({"params": params}, away, config=config)[0]))
    value, gradients = of(params)
    assert value == 0
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(gradients))


@pytest.mark.parametrize("weight", ["l1_weight", "mse_weight", "opacity_weight"])
def test_the_loss_of_point_nerf_is_weighted_as_the_config_says(weight):
    config = TRAININGS["point_nerf"]
    variables = {"params": create(config).generator}

    def value(**weights):
        none = dict.fromkeys(("l1_weight", "mse_weight", "opacity_weight"), 0.0)
        loss = dataclasses.replace(config.loss, **none | weights)
        return float(point_nerf.loss(variables, BATCH, config=dataclasses.replace(config, loss=loss))[0])

    assert 0 < value(**{weight: 1.0}) == pytest.approx(value(**{weight: 2.0}) / 2)


def test_runs_of_before_the_stride_was_the_networks_are_read():
    for config in (point_nerf.point_nerf_tiny(), points2nerf.points2nerf_tiny()):
        values = to_dict(config)
        values["pixel_stride"] = values["model"].pop("pixel_stride")
        values["loss"]["masked"] = True
        assert from_dict(values) == config


def test_an_object_without_points_has_a_finite_code():
    encoder, points = points2nerf.Encoder(HYPER), jnp.zeros((2, 5, 6))
    mask = jnp.array([[True] * 5, [False] * 5])
    variables = encoder.init(jax.random.key(0), points, mask)
    gradients = jax.grad(lambda of: sum(map(jnp.sum, encoder.apply(of, points, mask))))(variables)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves((encoder.apply(variables, points, mask), gradients)))


@pytest.mark.parametrize(
    ("make", "hint"),
    [
        (lambda: NPBGConfig(encoder_widths=(16,)), "encoder_widths.*one entry more"),
        (lambda: NPBGConfig(encoder_widths=(16, 6, 48, 64, 80)), "encoder_widths.*6 channels of a raster"),
        (lambda: NPBGConfig(image_resolution=31), "image_resolution.*at least 32"),
        (lambda: PointNeRFConfig(radius=0.0), "radius.*above 0"),
        (lambda: PointNeRFConfig(num_samples=401), "num_samples.*num_candidates 400"),
        (lambda: PointNeRFConfig(jitter=1.5), "jitter.*a share"),
        (lambda: dataclasses.replace(npbg.npbg_tiny(), loss=LossConfig()), r"adversarial_weight 1\.0.*use 0"),
        (lambda: PointNeRFConfig(pixel_stride=7), "pixel_stride 7 does not divide"),
    ],
)
def test_what_the_network_cannot_have_names_the_field_and_what_is_possible(make, hint):
    with pytest.raises(ValueError, match=hint):
        make()


# --- NPBG -------------------------------------------------------------------------------------------------------------

visible = jax.jit(visible_points, static_argnums=3)


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


@pytest.mark.parametrize("near", [0.01, 1.0])
def test_every_pixel_shows_the_point_of_the_plain_loop(near):
    positions = numbers(5, 200, 3)
    positions = positions.at[150:].set(positions[:50])  # of equally deep points the first shows
    mask = np.random.default_rng(6).random(200) < 0.8
    expected, _ = loop_raster(positions, mask, odd_camera(), near)
    assert 0.2 < (expected >= 0).mean() < 1
    np.testing.assert_array_equal(visible(positions, jnp.asarray(mask), odd_camera(), near), expected)


def test_a_point_on_the_border_of_two_pixels_belongs_to_the_one_before():
    pose = jnp.eye(3, 4).at[2, 3].set(2.0)
    view = Camera(cam_to_world=pose, intrinsics=jnp.diag(jnp.array([2.0, 2, 1])).at[:2, 2].set(2), height=4, width=4)
    for x, column in ((0.0, 1), (1.0, 2), (1.001, 3), (0.999, 2), (-0.999, 1), (-1.0, 0), (2.0, 3)):
        index = visible(jnp.array([[x, -0.5, 0.0]]), jnp.ones(1, bool), view, 0.01)
        assert index[2, column] == 0, x
        assert (index >= 0).sum() == 1
    for x in (-2.0, 2.001):
        assert (visible(jnp.array([[x, -0.5, 0.0]]), jnp.ones(1, bool), view, 0.01) < 0).all(), x


def test_a_rendering_carries_materials_distance_and_opacity_of_the_points_or_the_background():
    view, one = jax.tree.map(lambda x: x[1, 0], camera(16)), jax.tree.map(lambda x: x[1], cloud())
    background = jnp.array([0.1, 0.2, 0.3, 0.4, 0.5])
    values, distance = jax.jit(raster, static_argnums=3)(one, view, background, 0.01)
    index, _ = loop_raster(one.positions, one.mask, view, 0.01)
    materials = np.concatenate([one.base_color, one.roughness[:, None], one.metallic[:, None]], axis=-1)
    away = np.linalg.norm(np.asarray(one.positions) - np.asarray(view.cam_to_world[:, 3]), axis=-1)
    seen = index >= 0
    close(values, np.concatenate([np.where(seen[..., None], materials[index], background), seen[..., None]], axis=-1))
    close(distance[seen], away[index[seen]])
    assert np.isinf(distance[~seen]).all()
    module = NPBG(RASTERS)
    variables = jax.jit(module.init)(jax.random.key(0), cloud(), camera(16))
    rendering = jax.jit(module.apply)(variables, cloud(), camera(16))
    rays = cameras.camera_rays(view)
    _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
    np.testing.assert_array_equal(rendering.acc[1, 0], seen)
    close(rendering.depth[1, 0], np.where(seen, away[index], far))


def test_a_gated_convolution_is_elu_times_sigmoid_over_reflected_borders():
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


def test_halving_averages_squares_and_an_odd_side_is_resized_first():
    x = numbers(2, 1, 4, 6, 1)
    close(half(x)[0, 1, 2, 0], np.mean(x[0, 2:4, 4:6, 0]))
    ramp = jnp.arange(5.0).reshape(1, 5, 1, 1) * jnp.ones((1, 1, 4, 1))
    # five rows resized to four: row i lies at 1.25 i + 0.125
    close(half(ramp)[0, :, 0, 0], np.float32([0.125 + 0.625, 2.625 + 0.625]))


# --- Point-NeRF -------------------------------------------------------------------------------------------------------

CONFIG = POINT_NERF


@pytest.fixture(scope="module")
def variables():
    return wobbled(jax.jit(PointNeRF(CONFIG).init)(jax.random.key(0), cloud(), camera()), 4)


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


def test_the_picture_is_that_of_the_plain_loops(variables, monkeypatch):
    monkeypatch.setattr(point_nerf, "BLOCK", 37)  # a chunk has 20 rays: neither divides what there is
    mask = np.random.default_rng(1).random((2, NUM_POINTS)) < 0.8
    some = dataclasses.replace(cloud(), mask=jnp.asarray(mask))
    rendering = tiny_model.render(variables, some, camera(), config=CONFIG)
    for i, j in ((0, 0), (1, 1)):
        one = jax.tree.map(lambda x, i=i: np.asarray(x[i]), some)
        expected = loop_render(variables["params"], one, jax.tree.map(lambda x, i=i, j=j: x[i, j], camera()))
        seen = expected[..., 4]
        assert 0.2 < (seen > 0).mean() < 0.9
        assert seen.max() > 0.2
        close(rendering.image[i, j], expected[..., :3], rtol=1e-4, atol=2e-5)
        close(rendering.depth[i, j], expected[..., 3], rtol=1e-4, atol=2e-5)
        close(rendering.acc[i, j], seen, rtol=1e-4, atol=2e-5)
        assert (np.asarray(rendering.image[i, j])[seen == 0] == 1).all(), "without a point in reach exactly white"


# --- Points2NeRF ------------------------------------------------------------------------------------------------------

CLOUD, CAMERA = tiny_model.cloud(), tiny_model.camera()


@functools.cache
def hyper_variables():
    return jax.jit(Points2NeRF(HYPER).init)(jax.random.key(0), CLOUD, CAMERA)


def hyper_scenes():
    return tiny_model.encode(hyper_variables(), CLOUD, config=HYPER)


def layer(params, x):
    return x @ np.float64(params["kernel"]) + np.float64(params["bias"])


def test_the_hypernetwork_writes_what_a_loop_over_chunks_and_layers_writes():
    params = hyper_variables()["params"]["hypernetwork"]
    code = np.float64(numbers(3, 2, 5))
    shapes = [(15, 8), (8, 8), (23, 8), (8, 8), (8, 4)]
    module = Hypernetwork(HYPER, sum(i * o + o for i, o in shapes))
    flat = jax.jit(module.apply)({"params": params}, jnp.asarray(code, jnp.float32))
    for number, row in enumerate(code):
        emitted = []
        for embedding in np.float64(params["chunks"]):
            x = np.concatenate([row, embedding])
            x = np.maximum(layer(params["hidden_0"], x), 0)
            x = np.maximum(layer(params["hidden_1"], x), 0)
            emitted += list(layer(params["out"], x))
        assert len(emitted) > module.num_weights > len(emitted) - 48
        queue = iter(emitted)
        for actual, (inputs, outputs) in zip(points2nerf.split_weights(flat[number], shapes), shapes, strict=True):
            close(actual.kernel, np.array([[next(queue) for _ in range(outputs)] for _ in range(inputs)]))
            close(actual.bias, np.array([next(queue) for _ in range(outputs)]))


def test_a_nerf_is_its_layers_with_the_encoded_position_joining_halfway():
    weights = jax.tree.map(lambda x: x[0] + 0.1, hyper_scenes())
    positions = numbers(5, 3, 2, 3)
    density, rgb = jax.jit(points2nerf.nerf)(weights, positions)
    for place in np.ndindex(3, 2):
        p = np.float64(positions[place])
        encoded = np.concatenate([p, np.sin(p), np.cos(p), np.sin(2 * p), np.cos(2 * p)])
        x = encoded
        for number, (kernel, bias) in enumerate(weights[:-1]):
            x = np.concatenate([x, encoded]) if number == 2 else x
            x = np.maximum(x @ np.float64(kernel) + np.float64(bias), 0)
        raw = x @ np.float64(weights[-1].kernel) + np.float64(weights[-1].bias)
        close(density[place], np.log1p(np.exp(raw[3])))
        close(rgb[place], 1 / (1 + np.exp(-raw[:3])))


def test_the_kl_term_is_the_divergence_of_the_code_that_is_drawn():
    mean, log_variance = jnp.array([[0.4, -0.8]]), jnp.array([[-0.6, 0.3]])
    scale = jnp.exp(0.5 * log_variance)
    z = mean + scale * jax.random.normal(jax.random.key(4), (400_000, 2))
    log_ratio = -0.5 * ((z - mean) / scale) ** 2 - jnp.log(scale) + 0.5 * z**2
    expected = jnp.mean(jnp.sum(log_ratio, axis=-1))
    close(points2nerf.kl_divergence(mean, log_variance)[0], expected, rtol=0.01)
