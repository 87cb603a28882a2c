"""What else can happen to a training: signals, disks, damaged files, a second trainer.

Each fault happens to a copy of a run that lacks its last steps.  It is survived if the command ends with the code and
the one line that stand in the table, without a call stack, and if the same command, called again once the fault is
mended, ends with the bits of the run that had none.

Full and read-only disks are real ones: a small tmpfs, and a read-only bind mount, in a mount namespace of their own
(`unshare`, which needs no root where user namespaces are allowed; where not, these faults are skipped and said to be).
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from experiments import chaos_kills
from experiments.chaos_child import QUICK_COMPILATION, Ended
from experiments.chaos_kills import Training
from spnr_jax.formats import data_sets
from spnr_jax.training import checkpoint

GRACE = 30.0  # seconds that schedulers give after SIGTERM: Slurm's KillWait, Kubernetes' grace period
UNSHARED = ["unshare", "--user", "--map-root-user", "--mount"]
# $1 the run to copy, $2 the folder to mount on, $3 where to copy what is left, $4 kB of room; then the command
FULL = """mount -t tmpfs -o size=64m none "$2" && cp -a "$1/." "$2" || exit 99
used=$(du -sk "$2" | cut -f1) && mount -o remount,size=$((used + $4))k "$2" || exit 99
before="$3" mounted="$2"; shift 4; "$@"; code=$?; cp -a "$mounted/." "$before"; exit $code"""
READ_ONLY = """mount --bind "$2" "$2" && mount -o remount,bind,ro "$2" || exit 99
shift 4; exec "$@" """
Verdict = Literal["survived", "LOST", "skipped"]


@dataclass(frozen=True, kw_only=True)
class Fault:
    """What happened: exit code and line of the faulty call, whether the next one made up for it, and the time taken."""

    name: str
    verdict: Verdict
    code: int
    line: str
    note: str
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Exit code and output of the faulty call; a note; and whether the metrics file may hold a row more."""

    code: int
    output: str
    note: str = ""
    more_rows: bool = False


Inject = Callable[[Training, Path], Seen]  # does the fault to a run, calls the command, and mends what it broke


def survived(training: Training, folder: Path, whole: Path, names: tuple[str, ...] = ()) -> Iterator[Fault]:
    """Each of FAULTS (or those that are named) in turn."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for number, name in enumerate(names or FAULTS):
        inject, code, words = FAULTS[name]
        begin, run = time.monotonic(), folder / f"{number:02d}"
        shutil.copytree(whole, run)
        shutil.rmtree(run / "checkpoints" / str(training.num_steps))
        seen = inject(training, run)
        if seen.code == 99:
            yield Fault(name=name, verdict="skipped", code=99, line="", note="no mounts allowed here", seconds=0.0)
            continue
        lines = [line for line in re.split(r"[\r\n]+", seen.output) if re.search(words, line)]
        good = seen.code == code and len(lines) == 1 and "Traceback" not in seen.output
        again = training.run(run)
        good &= again.code == 0 and recovered(run, whole, seen.more_rows)
        yield Fault(
            name=name,
            verdict="survived" if good else "LOST",
            code=seen.code,
            line=(lines or [seen.output.strip()[-300:]])[0].strip(),
            note=seen.note,
            seconds=round(time.monotonic() - begin, 1),
        )


def recovered(run: Path, whole: Path, more_rows: bool) -> bool:
    """Whether a run ends with the same state and metrics file; a stop writes a row of its own, if `more_rows`."""
    (_, state), (_, expected) = checkpoint.load_run(run), checkpoint.load_run(whole)
    rows, wanted = chaos_kills.rows(run), chaos_kills.rows(whole)
    if more_rows:
        steps = [row["step"] for row in rows if "loss" in row]
        same_rows = steps == sorted(set(steps)) and {row["step"] for row in wanted} <= set(steps)
    else:
        same_rows = rows == wanted
    return same_rows and chaos_kills.same(state, expected, set(vars(state)))


def stopped_by(number: signal.Signals, phase: Literal["step", "checkpoint"]) -> Inject:
    """A signal in a step, or while a checkpoint is written."""

    def inject(training: Training, run: Path) -> Seen:
        newest = checkpoint_steps(run)[0]
        if phase == "checkpoint":  # one that is not the last
            shutil.rmtree(run / "checkpoints" / str(newest))
        step = newest if phase == "checkpoint" else newest + training.checkpoint_every // 2
        before = checkpoint_steps(run)
        ended = training.run(
            run, number=number, aim=lambda event: 0.01 if event.phase == phase and event.step >= step else None
        )
        late = ended.seconds_to_end is None or ended.seconds_to_end > GRACE
        saved = checkpoint_steps(run) > before
        note = f"ended after {ended.seconds_to_end or 0:.1f} s of {GRACE:.0f}, " + ("saved" if saved else "NOT SAVED")
        return Seen(code=-1 if late or not saved else ended.code, output=ended.output, note=note, more_rows=True)

    return inject


def checkpoint_steps(run: Path) -> list[int]:
    """Steps of a run's checkpoints, newest first."""
    names = [path.name for path in (run / "checkpoints").iterdir()]
    return sorted((int(name) for name in names if name.isdigit()), reverse=True)


