"""How far a GPU may be from the CPU: it sums in another order, scatters in any order, and rounds
matrix products and convolutions to TF32 (10 bits) unless it is told not to.

Without a GPU every test here is skipped.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import numbers
from support.tiny_model import MODEL, camera, cloud, wobbled
from support.tiny_training import CONFIG

from spnr_jax.kernels import voxels
from spnr_jax.method import inference


def devices(platform: str) -> list:
    try:
        return jax.devices(platform)
    except RuntimeError:
        return []


pytestmark = pytest.mark.skipif(not devices("gpu"), reason="compares a GPU with the CPU, and JAX finds no GPU")
TOLERANCE = {"highest": 1e-4, "default": 2e-2}  # of the largest entry


def on(platform: str, function, *arguments):
    """NumPy outputs of a function compiled for and run on that platform."""
    device = devices(platform)[0]
    with jax.default_device(device):
        return jax.tree.map(np.asarray, jax.jit(function)(*jax.device_put(arguments, device)))


def agree(actual, expected, tolerance):
    """Each leaf differs by at most the tolerance times its largest entry."""
    for ours, theirs in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(theirs).max() + 1e-9)


def picture_and_gradient(variables):
    """Pictures of two objects, and the gradient of their sum of squares by the weights."""

    def rendering(params):
        return inference.network(MODEL).apply({**variables, "params": params}, cloud(), camera(24))

    gradient = jax.grad(lambda params: jnp.mean(rendering(params).image ** 2))(variables["params"])
    picture = rendering(variables["params"])
    return (picture.image, picture.depth, picture.acc), gradient


@pytest.mark.parametrize("precision", TOLERANCE)
def test_pictures_and_gradients_are_those_of_the_cpu(precision):
    variables = wobbled(inference.network(MODEL).init(jax.random.key(0), *inference.example_inputs(CONFIG.model)), 1)
    with jax.default_matmul_precision(precision):
        gpu = on("gpu", picture_and_gradient, variables)
    agree(gpu, on("cpu", picture_and_gradient, variables), TOLERANCE[precision])


def test_scatter_and_lookup_are_those_of_the_cpu_to_1e_5():
    positions, features = numbers(0, 1000, 3), numbers(1, 1000, 4)

    def there_and_back(positions, features):
        volume, _ = voxels.scatter_mean(positions, features, jnp.ones(1000, bool), 8)
        return volume, voxels.trilinear(volume, positions)

    agree(*(on(platform, there_and_back, positions, features) for platform in ("gpu", "cpu")), 1e-5)
