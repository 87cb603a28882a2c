"""Budgets of Table 1: presets by size of the images, minutes as steps, and the time that a run took from its log."""

import dataclasses
import json
from itertools import chain

import pytest
from support import tiny_dataset
from support.tiny_baselines import BASELINE, SHRUNKEN

from experiments.comparison import budget as budgets
from spnr_jax import presets
from spnr_jax.training import batching, checkpoint, optimisation


@pytest.mark.parametrize(
    ("budget", "size", "category", "paper", "near_points"),
    [
        ("quick", 64, None, "tiny", "plus_tiny"),
        ("tiny", 64, "chair", "tiny", "plus_tiny"),
        ("paper", 128, None, "abo", "plus_abo"),
        ("paper", 200, "chair", "shapenet_chair", "plus_shapenet"),
        ("paper", 200, None, "shapenet_car", "plus_shapenet"),
    ],
)
def test_a_budget_has_a_preset_of_every_network(budget, size, category, paper, near_points):
    found = budgets.presets(budget, size, category)
    assert (found["paper"], found["near_points"]) == (paper, near_points)
    assert tuple(found) == budgets.NETWORKS
    assert set(found.values()) <= set(presets.PRESETS)


def test_the_paper_budget_names_the_sizes_that_it_needs():
    with pytest.raises(ValueError, match="--budget paper: the data's images have 64 pixels, the paper's 128"):
        budgets.presets("paper", 64, None)


def test_minutes_become_steps_at_the_pace_of_both_kinds_of_step(monkeypatch):
    monkeypatch.setattr(budgets, "step_seconds", lambda config, dataset, adversarial: 0.3 if adversarial else 0.1)
    half = dataclasses.replace(tiny_dataset.CONFIG, num_steps=10)  # the discriminator joins after half of the steps
    assert budgets.steps_within(60, half, None) == 300
    assert budgets.steps_within(60, BASELINE, None) == 600
    assert budgets.steps_within(0.01, BASELINE, None) == 1


def test_the_pace_leaves_out_the_step_that_compiles(monkeypatch):
    ticks = chain([100.0, 101.0, 103.0, 106.0], iter(lambda: 106.0, None))
    monkeypatch.setattr(budgets, "PACE_SECONDS", 5.0)
    monkeypatch.setattr(optimisation, "jitted_create_state", lambda config: "state")
    monkeypatch.setattr(optimisation, "jitted_train_step", lambda state, batch, **_: (state, 1.0))
    monkeypatch.setattr(batching, "batches", lambda *_: (i for i in range(9)))
    # asked at the third, fourth... step after the first: 101 and 103 are too early
    pace = budgets.step_seconds(BASELINE, None, adversarial=False, clock=lambda: next(ticks))
    assert pace == pytest.approx(6.0 / 5)


def test_a_run_that_was_begun_keeps_its_number_of_steps(tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "npbg_tiny", lambda: SHRUNKEN["npbg_tiny"])
    monkeypatch.setattr(budgets, "steps_within", lambda seconds, config, dataset: round(seconds))
    first = budgets.config_of("npbg_tiny", "tiny", 3, 2.0, None, tmp_path)
    assert (first.num_steps, first.seed, first.preset) == (120, 3, "npbg_tiny")
    checkpoint.write_config(tmp_path, first)
    monkeypatch.setattr(budgets, "steps_within", lambda *_: 7)
    assert budgets.config_of("npbg_tiny", "tiny", 3, 2.0, None, tmp_path) == first


def test_training_seconds_are_those_of_the_steps_over_all_calls(tmp_path):
    rows = [{"step": 20, "ms_per_step": 100.0}, {"step": 20, "val_psnr": 9.0}, {"step": 25, "ms_per_step": 1000.0}]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert budgets.training_seconds(tmp_path) == 7.0
