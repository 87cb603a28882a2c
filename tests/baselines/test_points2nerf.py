"""Laws of Points2NeRF: a hypernetwork's weights are those that the loop writes, and objects do not see each other."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_model, tiny_training
from support.laws import close, numbers

from spnr_jax.baselines import points2nerf
from spnr_jax.baselines.baseline_presets import points2nerf_abo
from spnr_jax.baselines.points2nerf import Hypernetwork, Points2NeRF
from spnr_jax.baselines.sizes import Points2NeRFConfig
from spnr_jax.config import OptimizerConfig
from spnr_jax.method import inference

pytestmark = pytest.mark.ci  # it trains a baseline

FAITHFUL = Points2NeRFConfig(
    kl_weight=0.01,
    point_widths=(8, 6),
    hidden_width=7,
    code_size=5,
    hypernetwork_widths=(6, 9),
    chunk_size=48,
    chunk_embedding=3,
    frequencies=2,
    nerf_width=8,
    nerf_depth=2,
    num_samples=4,
    image_resolution=8,
)
FIXED = dataclasses.replace(FAITHFUL, mode="fixed", initialization="scaled", materials=("base_color", "metallic"))
LOSS = points2nerf_abo().loss
BOTH = pytest.mark.parametrize("config", [FAITHFUL, FIXED], ids=["faithful", "fixed"])
CLOUD, CAMERA = tiny_model.cloud(), tiny_model.camera()


@functools.cache
def variables_of(config):
    return jax.jit(Points2NeRF(config).init)(jax.random.key(0), CLOUD, CAMERA)


def scenes(config, cloud=CLOUD):
    return inference.jitted_encode(variables_of(config), cloud, config=config)


@functools.partial(jax.jit, static_argnums=0)
def rendered(config, scene, camera=CAMERA):
    return Points2NeRF(config).apply({}, scene, camera, method="render")


@functools.partial(jax.jit, static_argnums=0)
def code_of(config, cloud=CLOUD):
    return Points2NeRF(config).apply(variables_of(config), cloud, method="code")


def object_of(tree, number):
    return jax.tree.map(lambda x: x[number : number + 1], tree)


def count(tree):
    return sum(x.size for x in jax.tree.leaves(tree))


def test_the_default_sizes_have_the_published_numbers_of_weights():
    config = Points2NeRFConfig()
    module, (cloud, camera) = Points2NeRF(config), inference.example_inputs(config)
    variables = jax.eval_shape(module.init, jax.random.key(0), cloud, camera)
    assert count(variables["params"]["encoder"]) == 4_901_184
    assert count(variables["params"]["hypernetwork"]) == 184_611_128
    assert variables["params"]["hypernetwork"]["chunks"].shape == (39, 8)
    scene = jax.eval_shape(lambda v: module.apply(v, cloud, method="encode"), variables)
    assert count(scene) == 625_668


def layer(params, x):
    return x @ np.float64(params["kernel"]) + np.float64(params["bias"])


def test_the_hypernetwork_writes_what_a_loop_over_chunks_and_layers_writes():
    params = variables_of(FAITHFUL)["params"]["hypernetwork"]
    code = np.float64(numbers(3, 2, 5))
    shapes = [(15, 8), (8, 8), (23, 8), (8, 8), (8, 4)]
    module = Hypernetwork(FAITHFUL, sum(i * o + o for i, o in shapes))
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


def test_the_layers_of_a_nerf_are_those_that_its_config_asks_for():
    assert points2nerf.nerf_layers(FAITHFUL.frequencies, 8, 2) == ((15, 8), (8, 8), (23, 8), (8, 8), (8, 4))


def test_a_nerf_is_its_layers_with_the_encoded_position_joining_halfway():
    weights = object_of(scenes(FIXED), 0)
    weights = jax.tree.map(lambda x: x[0] + 0.1, weights)
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


@BOTH
def test_objects_mapped_over_equal_a_loop_over_objects(config):
    scene = scenes(config)
    whole = rendered(config, scene)
    for number in range(2):
        alone = scenes(config, object_of(CLOUD, number))
        close(alone, object_of(scene, number))
        close(rendered(config, alone, object_of(CAMERA, number)), object_of(whole, number), atol=1e-5)


@BOTH
def test_the_order_of_points_and_what_is_masked_do_not_matter(config):
    code, order = code_of(config), np.random.default_rng(0).permutation(tiny_model.NUM_POINTS)
    close(code_of(config, jax.tree.map(lambda x: x[:, order], CLOUD)), code)
    masked = jax.tree.map(lambda x: jnp.concatenate([x, 100 * jnp.ones_like(x)], axis=1), CLOUD)
    masked = dataclasses.replace(masked, mask=jnp.concatenate([CLOUD.mask, ~CLOUD.mask], axis=1))
    close(code_of(config, masked), code)


def test_the_kl_terms_are_those_of_the_formulas():
    mean, log_scale = 2 * numbers(1, 4, 5), numbers(2, 4, 5)
    m, v = np.float64(mean), np.float64(log_scale)
    close(points2nerf.kl_divergence("fixed", mean, log_scale), 0.5 * (np.exp(v) + m**2 - 1 - v).sum(-1))
    close(
        points2nerf.kl_divergence("faithful", mean, log_scale),
        0.5 * (np.exp(np.exp(v)) + m**2 - 1 - np.exp(v)).sum(-1),
    )
    close(points2nerf.code_scale("fixed", log_scale), np.exp(v / 2))
    close(points2nerf.code_scale("faithful", log_scale), np.exp(v))


def test_the_fixed_kl_term_is_the_divergence_of_the_code_that_is_drawn():
    mean, log_scale = jnp.array([[0.4, -0.8]]), jnp.array([[-0.6, 0.3]])
    scale = points2nerf.code_scale("fixed", log_scale)
    z = mean + scale * jax.random.normal(jax.random.key(4), (400_000, 2))
    log_ratio = -0.5 * ((z - mean) / scale) ** 2 - jnp.log(scale) + 0.5 * z**2
    expected = jnp.mean(jnp.sum(log_ratio, axis=-1))
    close(points2nerf.kl_divergence("fixed", mean, log_scale)[0], expected, rtol=0.01)


def test_the_faithful_kl_term_falls_as_the_noise_goes_to_zero():
    zeros = jnp.zeros((6, 1))
    terms = points2nerf.kl_divergence("faithful", zeros, jnp.array([[0.0], [-1.0], [-2.0], [-4.0], [-8.0], [-16.0]]))
    assert (np.diff(terms) <= 0).all()
    assert terms[-1] < 1e-6 < terms[0]


def test_the_last_sample_of_a_faithful_ray_paints_the_background_and_fixed_rays_end_white():
    empty = jax.tree.map(jnp.zeros_like, scenes(FAITHFUL))
    # density softplus(-9) and the colour sigmoid(-2) everywhere
    head = empty[-1]._replace(bias=jnp.broadcast_to(jnp.array([-2.0, -2.0, -2.0, -9.0]), empty[-1].bias.shape))
    scene = (*empty[:-1], head)
    painted, white = rendered(FAITHFUL, scene), rendered(FIXED, scene)
    hit = np.asarray(white.acc > 0)
    assert hit.mean() > 0.3
    close(painted.acc[hit], np.ones(hit.sum()))
    close(painted.image[hit], np.full((hit.sum(), 3), 1 / (1 + np.exp(2.0))))
    close(white.image, np.ones(white.image.shape), atol=1e-3)


@BOTH
def test_gradients_are_finite_through_nerfs_that_are_empty_or_solid(config):
    scene = scenes(config)

    @jax.jit
    def gradient(scene):
        return jax.grad(lambda s: jnp.sum(rendered(config, s).image ** 2))(scene)

    for raw in (-1e4, -90.0, -20.0, 20.0, 1e4):
        shifted = (*scene[:-1], scene[-1]._replace(bias=scene[-1].bias.at[:, 3].set(raw)))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient(shifted)))


@BOTH
def test_rays_beside_the_box_are_white_whatever_the_weights(config):
    rendering = rendered(config, scenes(config), tiny_model.camera(target=50.0))
    np.testing.assert_array_equal(rendering.image, 1)
    np.testing.assert_array_equal(rendering.acc, 0)


@BOTH
def test_chunks_of_rays_give_the_picture_of_all_rays_at_once(config):
    scene = scenes(config)
    chunked = inference.jitted_render(
        variables_of(config), scene, CAMERA, config=dataclasses.replace(config, ray_chunk=30)
    )
    close(chunked, rendered(config, scene), atol=1e-5)


def test_training_without_a_key_is_refused():
    with pytest.raises(ValueError, match="give a key"):
        Points2NeRF(FIXED).apply(variables_of(FIXED), CLOUD, CAMERA, train=True)


def train_config(model):
    return dataclasses.replace(
        tiny_training.L1_ONLY,
        model=dataclasses.replace(model, image_resolution=tiny_training.SIZE),
        optimizer=OptimizerConfig(lr_generator=5e-3, warmup_steps=2, algorithm="radam", ema_decay=0.9),
        pixel_stride=4,
        loss=LOSS,
    )


@BOTH
def test_a_step_adds_the_kl_term_to_the_pixel_error_and_moves_every_weight(config):
    config = train_config(config)
    before = tiny_training.create(config)
    after, metrics = tiny_training.step(before, config)
    assert all(np.isfinite(value) for value in metrics.values())
    squares = float(metrics["loss"] - metrics["kl"])
    assert metrics["kl"] > 0
    assert 0 < squares < 1
    for path, moved in jax.tree_util.tree_leaves_with_path(
        jax.tree.map(lambda a, b: bool(jnp.any(a != b)), before.generator, after.generator)
    ):
        assert moved, jax.tree_util.keystr(path)


def test_training_learns_two_coloured_balls():
    sizes = {"code_size": 16, "hypernetwork_widths": (32, 64), "chunk_size": 200, "nerf_width": 16, "num_samples": 8}
    config = train_config(dataclasses.replace(FIXED, kl_weight=1e-6, **sizes))
    config = dataclasses.replace(config, num_steps=400)
    state, first = tiny_training.step(tiny_training.create(config), config)
    _, last = tiny_training.run(state, 399, config)
    assert last["loss"] < 0.1 * first["loss"]