def on_disk(script: str, room: int) -> Inject:
    """A disk with so many kB of room, or one that cannot be written."""

    def inject(training: Training, run: Path) -> Seen:
        mounted = run.with_name(f"{run.name}-mounted") if script is FULL else run
        mounted.mkdir(exist_ok=True)
        command = [sys.executable, "-m", "spnr_jax.cli", *training.arguments(mounted)]
        places = [str(run), str(mounted), str(run), str(room)]
        environment = {"XLA_FLAGS": QUICK_COMPILATION} | os.environ
        environment["JAX_COMPILATION_CACHE_DIR"] = str(training.cache)
        try:
            done = subprocess.run(
                [*UNSHARED, "sh", "-c", script, "sh", *places, *command],
                capture_output=True,
                text=True,
                env=environment,
            )
        except FileNotFoundError:  # no `unshare` here
            return Seen(code=99, output="")
        refused = done.returncode == 1 and "unshare" in done.stderr
        return Seen(code=99 if refused else done.returncode, output=done.stdout + done.stderr)

    return inject


def damaged(change: Callable[[bytes], bytes]) -> Inject:
    """The newest checkpoint, each of its files changed."""

    def inject(training: Training, run: Path) -> Seen:
        newest = run / "checkpoints" / str(checkpoint_steps(run)[0])
        for path in newest.rglob("*"):
            if path.is_file():
                path.write_bytes(change(path.read_bytes()))
        return called(training, run)

    return inject


def cut_log(training: Training, run: Path) -> Seen:
    """A metrics file that ends in the middle of a row, as a power cut leaves it, and that had rows to come."""
    path = run / "metrics.jsonl"
    path.write_bytes(path.read_bytes()[:-40])
    return called(training, run)


def lost_object(training: Training, run: Path) -> Seen:
    """A picture that was deleted from the data set."""
    folder = run.with_name(f"{run.name}-data")
    shutil.copytree(training.data, folder)
    for name in data_sets.open_dataset(folder).splits["train"]:
        (folder / "objects" / name / "images" / "001.png").unlink()
    return called(replace(training, data=folder), run)


def other_version(training: Training, run: Path) -> Seen:
    """A newest checkpoint that holds other arrays than a state of this version."""
    from orbax.checkpoint import v1 as ocp

    strange = run / "checkpoints" / str(training.num_steps - 1)
    with ocp.training.Checkpointer((run / "checkpoints").absolute()) as checkpointer:
        checkpointer.save(int(strange.name), {"weights": np.zeros(3)})
    seen = called(training, run)
    kept = strange.is_dir()
    shutil.rmtree(strange)
    return replace(seen, code=seen.code if kept else -1, note="it is kept" if kept else "it is GONE")


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

    def start_second(event):
        if event.phase == "step" and not second:
            command = training.arguments(run)
            second.append(chaos_kills.chaos_child.run(command, training.cache, run.with_name(f"{run.name}-second.txt")))

    first = training.run(run, aim=start_second)
    code = second[0].code if first.code == 0 else -1
    return Seen(code=code, output=second[0].output, note="the first one trains on")


def called(training: Training, run: Path) -> Seen:
    """What the command makes of a run."""
    ended = training.run(run)
    return Seen(code=ended.code, output=ended.output)


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
    "metrics file cut off in a row": (cut_log, 0, "trained: "),
    "picture deleted from the data": (lost_object, 2, r"spnr: .*001\.png: cannot be read"),
    "checkpoint of another version": (other_version, 2, "spnr: checkpoint .* is of another version"),
    "config of another version": (other_config, 2, "spnr: .*config.json: not a config of this version"),
    "two trainers in one folder": (two_trainers, 2, "spnr: .*another process trains in this folder"),
}
