"""metrics.jsonl and TensorBoard of a run: what the loop writes there, and how it is read again."""

import json
import os
from pathlib import Path

import numpy as np

from spnr_jax.formats.images import to_uint8, write_whole


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
