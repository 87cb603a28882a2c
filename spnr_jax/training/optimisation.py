"""Training as pure functions: state in, state out.  Every method is trained by this step.

One step evaluates the method's loss (`methods.Method.loss`) once.  If there is a discriminator, it is updated first, on
the images of that forward pass; the generator then gets the gradient of the method's loss and of the updated
discriminator.  `adversarial` is static: without it the graph contains no discriminator.  All randomness of step s comes
from fold_in(state.key, s), so a resumed run repeats the uninterrupted one bit for bit.  On a CPU, the losses of several
runs under vmap are computed one after the other.
"""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Float

from spnr_jax.config import TrainConfig
from spnr_jax.errors import UserError
from spnr_jax.kernels import losses
from spnr_jax.kernels.records import AnyArray, Batch, Key, Record
from spnr_jax.methods import method_of

DiscriminatorState = tuple[dict, tuple]  # parameters and optimiser state of the discriminator


class TrainState(Record):
    """Everything that a step changes; data only.  `averaged` holds the moving averages that evaluation uses."""

    step: Array
    key: Key
    generator: dict
    batch_stats: dict
    generator_optimizer: tuple
    averaged: dict
    averaged_stats: dict
    discriminator: dict | None
    discriminator_optimizer: tuple | None


def learning_rate(config: TrainConfig) -> optax.Schedule:
    """Generator's learning rate: linear warm-up, then a cosine or an exponential down to final_lr_scale."""
    o = config.optimizer
    warmup = min(o.warmup_steps, config.num_steps)
    first, peak = o.lr_generator / max(warmup, 1), o.lr_generator
    if o.decay == "exponential":
        steps = max(config.num_steps - warmup, 1)
        return optax.warmup_exponential_decay_schedule(first, peak, warmup, steps, o.final_lr_scale)
    steps = max(config.num_steps, warmup + 1)
    return optax.warmup_cosine_decay_schedule(first, peak, warmup, steps, peak * o.final_lr_scale)


def optimizers(config: TrainConfig) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """The generator's optimiser, and Adam for the discriminator."""
    o = config.optimizer
    algorithm = {"adam": optax.adam, "radam": optax.radam}[o.algorithm]
    generator = algorithm(learning_rate(config), b1=o.beta1, b2=o.beta2)
    return (
        optax.chain(optax.clip_by_global_norm(o.clip_norm), generator) if o.clip_norm else generator,
        optax.adam(o.lr_discriminator, b1=o.beta1_discriminator, b2=o.beta2),
    )


def create_state(config: TrainConfig, seed: int | Array | None = None) -> TrainState:
    """Fresh weights and optimiser states from a seed (default: the config's)."""
    key = jax.random.key(config.seed if seed is None else seed)
    key, generator_key, discriminator_key = jax.random.split(key, 3)
    variables = method_of(config.model).init(generator_key, config.model)
    generator_adam, discriminator_adam = optimizers(config)
    generator, batch_stats = variables["params"], variables.get("batch_stats", {})
    discriminator = None
    if first_adversarial_step(config) < config.num_steps:
        image = jnp.zeros((1, *[config.model.image_resolution] * 2, 3))
        module = discriminator_of(config)
        discriminator = module.init(discriminator_key, image, image, image[..., 0] > 0)["params"]
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        key=key,
        generator=generator,
        batch_stats=batch_stats,
        generator_optimizer=generator_adam.init(generator),
        averaged=jax.tree.map(jnp.copy, generator),  # a donated state must not hold one buffer twice
        averaged_stats=jax.tree.map(jnp.copy, batch_stats),
        discriminator=discriminator,
        discriminator_optimizer=None if discriminator is None else discriminator_adam.init(discriminator),
    )


def init_from(state: TrainState, variables: dict) -> TrainState:
    """A fresh state with the generator's weights from another training; ValueError if they are of another network."""
    needed = {"params": state.generator, "batch_stats": state.batch_stats}
    given = {"params": variables["params"], "batch_stats": variables.get("batch_stats", {})}
    own, other = (flatten_dict(weights, sep="/") for weights in (needed, given))
    for name in own | other:
        shapes = [weights[name].shape if name in weights else "none" for weights in (own, other)]
        if shapes[0] != shapes[1]:
            raise UserError(
                f"the weights to begin with are of another network: shape of {name} {shapes[1]}, needed {shapes[0]}; "
                "use the preset that they were trained with"
            )

    given = jax.tree.map(lambda x, like: jax.device_put(jnp.array(x), like.sharding), given, needed)
    averaged = jax.tree.map(jnp.copy, given)
    return dataclasses.replace(
        state,
        generator=given["params"],
        batch_stats=given["batch_stats"],
        averaged=averaged["params"],
        averaged_stats=averaged["batch_stats"],
    )


# --- the discriminator ------------------------------------------------------------------------------------------------


