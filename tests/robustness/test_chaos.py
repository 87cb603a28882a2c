"""Killed, stopped, without room or meddled with: a training loses nothing, and says in one line what is wrong.

    make chaos        100 kills and all faults, with a table

One training is killed at random moments of random phases, again and again, and has to end with the bits, the batches
and the rows of one that was left alone.  Each of FAULTS happens to a copy of a run that lacks its last steps; it says
with which code and line the command has to end.  The same command, called again once the fault is mended, has to make
up for it.  A full disk is a real one, in a mount namespace of its own (`unshare`).
"""

import errno
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from killable import (
    CHECKPOINT_EVERY,
    QUICK_COMPILATION,
    Training,
    batches,
    checkpoint_steps,
    different,
    rows,
)
from orbax.checkpoint import v1 as ocp
from support import tiny_dataset
from support.tiny_dataset import CONFIG

from spnr_jax import cli
from spnr_jax.training import checkpoint, trainer

KILLS = int(os.environ.get("CHAOS_KILLS", "1"))  # of each phase
STEPS = max(40, 4 * KILLS)
PHASES = ("start", "step", "row", "checkpoint")


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """(training, run folder, how it ended) of a training that nothing happened to, its programs compiled before."""
    folder = tmp_path_factory.mktemp("chaos")
    training = Training(data=tiny_dataset.dataset().folder, num_steps=STEPS, cache=folder / "compiled")
    first, second = (training.run(folder / name) for name in ("compiling", "whole"))
    assert first.code == second.code == 0, first.output + second.output
    assert not different(folder / "compiling", folder / "whole"), "the same command, the same bits"
    return training, folder / "whole", second


def seconds_of(events, phase):
    """Median duration of a phase."""
    return float(
        np.median([after.seconds - event.seconds for event, after in pairwise(events) if event.phase == phase])
    )


@pytest.mark.ci
def test_a_training_that_was_killed_ends_with_the_same_bits_data_and_rows(alone, tmp_path):
    training, whole, reference = alone
    rng, run, trials = np.random.default_rng(0), tmp_path / "killed", []
    phases, unfinished, again = rng.permutation(PHASES * KILLS), 0, 0
    for phase, moment in zip(phases, np.sort(rng.uniform(0, STEPS - CHECKPOINT_EVERY, len(phases))), strict=True):
        delay = rng.uniform(0, seconds_of(reference.events, phase))
        due = lambda event, phase=phase, delay=delay, moment=moment: (  # noqa: E731
            delay if event.phase == phase and (phase == "start" or event.step >= moment) else None
        )
        trials.append(training.run(run, aim=due))
        assert trials[-1].code == -9, f"the kill came too late: {trials[-1].output}"
        newest = (checkpoint_steps(run) or [0])[0]
        unfinished += any(not path.name.isdigit() for path in (run / "checkpoints").glob("*"))
        again += trials[-1].events[-1].step - newest if trials[-1].events[-1].step else 0
    trials.append(training.run(run))
    assert trials[-1].code == 0, trials[-1].output
    assert not different(run, whole)
    assert batches(*trials) == batches(reference)
    assert rows(run) == rows(whole)
    print(f"\n{len(phases)} kills, {unfinished} with half a checkpoint, {again} steps trained again", end="")


