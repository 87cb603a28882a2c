"""Training as pure functions: state in, state out.  The only jax.jit lines of the package's training stand here.

    forward -> losses -> train_step -> jitted train_step

One step renders every view of the batch once.  The discriminator is updated on that rendering, the generator on the
gradient that the updated discriminator and the L1 loss send back through it.  `adversarial` is static: without it the
graph contains no discriminator.  All randomness of step s comes from fold_in(state.key, s), so a resumed run repeats
the uninterrupted one bit for bit.
"""

from functools import partial
from typing import no_type_check

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from spnr_jax import losses
from spnr_jax.config import ModelConfig, TrainConfig
from spnr_jax.metrics import psnr
from spnr_jax.nn.discriminator import Discriminator
from spnr_jax.renderer import Renderer
from spnr_jax.types import Batch, Camera, Key, PointCloud, Rendering

RAY_CHUNK = 1024  # rays of an object rendered at once: about 80 MB at 128 samples


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
    """Generator's learning rate: linear warm-up, then a cosine down to final_lr_scale."""
    o = config.optimizer
    warmup = min(o.warmup_steps, config.num_steps)
    return optax.warmup_cosine_decay_schedule(
        init_value=o.lr_generator / max(warmup, 1),
        peak_value=o.lr_generator,
        warmup_steps=warmup,
        decay_steps=max(config.num_steps, warmup + 1),
        end_value=o.lr_generator * o.final_lr_scale,
    )


def optimizers(config: TrainConfig) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Adam for the generator and for the discriminator."""
    o = config.optimizer
    return (
        optax.adam(learning_rate(config), b1=o.beta1, b2=o.beta2),
        optax.adam(o.lr_discriminator, b1=o.beta1_discriminator, b2=o.beta2),
    )


def first_adversarial_step(config: TrainConfig) -> int:
    """Step from which the discriminator takes part; num_steps if it never does."""
    share = config.loss.adversarial_start if config.loss.adversarial_weight else 1.0
    return round(share * config.num_steps)


def discriminator_of(config: TrainConfig) -> Discriminator:
    """The discriminator's module."""
    return Discriminator(config.loss.discriminator_width, config.model.num_groups, config.model.bf16)


def example_inputs(config: TrainConfig) -> tuple[PointCloud, Camera]:
    """The smallest valid inputs of the generator, for the shapes of its parameters."""
    points, size = jnp.zeros((1, 2, 3)), config.model.image_resolution
    scalars = jnp.zeros((1, 2))
    cloud = PointCloud(
        positions=points, base_color=points, roughness=scalars, metallic=scalars, mask=jnp.ones((1, 2), bool)
    )
    pose = jnp.concatenate([jnp.eye(3), jnp.array([[0.0], [0.0], [3.0]])], axis=1)
    return cloud, Camera(cam_to_world=pose[None, None], intrinsics=jnp.eye(3)[None, None], height=size, width=size)


def create_state(config: TrainConfig) -> TrainState:
    """Fresh weights and optimisers from the config's seed."""
    key, generator_key, discriminator_key = jax.random.split(jax.random.key(config.seed), 3)
    variables = Renderer(config.model).init(generator_key, *example_inputs(config))
    generator_adam, discriminator_adam = optimizers(config)
    generator, batch_stats = variables["params"], variables["batch_stats"]
    discriminator = None
    if first_adversarial_step(config) < config.num_steps:
        image = jnp.zeros((1, *[config.model.image_resolution] * 2, 3))
        discriminator = discriminator_of(config).init(discriminator_key, image, image, image[..., 0] > 0)["params"]
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


def reconstruction_loss(
    config: TrainConfig, image: Float[Array, "*batch"], image_lr: Float[Array, "*batch_lr"], reference: Array
) -> Float[Array, ""]:
    """Weighted L1 of the image, and of the volume-rendered RGB against the reference averaged down to its size."""
    low = losses.area_downsample(reference, image_lr.shape[-2])
    weight = config.loss.low_resolution_weight if config.model.upsamples else 0.0
    return config.loss.l1_weight * (losses.l1(image, reference) + weight * losses.l1(image_lr, low))


def logits(config: TrainConfig, params: dict, image: Array, condition: Array, mask: Array) -> Array:
    """What the discriminator says of the images under its parameters."""
    return discriminator_of(config).bind({"params": params})(image, condition, mask)


def discriminator_loss(config: TrainConfig, params: dict, fake: Array, batch: Batch, step: Array):
    """(loss, metrics) of the discriminator on references and renderings; R1 every r1_interval steps."""
    real, condition, mask = (_flatten_views(x) for x in (batch.image, batch.condition, batch.condition_mask))
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


