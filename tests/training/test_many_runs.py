"""Trainings side by side in one compiled step."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import optax
import pytest
from support import tiny_surfels
from support.laws import numbers
from support.tiny_training import BATCH, L1_ONLY, create, near, step

from experiments.speed.speed_scenes import random_crops
from spnr_jax.nn.convolution import run_by_run
from spnr_jax.training import many_runs, optimisation, shading

pytestmark = pytest.mark.ci  # it compiles steps of several runs


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


@pytest.mark.parametrize("axes", [(0, None), (None, 1), (0, 1)])
def test_what_is_computed_run_by_run_is_what_vmap_alone_computes(axes):
    def function(tree, factor):
        return {"sum": jnp.sum(tree["x"] * factor), "both": (tree["x"] + factor, factor)}

    tree, factor = {"x": numbers(1, 3, 4)}, numbers(2, 4, 3)
    of_runs = ({"x": tree["x"] if axes[0] == 0 else tree["x"][0]}, factor if axes[1] == 1 else factor[:, 0])
    mapped = jax.jit(jax.vmap(run_by_run(function), in_axes=axes))
    near(mapped(*of_runs), jax.vmap(function, in_axes=axes)(*of_runs))
    twice = jax.vmap(jax.vmap(run_by_run(function), in_axes=(None, 0)), in_axes=(0, None))
    near(twice(tree, factor.T), jax.vmap(jax.vmap(function, in_axes=(None, 0)), in_axes=(0, None))(tree, factor.T))


def test_runs_of_the_surfel_network_in_one_step_are_the_loop_over_them():
    config = tiny_surfels.CONFIG
    crops = [random_crops(config, 1, seed) for seed in (0, 1)]
    states = [optimisation.jitted_create_state(config, jnp.uint32(seed)) for seed in (3, 4)]
    step = partial(shading.train_step, config=config)
    axes = many_runs.AXES
    mapped = jax.jit(jax.vmap(step, in_axes=(axes, 0), out_axes=(axes, 0)))
    after, metrics = mapped(many_runs.stack(states), jax.tree.map(lambda *x: jnp.stack(x), *crops))
    for i, (state, crop) in enumerate(zip(states, crops, strict=True)):
        alone, alone_metrics = jax.jit(step)(state, crop)
        moments, alone_moments = (optax.tree.get(of.generator_optimizer, "mu") for of in (after, alone))
        near(jax.tree.map(lambda x, i=i: x[i], (metrics, moments)), (alone_metrics, alone_moments))
