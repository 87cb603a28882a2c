"""The measurement of the loader counts waiting as waiting, for both forms, and leaves out what does not fit."""

import dataclasses
import json
import shutil
import time

import pytest
from support import tiny_dataset

from data_gen.store import layout
from experiments.speed import loading
from spnr_jax import presets
from spnr_jax.formats import data_sets
from spnr_jax.training import batching


@pytest.fixture
def folder(tmp_path):
    target = shutil.copytree(tiny_dataset.dataset().folder, tmp_path / "data")
    layout.write_text(target / "dataset.json", layout.json_text({"schema_version": layout.SCHEMA_VERSION}))
    layout.write_text(target / "rejected.jsonl", "")
    return target


@pytest.fixture
def quick(monkeypatch):
    """A train step that takes 20 ms, and a preset that fits the tests' data set."""
    monkeypatch.setattr(loading.cli, "set_up_jax", lambda **_: None)
    monkeypatch.setattr(loading.optimisation, "jitted_create_state", lambda settings: 0)
    monkeypatch.setattr(loading.optimisation, "jitted_train_step", lambda *_, **__: time.sleep(0.02) or (0, {}))
    monkeypatch.setitem(presets.PRESETS, "tiny", lambda: tiny_dataset.CONFIG)


def test_both_forms_are_measured_and_a_preset_of_another_size_is_left_out(folder, quick, tmp_path, capsys):
    loading.main(loading.Loading(dataset=folder, out=tmp_path / "out", steps=3, batches=5, presets=("tiny", "small")))
    rows = json.loads((tmp_path / "out/24/results.json").read_text())["rows"]
    assert [(row["preset"], row["form"]) for row in rows] == [("tiny", "folder"), ("tiny", "packed")]
    assert all(row["ms_per_step"] >= 20 and 0 <= row["waiting"] < 1 for row in rows)
    printed = capsys.readouterr().out
    assert "small left out: it needs images of 128 px, these have 24" in printed


def test_a_slow_reader_is_seen_as_waiting(folder, quick, monkeypatch):
    read = data_sets.read_object
    monkeypatch.setattr(data_sets, "read_object", lambda *a: time.sleep(0.1) or read(*a))
    count = 4 * batching.READ_AHEAD  # what is read ahead while a busy machine begins must not be all of it
    config = dataclasses.replace(presets.PRESETS["tiny"](), num_steps=2 * count)
    waits, steps = loading.time_steps(data_sets.open_dataset(folder), config, count)
    assert len(waits) == len(steps) == count
    assert 0.5 < sum(waits) / sum(steps) < 1


def test_no_preset_that_fits_is_an_error(folder, quick, tmp_path):
    with pytest.raises(ValueError, match="no preset of small has images of 24 px"):
        loading.main(loading.Loading(dataset=folder, out=tmp_path / "out", presets=("small",)))
