"""The shrunken network of the tests: weights, clouds and cameras of milliseconds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.config import EncoderConfig, PaperConfig, SamplingConfig
from spnr_jax.kernels.cameras import look_at, pinhole
from spnr_jax.kernels.records import PointCloud
from spnr_jax.method import inference
from support.laws import numbers

SIZE = 24  # the smallest image that the discriminator can judge
ENCODER = EncoderConfig(
    point_widths=(8,), point_features=4, volume_resolution=8, base_width=4, num_stages=1, num_groups=2
)
MODEL = PaperConfig(
    encoder=ENCODER,
    field_width=8,
    num_features=5,
    direction_frequencies=1,
    sampling=SamplingConfig(num_coarse=4, num_fine=4),
    render_resolution=8,
    resize_resolution=12,
    image_resolution=SIZE,
    upsampler_width=4,
)
WITHOUT_UPSAMPLER = dataclasses.replace(MODEL, image_resolution=8)
NUM_POINTS = 40


def cloud():
    """Points of two objects."""
    return PointCloud(
        positions=0.7 * numbers(0, 2, NUM_POINTS, 3),
        base_color=numbers(1, 2, NUM_POINTS, 3, low=0.0),
        roughness=numbers(2, 2, NUM_POINTS, low=0.0),
        metallic=numbers(3, 2, NUM_POINTS, low=0.0),
        mask=jnp.ones((2, NUM_POINTS), bool),
    )


def camera(size=8, target=0.0):
    """Two views of each of two objects."""
    eyes = jnp.asarray(np.float32([[[0, 1, 3], [3, 1, 0.5]], [[-2, 2, -2], [0.5, -1, 3]]]))
    pose = look_at(eyes, jnp.full(eyes.shape, target), jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), eyes.shape))
    return pinhole(pose, 0.9, size, size)


encode = jax.jit(inference.encode, static_argnames="config")
render = jax.jit(inference.render, static_argnames="config")


@functools.cache
def variables():
    """Weights of the network without its upsampler."""
    return wobbled(jax.jit(inference.network(WITHOUT_UPSAMPLER).init)(jax.random.key(0), cloud(), camera()), 4)


def wobbled(variables, seed):
    """Weights away from the zeros and ones that they start at."""
    return jax.tree.map(lambda x: x + 0.2 * numbers(seed, *x.shape), variables)