def first_adversarial_step(config: TrainConfig) -> int:
    """Step from which the discriminator takes part; num_steps if it never does."""
    share = config.loss.adversarial_start if config.loss.adversarial_weight else 1.0
    return round(share * config.num_steps)


def discriminator_of(config: TrainConfig) -> Any:
    """The discriminator as a Linen module."""
    make = method_of(config.model).discriminator
    assert make is not None, "the config refuses an adversarial loss"
    return make(config)


def logits(config: TrainConfig, params: dict, image: AnyArray, condition: AnyArray, mask: AnyArray) -> Array:
    """The discriminator's logits for the images."""
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
    """Merges the first two axes: (objects, views, ...) to (objects * views, ...)."""
    return x.reshape(-1, *x.shape[2:])


def discriminator_step(
    config: TrainConfig, adversary: DiscriminatorState, fake: AnyArray, batch: Batch, step: Array
) -> tuple[DiscriminatorState, dict[str, Array]]:
    """The discriminator and its optimiser after one step on references and renderings, and its metrics."""
    params, optimizer = adversary
    gradient, metrics = jax.grad(partial(discriminator_loss, config), has_aux=True)(params, fake, batch, step)
    update, optimizer = optimizers(config)[1].update(gradient, optimizer)
    return (optax.apply_updates(params, update), optimizer), metrics


# --- steps ------------------------------------------------------------------------------------------------------------


def total_loss(
    config: TrainConfig,
    params: dict,
    stats: dict,
    adversary: DiscriminatorState | None,
    batch: Any,
    key: Key,
    step: Array,
) -> tuple[Float[Array, ""], tuple[dict[str, Array], dict, DiscriminatorState | None]]:
    """(loss, (metrics, statistics, adversary)): the method's loss, plus that of the discriminator after its step."""
    variables = {"params": params, "batch_stats": stats}
    value, outcome = method_of(config.model).loss(variables, batch, key, config=config)
    metrics = outcome.metrics
    if adversary is not None:
        fake = flatten_views(outcome.image)
        adversary, more = discriminator_step(config, adversary, jax.lax.stop_gradient(fake), outcome.batch, step)
        condition = (flatten_views(x) for x in (outcome.batch.condition, outcome.batch.condition_mask))
        fake_logits = logits(config, adversary[0], fake, *condition)
        value = value + config.loss.adversarial_weight * losses.generator_adversarial(fake_logits)
        metrics = metrics | more
    return value, (metrics, stats if outcome.statistics is None else outcome.statistics, adversary)


def train_step(
    state: TrainState, batch: Any, *, config: TrainConfig, adversarial: bool = False
) -> tuple[TrainState, dict[str, Array]]:
    """State after one step of the network, and of the discriminator on the same forward pass; and scalar metrics."""
    key = jax.random.fold_in(state.key, state.step)
    adversary = (state.discriminator, state.discriminator_optimizer) if adversarial else None
    gradient_of = jax.value_and_grad(partial(total_loss, config), has_aux=True)
    if jax.default_backend() == "cpu":  # vmap over runs batches the kernels: grouped convolutions, slow in XLA
        gradient_of = jax.custom_batching.sequential_vmap(gradient_of)
    (loss, (metrics, batch_stats, adversary)), gradient = gradient_of(
        state.generator, state.batch_stats, adversary, batch, key, state.step
    )
    update, generator_optimizer = optimizers(config)[0].update(gradient, state.generator_optimizer)
    generator = optax.apply_updates(state.generator, update)
    averaged, averaged_stats = moving_average(
        (state.averaged, state.averaged_stats), (generator, batch_stats), state.step, config.optimizer.ema_decay
    )
    discriminator, discriminator_optimizer = adversary or (state.discriminator, state.discriminator_optimizer)
    state = TrainState(
        step=state.step + 1,
        key=state.key,
        generator=generator,
        batch_stats=batch_stats,
        generator_optimizer=generator_optimizer,
        averaged=averaged,
        averaged_stats=averaged_stats,
        discriminator=discriminator,
        discriminator_optimizer=discriminator_optimizer,
    )
    return state, metrics | {"loss": loss, "gradient_norm": optax.tree.norm(gradient)}


def moving_average(averaged: Any, newest: Any, step: Array, decay: float) -> Any:
    """Moving average after a step.  Its memory grows from 0.1, because early weights are far from the last."""
    share = jnp.minimum(decay, (1.0 + step) / (10.0 + step))
    return jax.tree.map(lambda old, new: share * old + (1 - share) * new, averaged, newest)


def averaged_variables(state: TrainState) -> dict:
    """The averaged weights of the generator that evaluation uses, as Linen variables."""
    return {"params": state.averaged, "batch_stats": state.averaged_stats}


# runs once: compiling fast (2.7 s of CPU time instead of 7.0 for `tiny`) matters more than running fast
ONCE = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
jitted_create_state = jax.jit(create_state, static_argnames="config", compiler_options=ONCE)
jitted_train_step = jax.jit(train_step, static_argnames=("config", "adversarial"), donate_argnames="state")
