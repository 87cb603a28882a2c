"""What else can happen to a training: signals, disks, damaged files, a second trainer.

A fault happens to a run that lacks its last steps.  FAULTS says with which code and one line the command has to end.
Full and read-only disks are real ones, in a mount namespace of their own (`unshare`): a small tmpfs, a read-only mount.
"""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from killable import CHECKPOINT_EVERY, QUICK_COMPILATION, Ended, Training, checkpoint_steps
from orbax.checkpoint import v1 as ocp

from spnr_jax.formats import data_sets

GRACE = 30.0  # seconds that schedulers give after SIGTERM: Slurm's KillWait, Kubernetes' grace period
SKIPPED = 99
UNSHARED = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
# $1 the run to copy, $2 the folder to mount on, $3 where to copy what is left, $4 kB of room; then the command
FULL = """mount -t tmpfs -o size=64m none "$2" && cp -a "$1/." "$2" || exit 99
used=$(du -sk "$2" | cut -f1) && mount -o remount,size=$((used + $4))k "$2" || exit 99
before="$3" mounted="$2"; shift 4; "$@"; code=$?; cp -a "$mounted/." "$before"; exit $code"""
READ_ONLY = """mount --bind "$2" "$2" && mount -o remount,bind,ro "$2" || exit 99
shift 4; exec "$@" """


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


def on_disk(script: str, room: int) -> Inject:
    """A disk with so many kB of room, or one that cannot be written."""

    def inject(training: Training, run: Path) -> Seen:
        if shutil.which("unshare") is None:
            return Seen(code=SKIPPED, output="")
        mounted = run.with_name(f"{run.name}-mounted") if script is FULL else run
        mounted.mkdir(exist_ok=True)
        command = [sys.executable, "-m", "spnr_jax.cli", *training.arguments(mounted)]
        environment = {"XLA_FLAGS": QUICK_COMPILATION} | os.environ | {"JAX_COMPILATION_CACHE_DIR": str(training.cache)}
        done = subprocess.run(
            [*UNSHARED, script, "sh", str(run), str(mounted), str(run), str(room), *command],
            capture_output=True,
            text=True,
            env=environment,
        )
        refused = done.returncode == 1 and "unshare" in done.stderr
        return Seen(code=SKIPPED if refused else done.returncode, output=done.stdout + done.stderr)

    return inject


def damaged(change: Callable[[bytes], bytes]) -> Inject:
    """The newest checkpoint, each of its files changed."""

    def inject(training: Training, run: Path) -> Seen:
        for path in (run / "checkpoints" / str(checkpoint_steps(run)[0])).rglob("*"):
            if path.is_file():
                path.write_bytes(change(path.read_bytes()))
        return called(training, run)

    return inject


def cut_log(training: Training, run: Path) -> Seen:
    """A metrics file that ends in the middle of a row, as a power cut leaves it."""
    path = run / "metrics.jsonl"
    path.write_bytes(path.read_bytes()[:-40])
    return called(training, run)


def lost_picture(training: Training, run: Path) -> Seen:
    """A picture of each object that was deleted from the data set."""
    folder = run.with_name(f"{run.name}-data")
    shutil.copytree(training.data, folder)
    for name in data_sets.open_dataset(folder).splits["train"]:
        (folder / "objects" / name / "images" / "001.png").unlink()
    return called(replace(training, data=folder), run)


def other_version(training: Training, run: Path) -> Seen:
    """A newest checkpoint that holds other arrays than a state of this version; it has to be kept."""
    strange = run / "checkpoints" / str(training.num_steps - 1)
    with ocp.training.Checkpointer((run / "checkpoints").absolute()) as checkpointer:
        checkpointer.save(int(strange.name), {"weights": np.zeros(3)})
    seen = called(training, run)
    kept = strange.is_dir()
    shutil.rmtree(strange, ignore_errors=True)
    return seen if kept else replace(seen, code=-1)


def other_config(training: Training, run: Path) -> Seen:
    """A config with an entry that this version does not know."""
    path = run / "config.json"
    mine = path.read_text()
    path.write_text(mine.replace("{", '{"from_the_future": 1, ', 1))
    seen = called(training, run)
    path.write_text(mine)
    return seen


def two_trainers(training: Training, run: Path) -> Seen:
    """A second process that trains in the same folder while the first is in its steps."""
    second: list[Ended] = []

    def start_second(event) -> None:
        if event.phase == "step" and not second:
            second.append(training.run(run))

    first = training.run(run, aim=start_second)
    return Seen(code=second[0].code if first.code == 0 else -1, output=second[0].output)


STOPPED = r"spnr: stopped at step \d+ of \d+; the same command goes on"
FAULTS: dict[str, tuple[Inject, int, str]] = {  # exit code and line to be seen
    "SIGTERM in a step": (stopped_by(signal.SIGTERM, "step"), 130, STOPPED),
    "Ctrl-C in a step": (stopped_by(signal.SIGINT, "step"), 130, STOPPED),
    "SIGTERM while a checkpoint is written": (stopped_by(signal.SIGTERM, "checkpoint"), 130, STOPPED),
    "disk full from the start": (on_disk(FULL, 0), 2, "spnr: .*No space left on device"),
    "disk full at a checkpoint": (on_disk(FULL, 200), 2, "spnr: checkpoint .* cannot be written .No space left"),
    "read-only folder": (on_disk(READ_ONLY, 0), 2, "spnr: .*Read-only file system"),
    "newest checkpoint half written": (damaged(lambda b: b[: len(b) // 2]), 0, "is damaged .*trying the one before"),
    "newest checkpoint overwritten": (damaged(lambda b: b"\xff" * len(b)), 0, "is damaged .*trying the one before"),
    "metrics file cut off in a row": (cut_log, 0, "trained"),
    "picture deleted from the data": (lost_picture, 2, r"spnr: .*001\.png: cannot be read"),
    "checkpoint of another version": (other_version, 2, "spnr: checkpoint .* is of another version"),
    "config of another version": (other_config, 2, "spnr: .*config.json: not a config of this version"),
    "two trainers in one folder": (two_trainers, 2, "spnr: .*another process trains in this folder"),
}
