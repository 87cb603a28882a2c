"""Training of the shrunken network: two configs, a batch of two coloured balls, and steps that keep their input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.config import LossConfig, OptimizerConfig, TrainConfig
from spnr_jax.kernels.cameras import look_at, pinhole
from spnr_jax.kernels.records import Batch, PointCloud
from spnr_jax.training import optimisation
from support.laws import close
from support.tiny_model import MODEL, NUM_POINTS, SIZE

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


def batch():
    """Two coloured balls on white, each seen from its own side."""
    directions = np.random.default_rng(0).normal(size=(2, NUM_POINTS, 3)).astype(np.float32)
    positions = 0.5 * directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    colors = np.float32([[0.8, 0.2, 0.1], [0.1, 0.3, 0.7]])
    eyes = np.float32([[[0, 0.5, 2.5]], [[2.5, 0.5, 0]]])
    pose = look_at(jnp.asarray(eyes), jnp.zeros(eyes.shape), jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), eyes.shape))
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    disc = np.broadcast_to((np.hypot(rows, columns) < 0.3 * SIZE)[None, None], (2, 1, SIZE, SIZE))
    image = np.where(disc[..., None], colors[:, None, None, None], np.float32(1))
    points = np.broadcast_to(colors[:, None], (2, NUM_POINTS, 3))
    cloud = PointCloud(
        positions=positions,
        base_color=points,
        roughness=points[..., 0],
        metallic=points[..., 1] * 0,
        mask=np.ones((2, NUM_POINTS), bool),
    )
    mask = disc & (np.random.default_rng(1).uniform(size=disc.shape) < 0.2)
    made = Batch(
        cloud=cloud,
        camera=pinhole(pose, 0.6, SIZE, SIZE),
        image=image,
        alpha=disc.astype(np.float32),
        condition=image * mask[..., None],
        condition_mask=mask,
    )
    return jax.tree.map(jnp.asarray, made)


BATCH = batch()


def step(state, config=CONFIG, data=BATCH):
    """One jitted step on a copy: the state that is passed in gets donated."""
    return optimisation.jitted_train_step(
        copied(state), data, config=config, adversarial=state.discriminator is not None
    )


def near(actual, expected):
    """Gradients agree to a thousandth of the largest entry of each leaf."""
    for ours, theirs in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        close(ours, theirs, rtol=1e-3, atol=1e-3 * float(np.abs(theirs).max()) + 1e-9)
