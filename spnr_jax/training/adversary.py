"""The discriminator's side of a training step: when it takes part, what it says, and its loss."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from spnr_jax.config import PaperConfig, TrainConfig
from spnr_jax.kernels import losses
from spnr_jax.kernels.records import AnyArray, Batch
from spnr_jax.nn.discriminator import Discriminator


def first_adversarial_step(config: TrainConfig) -> int:
    """Step from which the discriminator takes part; num_steps if it never does."""
    share = config.loss.adversarial_start if config.loss.adversarial_weight else 1.0
    return round(share * config.num_steps)


def discriminator_of(config: TrainConfig) -> Discriminator:
    """The discriminator's module."""
    assert isinstance(config.model, PaperConfig), "the config refuses an adversarial loss of other networks"
    return Discriminator(config.loss.discriminator_width, config.model.encoder.num_groups, config.model.bf16)


def logits(config: TrainConfig, params: dict, image: AnyArray, condition: AnyArray, mask: AnyArray) -> Array:
    """What the discriminator says of the images under its parameters."""
    if not config.loss.condition:
        condition, mask = jnp.zeros_like(condition), jnp.zeros_like(mask)
    return discriminator_of(config).bind({"params": params})(*map(jnp.asarray, (image, condition, mask)))


def discriminator_loss(config: TrainConfig, params: dict, fake: AnyArray, batch: Batch, step: Array):
    """(loss, metrics) of the discriminator on references and renderings; R1 every r1_interval steps."""
    real, condition, mask = (flatten_views(x) for x in (batch.image, batch.condition, batch.condition_mask))
    both = logits(config, params, *(jnp.concatenate(x) for x in ((real, fake), (condition,) * 2, (mask,) * 2)))
    real_logits, fake_logits = jnp.split(both, 2)
    loss = losses.discriminator_adversarial(real_logits, fake_logits)
    metrics = {"discriminator": loss, "logit_real": jnp.mean(real_logits), "logit_fake": jnp.mean(fake_logits)}
    if config.loss.r1_gamma:

        def penalty():
            return losses.r1(lambda image: logits(config, params, image, condition, mask), real)

        due = step % config.loss.r1_interval == 0
        loss = loss + config.loss.r1_interval * config.loss.r1_gamma * jax.lax.cond(due, penalty, lambda: 0.0)
    return loss, metrics


def flatten_views(x: AnyArray) -> AnyArray:
    """(objects, views, ...) as (objects * views, ...)."""
    return x.reshape(-1, *x.shape[2:])
