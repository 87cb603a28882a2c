"""What the discriminator is shown, and its penalty."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from support.laws import close, numbers, same_bits
from support.tiny_model import SIZE
from support.tiny_training import BATCH, CONFIG, create

from spnr_jax.kernels import losses
from spnr_jax.training import adversary


@pytest.fixture(scope="module")
def judge():
    return create(CONFIG).discriminator


class TestCondition:
    def test_without_it_the_discriminator_sees_an_empty_image_and_mask(self, judge):
        blind = dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, condition=False))
        image, condition, mask = (x[:, 0] for x in (BATCH.image, BATCH.condition, BATCH.condition_mask))
        empty = jnp.zeros_like(condition), jnp.zeros_like(mask)
        seen, unseen, expected = (
            jax.jit(adversary.logits, static_argnums=0)(config, judge, image, *inputs)
            for config, inputs in ((CONFIG, (condition, mask)), (blind, (condition, mask)), (CONFIG, empty))
        )
        same_bits(unseen, expected)
        assert (seen != unseen).any()


class TestLazyR1:
    @pytest.mark.parametrize(("at", "due"), [(0, True), (1, False), (2, True), (3, False)])
    def test_the_penalty_comes_every_interval_and_is_scaled_by_it(self, judge, at, due):
        data, fake = BATCH, numbers(2, 2, SIZE, SIZE, 3)
        real, condition, mask = data.image[:, 0], data.condition[:, 0], data.condition_mask[:, 0]

        @jax.jit
        def parts(params, step):
            loss, metrics = adversary.discriminator_loss(CONFIG, params, fake, data, step)
            module = adversary.discriminator_of(CONFIG)
            penalty = losses.r1(lambda image: module.apply({"params": params}, image, condition, mask), real)
            return loss - metrics["discriminator"], 2 * 10 * penalty

        added, penalty = parts(judge, jnp.int32(at))
        assert penalty > 0
        close(added, penalty * due, rtol=1e-3, atol=1e-5)
