"""Training as pure functions: state in, state out.  The networks that render whole views are trained by it.

    forward -> losses -> train_step -> jitted train_step

A method is a network and a loss: the config of a network finds its module (`inference.network`), and any module with
`encode`, `render` and `__call__` is trained by this step.  What it sows into the collection "losses" is added to the
loss; a network without `render_rays` renders whole images.

One step renders every view of the batch once.  The discriminator is updated on that rendering, the generator on the
gradient that the updated discriminator and the L1 loss send back through it.  `adversarial` is static: without it the
graph contains no discriminator.  All randomness of step s comes from fold_in(state.key, s), so a resumed run repeats
the uninterrupted one bit for bit.
"""

import dataclasses
from functools import partial
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import optax
from flax import struct
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Float

from spnr_jax.config import TrainConfig
from spnr_jax.errors import UserError
from spnr_jax.kernels import losses
from spnr_jax.kernels.metrics import psnr
from spnr_jax.kernels.records import AnyArray, Batch, Key
from spnr_jax.method.inference import init, network
from spnr_jax.training import adversary, pixels


@no_type_check
@struct.dataclass
class TrainState:
    """Everything that a step changes; data only.  `averaged` is the generator that evaluation uses."""

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
    if o.decay == "exponential":
        return optax.warmup_exponential_decay_schedule(
            init_value=o.lr_generator / max(warmup, 1),
            peak_value=o.lr_generator,
            warmup_steps=warmup,
            transition_steps=max(config.num_steps - warmup, 1),
            decay_rate=o.final_lr_scale,
        )
    return optax.warmup_cosine_decay_schedule(
        init_value=o.lr_generator / max(warmup, 1),
        peak_value=o.lr_generator,
        warmup_steps=warmup,
        decay_steps=max(config.num_steps, warmup + 1),
        end_value=o.lr_generator * o.final_lr_scale,
    )


def optimizers(config: TrainConfig) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """The generator's algorithm, and Adam for the discriminator."""
    o = config.optimizer
    algorithm = {"adam": optax.adam, "radam": optax.radam}[o.algorithm]
    generator = algorithm(learning_rate(config), b1=o.beta1, b2=o.beta2)
    return (
        optax.chain(optax.clip_by_global_norm(o.clip_norm), generator) if o.clip_norm else generator,
        optax.adam(o.lr_discriminator, b1=o.beta1_discriminator, b2=o.beta2),
    )


def create_state(config: TrainConfig, seed: int | Array | None = None) -> TrainState:
    """Fresh weights and optimisers from a seed, the config's by default."""
    key = jax.random.key(config.seed if seed is None else seed)
    key, generator_key, discriminator_key = jax.random.split(key, 3)
    variables = init(generator_key, config.model)
    generator_adam, discriminator_adam = optimizers(config)
    generator, batch_stats = variables["params"], variables.get("batch_stats", {})
    discriminator = None
    if adversary.first_adversarial_step(config) < config.num_steps:
        image = jnp.zeros((1, *[config.model.image_resolution] * 2, 3))
        judge = adversary.discriminator_of(config)
        discriminator = judge.init(discriminator_key, image, image, image[..., 0] > 0)["params"]
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


def begun_with(state: TrainState, variables: dict) -> TrainState:
    """A fresh state with the generator of another training; ValueError if its weights are of another network."""
    params, stats = variables["params"], variables.get("batch_stats", {})
    needed = {"params": state.generator, "batch_stats": state.batch_stats}
    own, other = (flatten_dict(weights, sep="/") for weights in (needed, {"params": params, "batch_stats": stats}))
    for name in own | other:
        shapes = [weights[name].shape if name in weights else "none" for weights in (own, other)]
        if shapes[0] != shapes[1]:
            raise UserError(
                f"the weights to begin with are of another network: shape of {name} {shapes[1]}, needed {shapes[0]}; "
                "use the preset that they were trained with"
            )

    def placed(new, old):
        return jax.tree.map(lambda x, like: jax.device_put(jnp.array(x), like.sharding), new, old)

    return dataclasses.replace(
        state,
        generator=placed(params, state.generator),
        batch_stats=placed(stats, state.batch_stats),
        averaged=placed(params, state.averaged),
        averaged_stats=placed(stats, state.averaged_stats),
    )


def pixel_error(config: TrainConfig, image: Array, reference: Array, seen: Array | None = None) -> Float[Array, ""]:
    """Mean error of all pixels, or of those that are `seen` (0 if there are none)."""
    if seen is None:
        return {"l1": losses.l1, "mse": losses.mse}[config.loss.pixel](image, reference)
    error = {"l1": jnp.abs, "mse": jnp.square}[config.loss.pixel](image - reference)
    return jnp.sum(jnp.where(seen[..., None], error, 0)) / jnp.maximum(3 * jnp.sum(seen), 1)


def reconstruction_loss(
    config: TrainConfig,
    image: Float[Array, "*batch"],
    image_lr: Float[Array, "*batch_lr"],
    reference: Array,
    seen: Array | None = None,
) -> Float[Array, ""]:
    """Weighted errors of the image, and of a smaller volume rendering against the reference averaged to its size."""
    error = pixel_error(config, image, reference, seen)
    if config.model.upsamples:
        low = losses.area_downsample(reference, image_lr.shape[-2])
        error = error + config.loss.low_resolution_weight * pixel_error(config, image_lr, low)
    error = config.loss.l1_weight * error
    return error + config.loss.mse_weight * losses.mse(image, reference) if config.loss.mse_weight else error


