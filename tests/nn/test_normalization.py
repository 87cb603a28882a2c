"""Batch statistics over real points alone, and groups of channels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers

from spnr_jax.nn.convolution import BatchNorm

X = 3 * numbers(0, 2, 6, 4) + 1
ALL = jnp.ones((2, 6), bool)
VARIABLES = {
    "params": {"scale": numbers(1, 4) + 2, "bias": numbers(2, 4)},
    "batch_stats": {"mean": numbers(3, 4), "variance": numbers(4, 4) + 1.5},
}


@jax.jit
def train(x, mask):
    return BatchNorm().apply(VARIABLES, x, mask, True, mutable=["batch_stats"])


@jax.jit
def evaluate(x, mask):
    return BatchNorm().apply(VARIABLES, x, mask, False)


@jax.jit
def squared_gradient(x, mask):
    return jax.grad(lambda x: jnp.sum(jnp.where(mask[..., None], train(x, mask)[0], 0) ** 2))(x)


class TestBatchNorm:
    @pytest.mark.parametrize("fill", [0.0, 1e30, np.nan])
    def test_with_padding_is_that_of_the_unpadded_set_whatever_the_padding_holds(self, fill):
        padded = jnp.concatenate([X, jnp.full((2, 3, 4), fill)], axis=1)
        mask = jnp.concatenate([ALL, jnp.zeros((2, 3), bool)], axis=1)
        (out, stats), (plain, plain_stats) = train(padded, mask), train(X, ALL)
        close(out[:, :6], plain)
        close(stats, plain_stats)
        gradient = squared_gradient(padded, mask)
        close(gradient[:, :6], squared_gradient(X, ALL), atol=1e-5)
        assert (gradient[:, 6:] == 0).all()

    def test_in_evaluation_no_point_sees_the_others(self):
        whole = evaluate(X, ALL)
        close(evaluate(X[1:, :1], ALL[1:, :1]), whole[1:, :1], rtol=0)
        stats = VARIABLES["batch_stats"]
        expected = (np.float64(X) - np.float64(stats["mean"])) / np.sqrt(np.float64(stats["variance"]) + 1e-5)
        params = VARIABLES["params"]
        close(whole, expected * np.float64(params["scale"]) + np.float64(params["bias"]), atol=1e-5)

    def test_initialising_leaves_the_running_statistics_at_their_start(self):
        stats = BatchNorm().init(jax.random.key(0), X, ALL, True)["batch_stats"]
        close(stats, {"mean": jnp.zeros(4), "variance": jnp.ones(4)})
