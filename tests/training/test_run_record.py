"""What a run folder records of its making."""

import subprocess

import numpy as np
import pytest
from support import tiny_dataset
from support.stopped_runs import without_network
from support.tiny_runs import L1_ONLY

from spnr_jax.formats import data_sets
from spnr_jax.training import run_record, trainer

SCHEDULE = trainer.Schedule(log_every=1, preview_every=2, checkpoint_every=2)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run."""
    folder = tmp_path_factory.mktemp("runs") / "a"
    with pytest.MonkeyPatch.context() as patch:
        without_network(patch)
        patch.setattr(trainer, "preview", lambda *_: ({"val_psnr": 11.0}, np.ones((2, 2, 3))))
        trainer.train(L1_ONLY, tiny_dataset.dataset(), folder, SCHEDULE)
    return folder


def test_a_start_says_when_where_and_with_what_it_trained(run):
    (entry,) = run_record.read_starts(run)
    assert (entry["first_step"], entry["last_step"]) == (0, L1_ONLY.num_steps)
    phases = {"restore", "compilation", "steps", "previews", "checkpoints", "listeners"}
    for spent in (entry["seconds"], entry["processor_seconds"]):
        assert set(spent) == phases
        assert all(seconds >= 0 for seconds in spent.values())
    assert entry["data_checksum"] == run_record.checksum(tiny_dataset.dataset())
    assert "cores" in entry["hardware"]


def test_a_run_that_goes_on_keeps_what_earlier_starts_said(tmp_path):
    dataset = tiny_dataset.dataset()
    clock = run_record.Clock()
    clock.lap("steps")
    for first in (0, 4):
        run_record.RunRecord(tmp_path, dataset, first).write(first + 4, clock)
    starts = run_record.read_starts(tmp_path)
    assert [(entry["first_step"], entry["last_step"]) for entry in starts] == [(0, 4), (4, 8)]


@pytest.mark.parametrize("content", ["", "[]", '{"starts": 3}', '{"starts": [1]}', "[" * 100_000])
def test_a_damaged_record_stops_nothing(content, tmp_path):
    (tmp_path / "run.json").write_text(content)
    assert run_record.read_starts(tmp_path) == []


def test_laps_of_one_phase_add_up_and_leave_nothing_out(monkeypatch):
    times = iter([10.0, 11.0, 13.0, 17.0])
    monkeypatch.setattr(run_record.time, "monotonic", lambda: next(times))
    clock = run_record.Clock()
    assert [clock.lap(phase) for phase in ("steps", "previews", "steps")] == [1.0, 2.0, 4.0]
    assert clock.seconds == {"steps": 5.0, "previews": 2.0}


def test_the_checksum_knows_settings_and_splits():
    dataset = tiny_dataset.dataset()
    others = [
        data_sets.Dataset(folder=dataset.folder, settings=dataset.settings | {"views": 99}, splits=dataset.splits),
        data_sets.Dataset(folder=dataset.folder, settings=dataset.settings, splits=dataset.splits | {"test": ()}),
    ]
    assert len({run_record.checksum(d) for d in (dataset, *others)}) == 3


def test_a_changed_checkout_is_marked(tmp_path, monkeypatch):
    def git(*arguments):
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True, capture_output=True)

    package = tmp_path / "package"
    package.mkdir()
    monkeypatch.setattr(run_record, "__file__", str(package / "x.py"))
    assert run_record.commit() is None
    (package / "x.py").write_text("1")
    git("init")
    git("add", ".")
    git("-c", "user.name=a", "-c", "user.email=a@b", "commit", "-m", "a")
    clean = run_record.commit()
    (package / "x.py").write_text("2")
    assert len(clean) == 40
    assert run_record.commit() == clean + "+"


def test_the_record_of_a_training_tells_its_objects_from_others(run):
    dataset = tiny_dataset.dataset()
    assert run_record.seen_in_training(run, dataset, dataset.splits["train"]) is True
    assert run_record.seen_in_training(run, dataset, dataset.splits["test"]) is False