GRACE = 30.0  # seconds that schedulers give after SIGTERM: Slurm's KillWait, Kubernetes' grace period
SKIPPED = 99
UNSHARED = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
# $1 the run, of which a copy is trained, $2 the folder to mount on; then the command
FULL = """mount -t tmpfs -o size=64m none "$2" && cp -a "$1/." "$2" || exit 99
used=$(du -sk "$2" | cut -f1) && mount -o remount,size=$((used + 200))k "$2" || exit 99
before="$1" mounted="$2"; shift 2; "$@"; code=$?; cp -a "$mounted/." "$before"; exit $code"""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Exit code and output of the faulty call, and whether the metrics file may hold a row more."""

    code: int
    output: str
    more_rows: bool = False


Inject = Callable[[Training, Path], Seen]  # does the fault to a run, calls the command, and mends what it broke


def called(training: Training, run: Path) -> Seen:
    """What the command makes of a run."""
    ended = training.run(run)
    return Seen(code=ended.code, output=ended.output)


def stopped_by(number: signal.Signals, phase: str) -> Inject:
    """A signal in a step, or while a checkpoint is written that is not the last."""

    def inject(training: Training, run: Path) -> Seen:
        newest = checkpoint_steps(run)[0]
        if phase == "checkpoint":
            shutil.rmtree(run / "checkpoints" / str(newest))
        step, before = newest if phase == "checkpoint" else newest + CHECKPOINT_EVERY // 2, checkpoint_steps(run)
        aim = lambda event: 0.0 if event.phase == phase and event.step >= step else None  # noqa: E731
        ended = training.run(run, aim=aim, number=number)
        good = ended.seconds_to_end < GRACE and checkpoint_steps(run) > before
        return Seen(code=ended.code if good else -1, output=ended.output, more_rows=True)

    return inject


def full_disk(training: Training, run: Path) -> Seen:
    """A disk with 200 kB of room."""
    if shutil.which("unshare") is None:
        return Seen(code=SKIPPED, output="")
    mounted = run.with_name(f"{run.name}-mounted")
    mounted.mkdir()
    command = [sys.executable, "-m", "spnr_jax.cli", *training.arguments(mounted)]
    environment = {"XLA_FLAGS": QUICK_COMPILATION} | os.environ | {"JAX_COMPILATION_CACHE_DIR": str(training.cache)}
    shell = [*UNSHARED, FULL, "sh", str(run), str(mounted), *command]
    done = subprocess.run(shell, capture_output=True, text=True, env=environment)
    refused = done.returncode == 1 and "unshare" in done.stderr
    return Seen(code=SKIPPED if refused else done.returncode, output=done.stdout + done.stderr)


def cut_log(training: Training, run: Path) -> Seen:
    """A metrics file that ends in the middle of a row, as a power cut leaves it."""
    path = run / "metrics.jsonl"
    path.write_bytes(path.read_bytes()[:-40])
    return called(training, run)


def other_version(training: Training, run: Path) -> Seen:
    """A newest checkpoint that holds other arrays than a state of this version; it has to be kept."""
    strange = run / "checkpoints" / str(training.num_steps - 1)
    with ocp.training.Checkpointer((run / "checkpoints").absolute()) as checkpointer:
        checkpointer.save(int(strange.name), {"weights": np.zeros(3)})
    seen = called(training, run)
    kept = strange.is_dir()
    shutil.rmtree(strange, ignore_errors=True)
    return seen if kept else replace(seen, code=-1)


STOPPED = r"spnr: stopped at step \d+ of \d+; the same command goes on"
FAULTS: dict[str, tuple[Inject, int, str]] = {  # exit code and line to be seen
    "SIGTERM in a step": (stopped_by(signal.SIGTERM, "step"), 130, STOPPED),
    "Ctrl-C while a checkpoint is written": (stopped_by(signal.SIGINT, "checkpoint"), 130, STOPPED),
    "disk full at a checkpoint": (full_disk, 2, "spnr: checkpoint .* cannot be written .No space left"),
    "metrics file cut off in a row": (cut_log, 0, "trained"),
    "checkpoint of another version": (other_version, 2, "spnr: checkpoint .* is of another version"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_one_line_and_its_exit_code_and_the_next_call_makes_up_for_it(name, alone, tmp_path):
    training, whole, _ = alone
    inject, code, words = FAULTS[name]
    run = shutil.copytree(whole, tmp_path / "run")
    shutil.rmtree(run / "checkpoints" / str(training.num_steps))
    seen = inject(training, run)
    if seen.code == SKIPPED:
        pytest.skip("no mounts allowed here")
    lines = [line.strip() for line in re.split(r"[\r\n]+", seen.output) if re.search(words, line)]
    assert (seen.code, len(lines)) == (code, 1), seen.output
    assert "Traceback" not in seen.output
    assert training.run(run).code == 0
    assert not different(run, whole)
    steps, wanted = ([row["step"] for row in rows(x) if "loss" in row] for x in (run, whole))
    if seen.more_rows:  # a stop writes a row of its own
        assert steps == sorted(set(steps))
        assert set(wanted) <= set(steps)
    else:
        assert rows(run) == rows(whole)
    print(f"\n{name}: exit code {seen.code}, {lines[0]}", end="")


def test_a_second_training_in_one_folder_is_refused_until_the_first_is_over(tmp_path, capsys):
    with checkpoint.alone(tmp_path):
        code = cli.guard(lambda: trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE), "spnr")
    assert code == 2
    assert capsys.readouterr().err.startswith(f"spnr: {tmp_path}: another process trains in this folder")
    assert not (tmp_path / "config.json").exists()
    with checkpoint.alone(tmp_path):
        pass


@pytest.mark.ci
def test_a_checkpoint_that_cannot_be_written_is_one_line_with_the_disks_reason(alone, tmp_path):
    _, state = checkpoint.load_run(alone[1])
    (tmp_path / "checkpoints").write_text("a file where the folder should be")
    with pytest.raises(ValueError, match=r"checkpoints/40 cannot be written \(.*\); the one before is kept") as error:
        checkpoint.save(tmp_path, state)
    assert "\n" not in str(error.value)


def test_a_write_that_does_not_say_where_is_given_the_run_folder(tmp_path, monkeypatch, capsys):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(trainer, "restore_or_init", full)
    work = lambda: trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE)  # noqa: E731
    assert cli.guard(work, "spnr") == 2
    assert capsys.readouterr().err == f"spnr: {tmp_path}: No space left on device\n"
