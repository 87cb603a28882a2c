"""Trainings side by side in one compiled step."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from support.laws import numbers
from support.tiny_training import BATCH, L1_ONLY, create, near, step

from spnr_jax.training import many_runs


def test_runs_in_one_compiled_step_are_the_loop_over_runs():
    """Seeds, and learning rates as factors: what a run moves by is the factor times what it would move by alone."""

    fresh = create(L1_ONLY)

    def varied(seed):
        generator = jax.tree.map(lambda x: x + 0.1 * numbers(seed, *x.shape), fresh.generator)
        return dataclasses.replace(fresh, generator=generator, key=jax.random.key(seed))

    states, scales = [varied(seed) for seed in (3, 4)], jnp.array([1.0, 0.25])
    stacked, batches = many_runs.stack(states), jax.tree.map(lambda x: jnp.stack([x, x]), BATCH)
    mapped = jax.jit(many_runs.train_step, static_argnames=("config", "adversarial"))
    after, metrics = mapped(stacked, batches, scales, config=L1_ONLY, adversarial=False)
    together = (
        metrics,
        after.batch_stats,
        after.generator_optimizer[0].mu,
    )  # Adam's first step hides sizes, mu shows them
    for i, state in enumerate(states):
        alone, alone_metrics = step(state, L1_ONLY)
        expected = alone_metrics, alone.batch_stats, alone.generator_optimizer[0].mu
        near(jax.tree.map(lambda x, i=i: x[i], together), expected)
        moved, alone_moved = (
            sum(float(jnp.sum(jnp.abs(x - y))) for x, y in zip(*map(jax.tree.leaves, pair), strict=True))
            for pair in (
                (jax.tree.map(lambda x, i=i: x[i], after.generator), state.generator),
                (alone.generator, state.generator),
            )
        )
        assert moved == pytest.approx(float(scales[i]) * alone_moved, rel=1e-2)