def _flatten_views(x):
    return x.reshape(-1, *x.shape[2:])


def train_step(
    state: TrainState, batch: Batch, *, config: TrainConfig, adversarial: bool
) -> tuple[TrainState, dict[str, Array]]:
    """State after one step of both networks from one generator forward, and scalar metrics."""
    key = jax.random.fold_in(state.key, state.step)
    renderer, reference = Renderer(config.model), jnp.asarray(batch.image)
    generator_adam, discriminator_adam = optimizers(config)

    def forward(params):
        variables = {"params": params, "batch_stats": state.batch_stats}
        rendering, updated = renderer.apply(
            variables, batch.cloud, batch.camera, key, train=True, mutable=["batch_stats"]
        )
        return (rendering.image, rendering.image_lr), updated["batch_stats"]

    (image, image_lr), pull_back, batch_stats = jax.vjp(forward, state.generator, has_aux=True)
    metrics = {"psnr": jnp.mean(psnr(image, reference)), "l1": losses.l1(image, reference)}
    discriminator, discriminator_optimizer = state.discriminator, state.discriminator_optimizer
    if adversarial:
        fake = _flatten_views(image)
        gradient, more = jax.grad(partial(discriminator_loss, config), has_aux=True)(
            discriminator, fake, batch, state.step
        )
        update, discriminator_optimizer = discriminator_adam.update(gradient, discriminator_optimizer)
        discriminator = optax.apply_updates(discriminator, update)
        metrics |= more

    def image_loss(image, image_lr):
        loss = reconstruction_loss(config, image, image_lr, reference)
        if adversarial:
            views = (_flatten_views(x) for x in (image, batch.condition, batch.condition_mask))
            fake_logits = logits(config, discriminator, *views)
            loss = loss + config.loss.adversarial_weight * losses.generator_adversarial(fake_logits)
        return loss

    loss, cotangents = jax.value_and_grad(image_loss, argnums=(0, 1))(image, image_lr)
    (gradient,) = pull_back(cotangents)
    update, generator_optimizer = generator_adam.update(gradient, state.generator_optimizer)
    generator = optax.apply_updates(state.generator, update)
    metrics |= {"loss": loss, "gradient_norm": optax.tree.norm(gradient)}

    # early weights are far from the last ones: average over a growing share of the past
    decay = jnp.minimum(config.optimizer.ema_decay, (1.0 + state.step) / (10.0 + state.step))
    averaged, averaged_stats = jax.tree.map(
        lambda old, new: decay * old + (1 - decay) * new,
        (state.averaged, state.averaged_stats),
        (generator, batch_stats),
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


def encode(variables: dict, cloud: PointCloud, *, config: ModelConfig) -> Array:
    """Feature volumes (objects, d, d, d, features) of the clouds."""
    return Renderer(config).bind(variables).encode(cloud)


def render(
    variables: dict, volume: Array, camera: Camera, *, config: ModelConfig, ray_chunk: int = RAY_CHUNK
) -> Rendering:
    """Views of encoded volumes, samples at the middles of their strata.

    So many rays of each object are rendered at a time, which bounds the memory.  On a CPU a pixel of one object has the
    same bits for every chunk from 256 to 2048 rays, whatever is rendered beside it: the matrix products then add up in
    one order.
    """
    renderer = Renderer(config)
    rays = renderer.rays(camera)
    num_rays = rays.origins.shape[1]
    chunk = min(ray_chunk, num_rays)
    pad = ((0, 0), (0, -num_rays % chunk), (0, 0))
    chunks = jax.tree.map(lambda x: jnp.pad(x, pad, mode="edge").reshape(x.shape[0], -1, chunk, 3), rays)
    outputs = jax.lax.map(
        lambda rays: renderer.bind(variables).render_rays(volume, rays),
        jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), chunks),
    )
    outputs = jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1, *x.shape[3:])[:, :num_rays], outputs)
    return renderer.bind(variables).develop(camera, *outputs)


def averaged_variables(state: TrainState) -> dict:
    """The generator that evaluation uses, as Linen variables."""
    return {"params": state.averaged, "batch_stats": state.averaged_stats}


# runs once: a quick compilation is worth more than quick code
jitted_create_state = jax.jit(
    create_state, static_argnames="config", compiler_options={"xla_backend_optimization_level": 1}
)
jitted_train_step = jax.jit(train_step, static_argnames=("config", "adversarial"), donate_argnames="state")
jitted_encode = jax.jit(encode, static_argnames="config")
jitted_render = jax.jit(render, static_argnames=("config", "ray_chunk"))
