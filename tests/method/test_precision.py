"""Convolutions in bfloat16: an option that changes nothing else, and nothing at all while it is off."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import pytest
from support.laws import numbers
from support.tiny_model import MODEL, camera, cloud
from support.tiny_training import BATCH, CONFIG

from spnr_jax.kernels.records import Rays, Scene
from spnr_jax.method import inference
from spnr_jax.method.paper_method import render_rays
from spnr_jax.training import optimisation

pytestmark = pytest.mark.ci  # it trains several networks

BF16_MODEL = dataclasses.replace(MODEL, precision="bfloat16")
BF16 = dataclasses.replace(CONFIG, model=BF16_MODEL)
CONVOLUTION = re.compile(r":(\w+)\[[\d,]*\] = conv_general_dilated")
# sums over pictures, not over the taps of a convolution's gradient
STATISTIC = re.compile(r":(\w+)\[(?:[\d,]*\] = (?:sqrt|div)|\d*(?:,\d+)?\] = reduce_sum)")


@functools.cache
def traced(config) -> tuple[str, dict]:
    """A step of both networks and a picture from fresh weights, written out, and the formats of all results."""

    def everything():
        state = optimisation.create_state(config)
        picture = inference.network(config.model).apply(optimisation.averaged_variables(state), cloud(), camera(24))
        state, metrics = optimisation.train_step(state, BATCH, config=config, adversarial=True)
        return {"state": state, "metrics": metrics, "picture": picture}

    jaxpr, shapes = jax.make_jaxpr(everything, return_shape=True)()
    return str(jaxpr), jax.tree.map(lambda x: (x.shape, x.dtype), shapes)


def test_while_it_is_off_no_number_is_a_bfloat16():
    assert "bf16" not in traced(CONFIG)[0]


def test_every_convolution_and_its_gradients_run_in_bfloat16():
    assert set(CONVOLUTION.findall(traced(CONFIG)[0])) == {"f32"}
    assert set(CONVOLUTION.findall(traced(BF16)[0])) == {"bf16"}


def test_statistics_of_the_normalisations_stay_float32():
    assert "bf16" not in STATISTIC.findall(traced(BF16)[0])


def test_points_field_sampling_and_compositing_stay_float32():
    rays = Rays(origins=numbers(0, 2, 6, 3), directions=numbers(1, 2, 6, 3))
    scene = Scene(volume=jnp.zeros((2, 8, 8, 8, 4)), occupied=jnp.ones((2, 8, 8, 8), bool))
    variables = jax.eval_shape(lambda: inference.network(BF16_MODEL).init(jax.random.key(0), cloud(), camera(24)))

    def samples(variables, key):
        module = inference.network(BF16_MODEL).bind(variables)
        return render_rays(module, scene, rays, BF16_MODEL.sampling, None, key)

    def points(variables):
        module = inference.network(BF16_MODEL).bind(variables)
        return module.encoder.point_features(cloud())

    assert "bf16" not in str(jax.make_jaxpr(samples)(variables, jax.random.key(0)))
    assert "bf16" not in str(jax.make_jaxpr(points)(variables))
