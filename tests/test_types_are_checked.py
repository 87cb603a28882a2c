"""The shape annotations are executed: a checker that never runs passes everything."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from spnr_jax.kernels import compositing
from spnr_jax.nn.convolution import GroupNorm


def test_two_arguments_that_must_share_an_axis_may_not_differ():
    compositing.volume_weights(jnp.ones((3, 4)), jnp.ones((3, 4)))
    with pytest.raises(TypeCheckError, match="delta"):
        compositing.volume_weights(jnp.ones((3, 4)), jnp.ones((3, 5)))


def test_the_fields_and_calls_of_linen_modules_are_checked():
    with pytest.raises(TypeCheckError, match="num_groups"):
        GroupNorm("8")
    with pytest.raises(TypeCheckError, match="x"):
        GroupNorm(2).init(jax.random.key(0), jnp.ones((1, 4), jnp.int32))
    assert isinstance(GroupNorm(2), nn.Module)


def test_ranks_are_not_promoted():
    with pytest.raises(ValueError, match="rank_promotion"):
        jnp.ones((2, 3)) + jnp.ones(3)


def test_a_key_may_not_be_used_twice():
    key = jax.random.key(0)
    jax.random.normal(key)
    with pytest.raises(jax.errors.KeyReuseError):
        jax.random.normal(key)
