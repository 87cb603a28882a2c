"""The record of a run: rows of metrics.jsonl and TensorBoard, and RUN/run.json.

run.json has an entry for every start of the trainer:

began, first_step, last_step    when it began, and the steps that it trained
seconds                         by phase: restore, compilation (the first step), steps, previews, checkpoints, listeners
jax, hardware                   version of JAX, and the machine
data, data_checksum             the folder, and a number that tells data sets apart
init                            the training whose weights a new run began with, if they were not random
"""

import hashlib
import json
import os
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
    """Seconds since it was made, by phase: each lap belongs to one."""

    def __init__(self) -> None:
        """Starts it."""
        self.seconds: dict[str, float] = {}
        self._since = time.monotonic()

    def lap(self, phase: str) -> float:
        """Seconds since the lap before, counted towards the phase."""
        now = time.monotonic()
        elapsed, self._since = now - self._since, now
        self.seconds[phase] = self.seconds.get(phase, 0.0) + elapsed
        return elapsed


class RunRecord:
    """The entry of this start, written anew whenever the run saves."""

    def __init__(self, run: Path, dataset: data_sets.Dataset, first_step: int, init: Trained | None = None) -> None:
        """Keeps the entries of earlier starts."""
        self._path, self._earlier = run / "run.json", read_starts(run)
        self._entry: dict[str, Any] = {
            "began": datetime.now(UTC).isoformat(timespec="seconds"),
            "first_step": first_step,
            "jax": jax.__version__,
            "hardware": runtime.hardware(),
            "data": str(dataset.folder),
            "data_checksum": checksum(dataset),
        }
        if init is not None:
            self._entry["init"] = f"{init.config.preset}, {init.steps} steps"

    def write(self, last_step: int, clock: Clock) -> None:
        """Writes what is known by now."""
        seconds = {phase: round(spent, 2) for phase, spent in clock.seconds.items()}
        starts = [*self._earlier, self._entry | {"last_step": last_step, "seconds": seconds}]
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
