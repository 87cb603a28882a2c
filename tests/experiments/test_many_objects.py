"""Many runs in one program are the single runs: states, batches, losses."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import pytest
from support import tiny_dataset
from support.laws import same_bits
from support.tiny_baselines import SHRUNKEN

from experiments.studies import many_objects
from spnr_jax import cli, presets
from spnr_jax.formats import data_sets
from spnr_jax.training import batching

SEEDS = (3, 4, 5)
QUICK = dataclasses.replace(SHRUNKEN["points2nerf_tiny"], num_steps=3)  # no convolutions: compiles in a second


def test_the_batches_of_a_run_are_those_that_it_would_see_alone():
    dataset = tiny_dataset.dataset()
    together = list(many_objects.batches(dataset, QUICK, SEEDS))[2]
    for i, seed in enumerate(SEEDS):
        alone = next(batching.batches(dataset, dataclasses.replace(QUICK, seed=seed), 2))
        same_bits(jax.tree.map(lambda x, i=i: x[i], together), jax.tree.map(jnp.asarray, alone))


def test_a_run_that_is_fitted_to_an_object_sees_it_alone():
    dataset = tiny_dataset.dataset()
    names = dataset.splits["test"][:2]
    first = next(many_objects.batches(dataset, QUICK, [0, 0], names))
    for i, name in enumerate(names):
        objects = [data_sets.read_object(dataset, name)] * QUICK.batch_objects
        same_bits(
            jax.tree.map(lambda x, i=i: x[i], first), jax.tree.map(jnp.asarray, batching.make_batch(objects, QUICK, 0))
        )


def test_clouds_of_many_sizes_are_the_first_points_of_objects():
    clouds = many_objects.clouds_of_many_sizes(tiny_dataset.dataset(), 12)
    sizes = sorted(len(cloud.positions) for cloud in clouds)
    assert len(clouds) == 12
    assert sizes[0] == 2
    assert sizes[-1] == tiny_dataset.POINTS
    assert len(set(sizes)) > 6


@pytest.mark.ci
def test_runs_and_objects_in_one_program_are_the_single_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)
    monkeypatch.setitem(presets.PRESETS, "tiny", lambda: QUICK)
    counts = {"runs": 2, "steps": 3, "objects": 2, "encoded": 3}
    many_objects.main(many_objects.ManyObjects(data=tiny_dataset.dataset().folder, out=tmp_path, **counts))
    found = json.loads((tmp_path / "results.json").read_text())
    assert max(found["train"]["apart"]) < 1e-4
    assert max(found["fit"]["apart"]) < 1e-4
    assert max(found["render"]["apart"]) < 1e-4
    assert all(mb > 0 for part in ("train", "fit", "render", "encode") for mb in found[part]["mb"].values())
    loop, largest, groups = found["encode"]["padding"].values()
    assert loop == groups
    assert largest >= loop > 1
    assert {len(seconds) for seconds in found["encode"]["seconds"].values()} == {4}
    assert {len(seconds) for seconds in found["train"]["seconds"].values()} == {2}, "without the step that compiles"
