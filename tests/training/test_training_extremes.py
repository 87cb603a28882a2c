"""Training with settings and batches that nobody meant: finite to its end, or stopped with step and quantity."""

import functools
import re
from contextlib import closing
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset
from support.tiny_baselines import SHRUNKEN

from spnr_jax.config import LossConfig, OptimizerConfig, TrainConfig
from spnr_jax.training import batching, optimisation, trainer

pytestmark = pytest.mark.ci  # it trains several networks

EVERY_STEP = trainer.Schedule(log_every=1, preview_every=100, checkpoint_every=100)
NAMED = re.compile(r"(\w+) is (?:nan|inf|-inf) at step (\d+); the last checkpoint is kept")
TAME = replace(
    tiny_dataset.CONFIG,
    loss=LossConfig(discriminator_width=4, r1_interval=2),
    optimizer=OptimizerConfig(lr_generator=2e-3, warmup_steps=2),
    num_steps=20,
)


def wild(config: TrainConfig, rates: float, **weights: float) -> TrainConfig:
    """The config with both learning rates so many times higher, and other weights in its loss."""
    o = config.optimizer
    faster = replace(o, lr_generator=rates * o.lr_generator, lr_discriminator=rates * o.lr_discriminator)
    return replace(config, optimizer=faster, loss=replace(config.loss, **weights))


WILD = wild(TAME, 100, l1_weight=1e6, adversarial_weight=1e6)
HOPELESS = wild(TAME, 1e11, adversarial_weight=0.0)


def assert_finite(tree):
    """No number of the tree is NaN or infinite; the message names its place."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


def train_to_the_end_or_a_name(config, dataset, run) -> str | None:
    """The quantity that stopped the training, None if it reached its end; every step before has a finite row."""
    try:
        state = trainer.train(config, dataset, run, EVERY_STEP)
    except trainer.NotFinite as error:
        quantity, step = NAMED.match(str(error)).groups()
        whole = int(step) - 1
    else:
        assert_finite(state)
        updates = state.generator_optimizer[0].count, state.discriminator_optimizer[0].count
        assert updates == (config.num_steps, config.num_steps - optimisation.first_adversarial_step(config))
        quantity, whole = None, config.num_steps
    rows = [row for row in trainer.read_rows(run) if "loss" in row]
    assert [row["step"] for row in rows] == list(range(1, whole + 1))
    assert all(np.isfinite(value) for row in rows for value in row.values())
    return quantity


@pytest.mark.parametrize("config", [WILD, pytest.param(HOPELESS, marks=pytest.mark.slow)], ids=["wild", "hopeless"])
def test_training_with_wild_settings_is_finite_to_its_end_or_stops_by_name(config, tmp_path):
    """Learning rates a hundred times too high and both losses weighted with a million; rates beyond all hope."""
    stopped = train_to_the_end_or_a_name(config, tiny_dataset.dataset(), tmp_path)
    assert (stopped is None) == (config is WILD)


def without_points(batch, kept=-1):
    """The batch with clouds of padding alone, or of one point each."""
    mask = jnp.broadcast_to(jnp.arange(batch.cloud.mask.shape[-1]) == kept, batch.cloud.mask.shape)
    return replace(batch, cloud=replace(batch.cloud, mask=mask))


def empty(batch):
    """The batch with white references, on which no input point is seen."""
    nothing, unseen = jnp.zeros_like(batch.condition), jnp.zeros_like(batch.condition_mask)
    return replace(batch, image=nothing + 1, condition=nothing, condition_mask=unseen)


BATCHES = {
    "as it is": lambda batch: batch,
    "no point": without_points,
    "one point on empty images": lambda batch: empty(without_points(batch, 3)),
    "black": lambda batch: replace(batch, image=jnp.zeros_like(batch.image)),
}


@functools.cache
def first_batch():
    """A training batch of the painted balls, shared by TAME and WILD."""
    with closing(batching.batches(tiny_dataset.dataset(), TAME, 0)) as batches:
        return jax.tree.map(jnp.asarray, next(batches))


@pytest.mark.parametrize("name", BATCHES)
def test_both_networks_stay_finite_in_twenty_steps_on(name):
    state, batch = optimisation.jitted_create_state(WILD), BATCHES[name](first_batch())
    for _ in range(20):
        state, metrics = optimisation.jitted_train_step(state, batch, config=WILD, adversarial=True)
        assert_finite(metrics)
    assert_finite(state)


BFLOAT16 = replace(TAME, model=replace(TAME.model, precision="bfloat16"))
SLOW = {"paper, bfloat16": BFLOAT16, **SHRUNKEN}


@pytest.mark.slow
@pytest.mark.parametrize("config", SLOW.values(), ids=SLOW)
def test_no_step_of_a_training_makes_a_nan(config):
    """While JAX looks for NaN in whatever a compiled function returns."""
    with jax.debug_nans(True), closing(batching.batches(tiny_dataset.dataset(), config, 0)) as batches:
        state = optimisation.jitted_create_state(config)
        for step, batch in enumerate(batches):
            adversarial = step >= optimisation.first_adversarial_step(config)
            batch = jax.device_put(batch)
            state, _ = optimisation.jitted_train_step(state, batch, config=config, adversarial=adversarial)
    assert_finite(state)
