"""Batch statistics over real points alone, whatever the padding holds; the rest is in the laws and test_parity.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers
from support.tiny_model import wobbled

from spnr_jax.nn.convolution import BatchNorm

X, ALL = 3 * numbers(0, 2, 6, 4) + 1, jnp.ones((2, 6), bool)
FRESH = BatchNorm().init(jax.random.key(0), X, ALL, True)


@jax.jit
def train(x, mask):
    """Output and statistics, and the gradient of the sum of squares."""

    def total(x):
        found = BatchNorm().apply(wobbled(FRESH, 1), x, mask, True, mutable=["batch_stats"])
        return jnp.sum(jnp.where(mask[..., None], found[0], 0) ** 2), found

    return jax.grad(total, has_aux=True)(x)


@pytest.mark.parametrize("fill", [0.0, 1e30, np.nan])
def test_with_padding_is_that_of_the_unpadded_set_whatever_the_padding_holds(fill):
    padded = jnp.concatenate([X, jnp.full((2, 3, 4), fill)], axis=1)
    mask = jnp.concatenate([ALL, jnp.zeros((2, 3), bool)], axis=1)
    (gradient, (out, stats)), (plain_gradient, (plain, plain_stats)) = train(padded, mask), train(X, ALL)
    close((out[:, :6], stats), (plain, plain_stats))
    close(gradient[:, :6], plain_gradient, atol=1e-5)
    assert (gradient[:, 6:] == 0).all()


def test_initialising_leaves_the_running_statistics_at_their_start():
    close(FRESH["batch_stats"], {"mean": jnp.zeros(4), "variance": jnp.ones(4)})