def forward(
    config: TrainConfig, state: TrainState, batch: Batch, key: Key, params: dict
) -> tuple[tuple[Array, Array, dict], tuple[dict, Array | None]]:
    """Image, low-resolution image, losses of the network's own; and, without gradient, statistics and pixels seen."""
    rendering, updated = network(config.model).apply(
        {"params": params, "batch_stats": state.batch_stats},
        batch.cloud,
        batch.camera,
        key,
        train=True,
        mutable=["batch_stats", "losses"],
    )
    sown = {name: value for name, (value,) in updated.get("losses", {}).items()}
    if config.loss.opacity_weight:
        opacity = losses.area_downsample(jnp.asarray(batch.alpha)[..., None], rendering.acc.shape[-1])[..., 0]
        sown["opacity"] = config.loss.opacity_weight * losses.mse(rendering.acc, opacity)
    seen = rendering.acc > 0 if config.loss.masked else None
    return (rendering.image, rendering.image_lr, sown), (updated.get("batch_stats", {}), seen)


def discriminator_step(
    config: TrainConfig, state: TrainState, fake: AnyArray, batch: Batch, lr_scale: Array | None
) -> tuple[dict, tuple, dict[str, Array]]:
    """The discriminator and its optimiser after one step on references and renderings, and its metrics."""
    gradient, metrics = jax.grad(partial(adversary.discriminator_loss, config), has_aux=True)(
        state.discriminator, fake, batch, state.step
    )
    update, optimizer = optimizers(config)[1].update(gradient, state.discriminator_optimizer)
    return optax.apply_updates(state.discriminator, _scaled(update, lr_scale)), optimizer, metrics


def generator_loss(
    config: TrainConfig,
    batch: Batch,
    seen: Array | None,
    discriminator: dict | None,
    image: Array,
    image_lr: Array,
    sown: dict[str, Array],
) -> Float[Array, ""]:
    """Errors of a rendering, losses of the network's own, and the adversarial loss if there is a discriminator."""
    loss = reconstruction_loss(config, image, image_lr, jnp.asarray(batch.image), seen)
    for term in sown.values():
        loss = loss + term
    if discriminator is not None:
        views = (adversary.flatten_views(x) for x in (image, batch.condition, batch.condition_mask))
        fake_logits = adversary.logits(config, discriminator, *views)
        loss = loss + config.loss.adversarial_weight * losses.generator_adversarial(fake_logits)
    return loss


def train_step(
    state: TrainState,
    batch: Batch,
    *,
    config: TrainConfig,
    adversarial: bool,
    lr_scale: Float[Array, ""] | None = None,
) -> tuple[TrainState, dict[str, Array]]:
    """State after one step of both networks from one generator forward, and scalar metrics.

    `lr_scale` multiplies both learning rates, which are static: as an array it may be one for each run under vmap.
    """
    key = jax.random.fold_in(state.key, state.step)
    key, batch = pixels.chosen(key, batch, config)
    (image, image_lr, sown), pull_back, (batch_stats, seen) = jax.vjp(
        partial(forward, config, state, batch, key), state.generator, has_aux=True
    )
    reference = jnp.asarray(batch.image)
    metrics = {"psnr": jnp.mean(psnr(image, reference)), "l1": losses.l1(image, reference)}
    discriminator, discriminator_optimizer = state.discriminator, state.discriminator_optimizer
    if adversarial:
        fake = adversary.flatten_views(image)
        discriminator, discriminator_optimizer, more = discriminator_step(config, state, fake, batch, lr_scale)
        metrics |= more
    loss, cotangents = jax.value_and_grad(
        partial(generator_loss, config, batch, seen, discriminator if adversarial else None), argnums=(0, 1, 2)
    )(image, image_lr, sown)
    (gradient,) = pull_back(cotangents)
    update, generator_optimizer = optimizers(config)[0].update(gradient, state.generator_optimizer)
    generator = optax.apply_updates(state.generator, _scaled(update, lr_scale))
    metrics |= {"loss": loss, "gradient_norm": optax.tree.norm(gradient)} | sown
    averaged, averaged_stats = moving_average(
        (state.averaged, state.averaged_stats), (generator, batch_stats), state.step, config.optimizer.ema_decay
    )
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
    return state, metrics


def _scaled(update: Any, factor: Array | None) -> Any:
    return update if factor is None else jax.tree.map(lambda x: factor * x, update)


def moving_average(averaged: Any, newest: Any, step: Array, decay: float) -> Any:
    """The average with the newest weights in it, over a growing share of the past: early ones are far from the last."""
    share = jnp.minimum(decay, (1.0 + step) / (10.0 + step))
    return jax.tree.map(lambda old, new: share * old + (1 - share) * new, averaged, newest)


def stepped(config: TrainConfig, state: TrainState, gradient: dict) -> TrainState:
    """The state after a step of the generator by its gradient."""
    update, optimizer = optimizers(config)[0].update(gradient, state.generator_optimizer)
    generator = optax.apply_updates(state.generator, update)
    return dataclasses.replace(
        state,
        step=state.step + 1,
        generator=generator,
        generator_optimizer=optimizer,
        averaged=moving_average(state.averaged, generator, state.step, config.optimizer.ema_decay),
    )


def averaged_variables(state: TrainState) -> dict:
    """The generator that evaluation uses, as Linen variables."""
    return {"params": state.averaged, "batch_stats": state.averaged_stats}


# runs once: a quick compilation, 2.7 s of CPU time instead of 7.0 for `tiny`, is worth more than quick code
ONCE = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
jitted_create_state = jax.jit(create_state, static_argnames="config", compiler_options=ONCE)
jitted_train_step = jax.jit(train_step, static_argnames=("config", "adversarial"), donate_argnames="state")
