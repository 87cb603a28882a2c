"""Clamping; the others are in the tables of laws."""

import jax
import jax.numpy as jnp
from support.laws import close

from spnr_jax.kernels.numerics import clamp


def test_clamping_is_clip_and_its_gradient_goes_to_what_it_returns():
    x = jnp.array([-2.0, 0.3, 5.0, -1.0, 1.0])
    (value, pull_back) = jax.vjp(clamp, x, jnp.full(5, -1.0), jnp.full(5, 1.0))
    close(value, jnp.clip(x, -1, 1), rtol=0, atol=0)
    expected = [[0, 1, 0, 1, 1], [1, 0, 0, 0, 0], [0, 0, 1, 0, 0]]
    close(pull_back(jnp.ones(5)), tuple(jnp.array(row, jnp.float32) for row in expected))
