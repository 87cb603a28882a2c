"""The record of a run: rows of metrics.jsonl and TensorBoard, and RUN/run.json.

run.json has an entry for every start of the trainer:

began, first_step, last_step    when it began, and the steps that it trained
seconds                         by phase: restore, compilation (the first step), steps, previews, checkpoints, listeners
processor_seconds               CPU time of all threads, by phase; other work on the machine does not change it
version, commit, jax, hardware  of the code ("+" after a commit: the checkout was changed), of JAX, of the machine
data, data_checksum             the folder, and a number that tells data sets apart
init                            the training whose weights a new run began with, if they were not random
"""

import hashlib
import importlib.metadata
import json
import os
import subprocess
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax
import numpy as np

from spnr_jax.devices import runtime
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import to_uint8, write_whole
from spnr_jax.training.weights import Trained


class MetricsLog:
    """metrics.jsonl and TensorBoard of a run; rows after `first_step` of an earlier run are dropped."""

    def __init__(self, run: Path, first_step: int) -> None:
        """Opens both for appending."""
        from tensorboardX import SummaryWriter

        path = run / "metrics.jsonl"
        kept = [row for row in read_rows(run) if row["step"] <= first_step]
        write_whole(path, "".join(json.dumps(row) + "\n" for row in kept).encode())
        self._file = path.open("a")
        self._board = SummaryWriter(str(run / "tensorboard"), purge_step=first_step + 1)

    def write(self, row: dict[str, int | float], picture: np.ndarray | None = None) -> None:
        """Appends one row, to the disk itself; in TensorBoard its entries are scalars, and the picture is an image."""
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())  # a checkpoint that outlives a power cut needs the rows before it
        for name, value in row.items():
            if name != "step":
                self._board.add_scalar(name, value, row["step"])
        if picture is not None:
            self._board.add_image("preview", to_uint8(picture), row["step"], dataformats="HWC")

    def close(self) -> None:
        """Closes both."""
        self._file.close()
        self._board.close()


class Unwritten:
    """The log and the record of a process that does not write them."""

    def write(self, *what: object) -> None:
        """Writes nothing."""

    def close(self) -> None:
        """Closes nothing."""


def read_rows(run: Path) -> list[dict]:
    """Rows of a run's metrics.jsonl; a last line that a crash cut off is left out, and what follows a broken one."""
    path = run / "metrics.jsonl"
    rows: list[dict] = []
    for line in path.read_text(errors="replace").splitlines() if path.exists() else []:
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            break
        if not isinstance(row, dict) or not all(isinstance(value, int | float) for value in row.values()):
            break
        rows.append(row)
    return rows


class Clock:
    """Wall-clock and CPU seconds since it was made, by phase: each lap belongs to one."""

    def __init__(self) -> None:
        """Starts it."""
        self.seconds: dict[str, float] = {}
        self.processor_seconds: dict[str, float] = {}
        self._since = time.monotonic(), time.process_time()

    def lap(self, phase: str) -> float:
        """Seconds since the lap before, counted towards the phase."""
        now = time.monotonic(), time.process_time()
        elapsed, worked = (new - old for new, old in zip(now, self._since, strict=True))
        self._since = now
        self.seconds[phase] = self.seconds.get(phase, 0.0) + elapsed
        self.processor_seconds[phase] = self.processor_seconds.get(phase, 0.0) + worked
        return elapsed


class RunRecord:
    """The entry of this start, written anew whenever the run saves."""

    def __init__(self, run: Path, dataset: data_sets.Dataset, first_step: int, init: Trained | None = None) -> None:
        """Keeps the entries of earlier starts."""
        self._path, self._earlier = run / "run.json", read_starts(run)
        self._entry: dict[str, Any] = {
            "began": datetime.now(UTC).isoformat(timespec="seconds"),
            "first_step": first_step,
            "version": version(),
            "commit": commit(),
            "jax": jax.__version__,
            "hardware": runtime.hardware(),
            "data": str(dataset.folder),
            "data_checksum": checksum(dataset),
        }
        if init is not None:
            self._entry["init"] = f"{init.config.preset}, {init.steps} steps"

    def write(self, last_step: int, clock: Clock) -> None:
        """Writes what is known by now."""
        spent = {"seconds": clock.seconds, "processor_seconds": clock.processor_seconds}
        rounded = {name: {phase: round(value, 2) for phase, value in by.items()} for name, by in spent.items()}
        starts = [*self._earlier, self._entry | {"last_step": last_step} | rounded]
        write_whole(self._path, (json.dumps({"starts": starts}, indent=1) + "\n").encode())


def read_starts(run: Path) -> list[dict]:
    """Entries of a run's run.json; none if there is no such file or it cannot be read."""
    try:
        starts = json.loads((run / "run.json").read_text(errors="replace"))["starts"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [entry for entry in starts if isinstance(entry, dict)] if isinstance(starts, list) else []


def trained_on(run: Path, dataset: data_sets.Dataset, names: Sequence[str]) -> bool | None:
    """Whether a run trained on some of the objects of a data set, by its record; None where that does not say.

    It does not if the run trained on another data set, which may hold the same objects, or began with weights of
    another training.
    """
    starts, wanted = read_starts(run), checksum(dataset)
    here = [entry.get("data_checksum") == wanted for entry in starts]
    if any(here) and not set(names).isdisjoint(dataset.splits["train"]):
        return True
    return False if here and all(here) and not any("init" in entry for entry in starts) else None


def checksum(dataset: data_sets.Dataset) -> str:
    """A number that tells data sets apart: of their settings and the names of their objects."""
    content = json.dumps([dataset.settings, dataset.splits], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


def version() -> str:
    """The installed version of the package."""
    try:
        return importlib.metadata.version("spnr-jax")
    except importlib.metadata.PackageNotFoundError:
        return "not installed"  # only on the path


def commit() -> str | None:
    """The commit that the code was checked out at, with a "+" if files differ from it; None outside of a checkout."""
    git = ("git", "-C", str(Path(__file__).parent))
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True, timeout=10)
        changed = subprocess.run([*git, "status", "--porcelain", "."], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return None
    return head.stdout.strip() + ("+" if changed.stdout.strip() else "")
