"""Training of the shader network on crops of G-buffers: loss and step.

The state, its checkpoints, and the loop are those of the other networks (`optimisation.TrainState`, `trainer.py`).
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from spnr_jax.config import SurfelConfig, TrainConfig
from spnr_jax.kernels import losses
from spnr_jax.kernels.metrics import psnr
from spnr_jax.kernels.records import Crops
from spnr_jax.nn.convolution import run_by_run
from spnr_jax.nn.shader import Shader, picture
from spnr_jax.training import optimisation
from spnr_jax.training.optimisation import TrainState

LEAST_INSIDE = 1.0  # pixels; where nothing of the object is seen its error is 0


def loss(params: dict, crops: Crops, *, config: TrainConfig) -> tuple[Float[Array, ""], dict[str, Array]]:
    """(loss, metrics): errors of the picture on white and of the opacity, weighted as the config says."""
    assert isinstance(config.model, SurfelConfig)
    shader = Shader(config.model.widths, config.model.top)
    outputs: Any = shader.apply({"params": params}, jnp.asarray(crops.seen), crops.doublings, crops.margin)
    color, alpha = picture(outputs, jnp.asarray(crops.maps), jnp.asarray(crops.ambient), crops.doublings)
    image = color * alpha[..., None] + 1 - alpha[..., None]  # on white, as the reference is
    target = jnp.asarray(crops.target, jnp.float32) / 255
    opacity = target[..., 3]
    reference = target[..., :3] * opacity[..., None] + 1 - opacity[..., None]
    value = optimisation.reconstruction_loss(config, image, image, reference)
    value += config.loss.opacity_weight * losses.mse(alpha, opacity)
    value += config.loss.opacity_l1_weight * losses.l1(alpha, opacity)
    squared = jnp.sum((image - reference) ** 2 * opacity[..., None])
    metrics = {
        "psnr": jnp.mean(psnr(image, reference)),
        "l1": losses.l1(image, reference),
        "mse_inside": squared / (3 * jnp.maximum(jnp.sum(opacity), LEAST_INSIDE)),
        "mse_opacity": losses.mse(alpha, opacity),
    }
    return value, metrics


def train_step(state: TrainState, crops: Crops, *, config: TrainConfig) -> tuple[TrainState, dict[str, Array]]:
    """State after one step, and scalar metrics."""
    of_run = run_by_run(jax.value_and_grad(partial(loss, config=config), has_aux=True))
    (value, metrics), gradient = of_run(state.generator, crops)
    state = optimisation.stepped(config, state, gradient)
    return state, metrics | {"loss": value, "gradient_norm": optax.tree.norm(gradient)}


jitted_train_step = jax.jit(train_step, static_argnames="config", donate_argnames="state")
