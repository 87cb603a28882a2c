"""Killed, stopped, without room or meddled with: a training loses nothing, and says in one line what is wrong.

A few kills of real processes here; `make chaos` makes a hundred, and all other faults.
"""

import dataclasses
import errno
import json
import shutil

import jax.numpy as jnp
import pytest
import tiny_dataset
from tiny_dataset import CONFIG

from experiments import chaos, chaos_child, chaos_faults, chaos_kills, chaos_report
from experiments.chaos_child import Ended, Event
from spnr_jax import checkpoint, cli, trainer


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A training that was killed three times, beside one that was not."""
    folder = tmp_path_factory.mktemp("chaos")
    chaos.main(chaos.Chaos(out=folder, kills=3, data=tiny_dataset.dataset().folder, faults=False))
    return folder


def ended(*batches, code=0):
    events = [Event(float(step), "step", step, batch) for step, batch in enumerate(batches, start=1)]
    return Ended(events=events, code=code, output="", seconds=1.0, seconds_to_end=None)


@pytest.mark.ci
def test_a_training_that_was_killed_ends_with_the_same_bits_data_and_rows(out):
    results = json.loads((out / "results.json").read_text())
    assert results["ended"] == 0
    assert all(results["same"].values()), results["same"]
    assert len(results["kills"]) == 3
    assert any(kill["begun"] > 0 for kill in results["kills"]) or results["last begun"] > 0
    assert {"optimiser state", "data of every step", "metrics file, row by row"} < set(results["same"])
    assert (out / "chaos.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "chaos.md").read_text().startswith("3 of 3 faults survived (3 kills, 0 others).")
    assert len((out / "kills.csv").read_text().splitlines()) == 4


@pytest.mark.ci
def test_kills_that_were_made_are_only_read(out, capsys):
    begin = (out / "kills.json").stat().st_mtime_ns
    chaos.main(chaos.Chaos(out=out, kills=3, data=tiny_dataset.dataset().folder, faults=False))
    assert (out / "kills.json").stat().st_mtime_ns == begin
    assert capsys.readouterr().out == "3 of 3 faults survived (3 kills, 0 others)\n"


@pytest.mark.ci
def test_a_doubled_row_a_missing_row_another_batch_and_another_state_are_seen(out, tmp_path):
    whole, run = out / "whole", shutil.copytree(out / "killed", tmp_path / "run")
    one = ended("a", "b")
    assert all(chaos_kills.compare(run, whole, [one, one], one).values())
    assert not chaos_kills.compare(run, whole, [one, ended("a", "c")], one)["data of every step"]
    assert not chaos_kills.compare(run, whole, [ended("a")], one)["data of every step"]
    log = run / "metrics.jsonl"
    rows = log.read_text().splitlines(keepends=True)
    for wrong in (rows[:3] + rows[2:], rows[:2] + rows[3:]):
        log.write_text("".join(wrong))
        assert not chaos_kills.compare(run, whole, [one], one)["metrics file, row by row"]
    config, state = checkpoint.load_run(run)
    for name, what in (("generator", "parameters and statistics"), ("generator_optimizer", "optimiser state")):
        other = dataclasses.replace(state, **{name: state.discriminator})
        assert chaos_kills.same(state, other, {"averaged"}), what
        assert not chaos_kills.same(state, other, {name}), what


def test_a_second_training_in_one_folder_is_refused_until_the_first_is_over(tmp_path):
    with (
        checkpoint.alone(tmp_path / "run"),
        pytest.raises(ValueError, match="another process trains in this folder"),
        checkpoint.alone(tmp_path / "run"),
    ):
        pass
    with checkpoint.alone(tmp_path / "run"):
        pass


def test_training_holds_the_folder(tmp_path, capsys):
    with checkpoint.alone(tmp_path):
        code = cli.guarded(
            lambda: trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE), "spnr"
        )
    assert code == 2
    assert capsys.readouterr().err.startswith(f"spnr: {tmp_path}: another process trains")
    assert not (tmp_path / "config.json").exists()


@pytest.mark.ci
def test_a_checkpoint_of_another_version_is_refused_and_kept(out, tmp_path):
    from orbax.checkpoint import v1 as ocp

    run = shutil.copytree(out / "whole", tmp_path / "run")
    with ocp.training.Checkpointer(run / "checkpoints") as checkpointer:
        checkpointer.save(1000, {"weights": jnp.zeros(3)})
    with pytest.raises(ValueError, match="checkpoints/1000 is of another version of spnr_jax: .* go on with that"):
        checkpoint.load_run(run)
    assert (run / "checkpoints" / "1000").is_dir()


@pytest.mark.ci
def test_a_checkpoint_that_cannot_be_written_is_one_line_with_the_disks_reason(out, tmp_path):
    _, state = checkpoint.load_run(out / "whole")
    (tmp_path / "checkpoints").write_text("a file where the folder should be")
    with pytest.raises(ValueError, match=r"checkpoints/40 cannot be written \(.*\); the one before is kept") as error:
        checkpoint.save(tmp_path, state)
    assert "\n" not in str(error.value)


def test_a_write_that_does_not_say_where_is_given_the_run_folder(tmp_path, monkeypatch, capsys):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(trainer, "_train", full)
    assert (
        cli.guarded(lambda: trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE), "spnr") == 2
    )
    assert capsys.readouterr().err == f"spnr: {tmp_path}: No space left on device\n"


def test_a_kill_aims_at_its_phase_from_its_step_on():
    aim = chaos_kills.aim_at("log", 7.5, 0.25)
    assert aim(Event(0.0, "step", 8)) is None
    assert aim(Event(0.0, "log", 7)) is None
    assert aim(Event(0.0, "log", 8)) == 0.25
    assert chaos_kills.aim_at("start", 7.5, 0.5)(Event(0.0, "start", 0)) == 0.5


def test_a_phase_lasts_as_long_as_its_median_until_the_next_event():
    events = [Event(t, phase, 0) for t, phase in ((0, "start"), (9, "log"), (10, "step"), (12, "log"), (17, "step"))]
    assert chaos_kills.durations(events) == {"start": 9, "log": 3, "step": 2}


def made_up(**changes):
    kills = [
        chaos_kills.Kill(
            number=i + 1,
            aimed="step",
            phase=phase,
            begun=8 * i,
            step=8 * i + 9,
            unfinished=False,
            doomed_rows=2,
            seconds=1,
        )
        for i, phase in enumerate(("step", "log"))
    ]
    fault = chaos_faults.Fault(name="flood", verdict="survived", code=2, line="spnr: wet | cold", note="", seconds=3)
    return {
        "kills": [dataclasses.asdict(kill) for kill in kills],
        "faults": [dataclasses.asdict(fault)],
        "same": {"config": True},
        "ended": 0,
        "last begun": 16,
        "steps": 40,
        "checkpoint_every": 8,
        "log_every": 2,
        "seed": 0,
        "seconds": 60,
        "hardware": "2 cores",
    } | changes


def test_the_verdict_counts_kills_together_and_leaves_out_what_was_skipped():
    assert chaos_report.verdict(made_up()) == ("3 of 3 faults survived (2 kills, 1 others)", True)
    assert chaos_report.verdict(made_up(same={"config": False})) == (
        "1 of 3 faults survived (2 kills, 1 others)",
        False,
    )
    assert chaos_report.verdict(made_up(ended=2))[0].startswith("1 of 3")
    fault = made_up()["faults"][0]
    lost = made_up(faults=[fault | {"verdict": "LOST"}, fault | {"verdict": "skipped"}])
    assert chaos_report.verdict(lost) == ("2 of 3 faults survived (2 kills, 1 others, 1 skipped)", False)


def test_the_table_says_where_kills_fell_and_what_they_cost():
    text = chaos_report.table(made_up())
    assert "| step | 1 | 2 | 0 | 2 | 1 |" in text
    assert "| log | 1 | 0 | 0 | 2 | 1 |" in text
    assert "| flood | survived | 2 | spnr: wet / cold | 3 |" in text


def test_no_kills_are_refused(tmp_path):
    with pytest.raises(ValueError, match="--kills: expected 1 or more, got 0"):
        chaos.Chaos(out=tmp_path, kills=0)


@pytest.mark.ci
def test_a_training_of_which_something_is_lost_ends_with_an_error(out, monkeypatch):
    monkeypatch.setattr(chaos_report, "verdict", lambda results: ("2 of 3 faults survived", False))
    with pytest.raises(ValueError, match=r"something was lost; .*chaos\.md says what"):
        chaos.main(chaos.Chaos(out=out, kills=3, data=tiny_dataset.dataset().folder, faults=False))


@pytest.mark.slow
@pytest.mark.parametrize("name", chaos_faults.FAULTS)
def test_a_fault_is_one_line_and_its_exit_code_and_the_next_call_makes_up_for_it(name, out, tmp_path):
    training_of_out = chaos_kills.Training(
        data=tiny_dataset.dataset().folder, num_steps=chaos_kills.FEWEST_STEPS, cache=out / "compiled"
    )
    (fault,) = chaos_faults.survived(training_of_out, tmp_path / "faults", out / "whole", (name,))
    assert fault.verdict in ("survived", "skipped"), fault


def test_a_process_that_says_nothing_more_is_ended_and_named(monkeypatch, tmp_path):
    monkeypatch.setattr(chaos_child, "LIMIT", 0.0)
    with pytest.raises(ValueError, match="the training hung for 0 s after"):
        chaos_child.run(["train", "nowhere", str(tmp_path)], tmp_path, tmp_path / "said.txt")
