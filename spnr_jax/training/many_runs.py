"""Whole trainings in one compiled program: states and batches of all runs are one tree with an axis of runs first.

`step` alone is shared, so that what depends on it (R1 every so many steps) stays a branch.  The config is static and
shared; what runs may differ in are seeds, batches and a factor of the learning rates.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.config import TrainConfig
from spnr_jax.kernels.records import Batch
from spnr_jax.training import optimisation
from spnr_jax.training.optimisation import TrainState

OF_A_RUN = tuple(field.name for field in dataclasses.fields(TrainState) if field.name != "step")
AXES: Any = TrainState(step=None, **dict.fromkeys(OF_A_RUN, 0))  # type: ignore[arg-type]


def stack(states: Sequence[TrainState]) -> TrainState:
    """States of one step as one tree; keys are stacked as plain numbers, which are not drawn from."""
    plain = [dataclasses.replace(state, key=jax.random.key_data(state.key)) for state in states]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *plain)
    return dataclasses.replace(stacked, step=jnp.copy(states[0].step), key=jax.random.wrap_key_data(stacked.key))


def train_step(
    states: TrainState,
    batches: Batch,
    lr_scales: Float[Array, " runs"] | None = None,
    *,
    config: TrainConfig,
    adversarial: bool,
) -> tuple[TrainState, dict[str, Array]]:
    """`optimisation.train_step` of every run: stacked states after it, and the metrics of each run."""

    def one(state: TrainState, batch: Batch, lr_scale: Array | None) -> tuple[TrainState, dict[str, Array]]:
        return optimisation.train_step(state, batch, config=config, adversarial=adversarial, lr_scale=lr_scale)

    return jax.vmap(one, in_axes=(AXES, 0, 0), out_axes=(AXES, 0))(states, batches, lr_scales)


jitted_train_step = jax.jit(train_step, static_argnames=("config", "adversarial"), donate_argnames="states")
