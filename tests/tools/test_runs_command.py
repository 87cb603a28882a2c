"""What a run folder records of its making, and the list of runs."""

import json
import subprocess

import numpy as np
import pytest
from support import tiny_dataset
from support.stopped_runs import without_network
from support.tiny_runs import L1_ONLY

from spnr_jax import cli
from spnr_jax.formats import data_sets
from spnr_jax.tools import runs_command
from spnr_jax.tools.runs_command import BARS, sparkline
from spnr_jax.training import metrics_log, run_record, trainer

SCHEDULE = trainer.Schedule(log_every=1, preview_every=2, checkpoint_every=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run that was stopped after two steps and went on, beside one without a preview and what is no run."""
    folder, dataset = tmp_path_factory.mktemp("runs"), tiny_dataset.dataset()
    with pytest.MonkeyPatch.context() as patch:
        without_network(patch)
        wanted = trainer.preview

        def stopping(*arguments):
            patch.setattr(trainer, "preview", wanted)
            raise KeyboardInterrupt("stopped")

        patch.setattr(trainer, "preview", lambda *_: ({"val_psnr": 11.0}, np.ones((2, 2, 3))))
        steps = L1_ONLY.num_steps
        trainer.train(L1_ONLY, dataset, folder / "a", SCHEDULE)
        patch.setattr(trainer, "preview", stopping)
        with pytest.raises(KeyboardInterrupt):
            trainer.train(L1_ONLY, dataset, folder / "deep" / "b", trainer.Schedule(log_every=1, preview_every=steps))
    (folder / "empty").mkdir()
    return folder


class TestRecord:
    def test_a_start_says_when_where_and_with_what_it_trained(self, folder):
        (entry,) = run_record.read_starts(folder / "a")
        assert (entry["first_step"], entry["last_step"]) == (0, L1_ONLY.num_steps)
        phases = {"restore", "compilation", "steps", "previews", "checkpoints", "listeners"}
        for spent in (entry["seconds"], entry["processor_seconds"]):
            assert set(spent) == phases
            assert all(seconds >= 0 for seconds in spent.values())
        assert entry["data_checksum"] == run_record.checksum(tiny_dataset.dataset())
        assert "cores" in entry["hardware"]

    def test_a_run_that_goes_on_keeps_what_earlier_starts_said(self, folder, tmp_path):
        dataset = tiny_dataset.dataset()
        clock = run_record.Clock()
        clock.lap("steps")
        for first in (0, 4):
            run_record.RunRecord(tmp_path, dataset, first).write(first + 4, clock)
        starts = run_record.read_starts(tmp_path)
        assert [(entry["first_step"], entry["last_step"]) for entry in starts] == [(0, 4), (4, 8)]

    @pytest.mark.parametrize("content", ["", "[]", '{"starts": 3}', '{"starts": [1]}', "[" * 100_000])
    def test_a_damaged_record_stops_nothing(self, content, tmp_path):
        (tmp_path / "run.json").write_text(content)
        assert run_record.read_starts(tmp_path) == []

    def test_laps_of_one_phase_add_up_and_leave_nothing_out(self, monkeypatch):
        times = iter([10.0, 11.0, 13.0, 17.0])
        monkeypatch.setattr(run_record.time, "monotonic", lambda: next(times))
        clock = run_record.Clock()
        assert [clock.lap(phase) for phase in ("steps", "previews", "steps")] == [1.0, 2.0, 4.0]
        assert clock.seconds == {"steps": 5.0, "previews": 2.0}

    def test_the_checksum_knows_settings_and_splits(self):
        dataset = tiny_dataset.dataset()
        others = [
            data_sets.Dataset(folder=dataset.folder, settings=dataset.settings | {"views": 99}, splits=dataset.splits),
            data_sets.Dataset(folder=dataset.folder, settings=dataset.settings, splits=dataset.splits | {"test": ()}),
        ]
        assert len({run_record.checksum(d) for d in (dataset, *others)}) == 3

    def test_a_changed_checkout_is_marked(self, tmp_path, monkeypatch):
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


class TestList:
    def test_runs_are_listed_best_first_and_those_without_a_preview_last(self, folder, capsys):
        cli.run_runs(cli.Runs(folder=folder))
        heads, first, second = capsys.readouterr().out.splitlines()
        assert heads.split()[:3] == ["run", "preset", "steps"]
        assert first.split()[0] == "a"
        assert f"{L1_ONLY.num_steps} of {L1_ONLY.num_steps}" in first
        assert "11.00" in first
        assert second.split()[0] == "deep/b"

    def test_a_run_itself_is_a_list_of_one(self, folder):
        (run,) = runs_command.read_runs(folder / "a")
        assert (run.name, run.best, run.best_step) == ("a", 11.0, 2)
        rows = metrics_log.read_rows(folder / "a")
        assert run.loss == [row["loss"] for row in rows if "loss" in row][-1]

    @pytest.mark.parametrize("name", ["empty", "none"])
    def test_a_folder_without_runs_is_refused(self, folder, name):
        with pytest.raises(ValueError, match=rf"{name}: (no run folders|there is no such folder)"):
            runs_command.read_runs(folder / name)

    def test_a_config_of_another_version_is_named(self, folder, tmp_path):
        (tmp_path / "config.json").write_text(json.dumps({"what": 1}))
        (tmp_path / "metrics.jsonl").write_text("")
        with pytest.raises(ValueError, match=r"config\.json"):
            runs_command.read_runs(tmp_path)


def test_a_sparkline_has_its_lowest_bar_at_the_lowest_value_and_averages_what_shares_a_bar():
    assert sparkline([1.0, 2.0, 3.0]) == BARS[0] + BARS[4] + BARS[7]
    assert sparkline([5.0, 5.0]) == BARS[0] * 2
    assert sparkline([0.0, 2.0, 4.0, 6.0], width=2) == BARS[0] + BARS[7]
    assert sparkline([]) == ""
    assert len(sparkline([0.5] * 1000)) == runs_command.CURVE
