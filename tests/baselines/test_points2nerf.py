"""Laws of Points2NeRF: a hypernetwork's weights are those that the loop writes, and objects do not see each other."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_model, tiny_training
from support.laws import close, numbers

from experiments.baselines import points2nerf
from experiments.baselines.points2nerf import Hypernetwork, Points2NeRF, Points2NeRFConfig
from spnr_jax.config import OptimizerConfig
from spnr_jax.method import inference

pytestmark = pytest.mark.ci  # it trains a baseline

CONFIG = Points2NeRFConfig(
    kl_weight=0.01,
    materials=("base_color", "metallic"),
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
CLOUD, CAMERA = tiny_model.cloud(), tiny_model.camera()


@functools.cache
def variables_of(config):
    return jax.jit(Points2NeRF(config).init)(jax.random.key(0), CLOUD, CAMERA)


def scenes(config, cloud=CLOUD):
    return inference.jitted_encode(variables_of(config), cloud, config=config)


@functools.partial(jax.jit, static_argnums=0)
def rendered(config, scene, camera=CAMERA):
    return Points2NeRF(config).apply({}, scene, camera, method="render")


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
    params = variables_of(CONFIG)["params"]["hypernetwork"]
    code = np.float64(numbers(3, 2, 5))
    shapes = [(15, 8), (8, 8), (23, 8), (8, 8), (8, 4)]
    module = Hypernetwork(CONFIG, sum(i * o + o for i, o in shapes))
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
    weights = object_of(scenes(CONFIG), 0)
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


def test_chunks_of_rays_give_the_picture_of_all_rays_at_once():
    scene, small = scenes(CONFIG), dataclasses.replace(CONFIG, ray_chunk=30)
    chunked = inference.jitted_render(variables_of(CONFIG), scene, CAMERA, config=small)
    close(chunked, rendered(CONFIG, scene), atol=1e-5)


def test_the_kl_term_is_the_divergence_of_the_code_that_is_drawn():
    mean, log_variance = jnp.array([[0.4, -0.8]]), jnp.array([[-0.6, 0.3]])
    scale = jnp.exp(0.5 * log_variance)
    z = mean + scale * jax.random.normal(jax.random.key(4), (400_000, 2))
    log_ratio = -0.5 * ((z - mean) / scale) ** 2 - jnp.log(scale) + 0.5 * z**2
    expected = jnp.mean(jnp.sum(log_ratio, axis=-1))
    close(points2nerf.kl_divergence(mean, log_variance)[0], expected, rtol=0.01)


def test_a_step_adds_the_kl_term_to_the_pixel_error_and_moves_every_weight():
    config = dataclasses.replace(
        tiny_training.L1_ONLY,
        model=dataclasses.replace(CONFIG, image_resolution=tiny_training.SIZE),
        optimizer=OptimizerConfig(lr_generator=5e-3, warmup_steps=2, algorithm="radam", ema_decay=0.9),
        pixel_stride=4,
        loss=points2nerf.SQUARES,
    )
    before = tiny_training.create(config)
    after, metrics = tiny_training.step(before, config)
    assert metrics["kl"] > 0
    assert 0 < float(metrics["loss"] - metrics["kl"]) < 1
    for path, moved in jax.tree_util.tree_leaves_with_path(
        jax.tree.map(lambda a, b: bool(jnp.any(a != b)), before.generator, after.generator)
    ):
        assert moved, jax.tree_util.keystr(path)
