"""2D upsampler: what it learns is added to the bilinear picture."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference
from support.laws import close, numbers

from spnr_jax.kernels.imaging import bilinear
from spnr_jax.nn.paper_layers import Upsampler

X = numbers(0, 2, 4, 6, 5)
MODULE = Upsampler(width=4)
VARIABLES = jax.jit(MODULE.init)(jax.random.key(0), X)


@pytest.mark.parametrize(("height", "width"), [(8, 12), (6, 9), (4, 6), (5, 7), (1, 1)])
def test_bilinear_has_half_pixel_centres_and_clamps_at_the_border(height, width):
    resized = np.asarray(bilinear(X, height, width))
    for i in range(2):
        close(resized[i], reference.bilinear(np.asarray(X)[i], height, width), atol=1e-5)


def test_fresh_weights_give_the_bilinear_picture():
    close(jax.jit(MODULE.apply)(VARIABLES, X), bilinear(X[..., :3], 8, 12), rtol=0, atol=0)


def test_is_the_layers_written_out():
    params = jax.tree.map(lambda x: np.asarray(x + 0.2 * numbers(1, *x.shape)), VARIABLES["params"])
    out = np.asarray(jax.jit(MODULE.apply)({"params": jax.tree.map(jnp.asarray, params)}, X))
    for i in range(2):
        y = np.asarray(X)[i]
        for layer in range(4):
            y = reference.repeat_twice(y) if layer == 2 else y
            y = reference.convolution(y, params[f"kernel_{layer}"]) + params[f"bias_{layer}"]
            y = y if layer == 3 else np.where(y > 0, y, 0.2 * y)
        close(out[i], y + reference.bilinear(np.asarray(X)[i, ..., :3], 8, 12), atol=1e-5)
