"""Training with settings and batches that nobody meant stays finite."""

from contextlib import closing
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset
from support.tiny_baselines import SHRUNKEN
from support.tiny_training import BATCH

from spnr_jax.config import LossConfig, OptimizerConfig
from spnr_jax.training import batching, optimisation

pytestmark = pytest.mark.ci  # it trains several networks

TAME = replace(
    tiny_dataset.CONFIG,
    loss=LossConfig(discriminator_width=4, r1_interval=2),
    optimizer=OptimizerConfig(lr_generator=2e-3, warmup_steps=2),
    num_steps=20,
)


WILD = replace(  # rates a hundred times too high, both losses weighted with a million
    TAME,
    optimizer=replace(TAME.optimizer, lr_generator=0.2, lr_discriminator=0.02),
    loss=replace(TAME.loss, l1_weight=1e6, adversarial_weight=1e6),
)


def assert_finite(tree):
    """No number of the tree is NaN or infinite; the message names its place."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


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


@pytest.mark.parametrize("name", BATCHES)
def test_both_networks_stay_finite_in_twenty_steps_on(name):
    state, batch = optimisation.jitted_create_state(WILD), BATCHES[name](BATCH)
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
