"""Training of the shrunken network: two configs, a batch of two painted balls, and steps that keep their input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.config import LossConfig, OptimizerConfig, TrainConfig
from spnr_jax.training import batching, optimisation
from support.laws import close
from support.tiny_dataset import NAMES, one_object
from support.tiny_model import MODEL, NUM_POINTS

CONFIG = TrainConfig(
    model=MODEL,
    loss=LossConfig(discriminator_width=4, r1_interval=2),
    optimizer=OptimizerConfig(lr_generator=2e-2, warmup_steps=4, ema_decay=0.9),
    num_steps=100,
    batch_objects=2,
    max_points=NUM_POINTS,
    min_points=NUM_POINTS,
)
L1_ONLY = dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, adversarial_weight=0.0), seed=1)
create = optimisation.jitted_create_state
copied = jax.jit(lambda tree: jax.tree.map(jnp.copy, tree))


BATCH = jax.tree.map(jnp.asarray, batching.make_batch([one_object(name) for name in NAMES[:2]], CONFIG, 0))


def step(state, config=CONFIG, data=BATCH):
    """One jitted step on a copy: the state that is passed in gets donated."""
    return optimisation.jitted_train_step(
        copied(state), data, config=config, adversarial=state.discriminator is not None
    )


def near(actual, expected):
    """Gradients agree to a thousandth of the largest entry of each leaf."""
    for ours, theirs in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        close(ours, theirs, rtol=1e-3, atol=1e-3 * float(np.abs(theirs).max()) + 1e-9)
