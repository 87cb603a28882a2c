"""`spnr runs DIR`: the runs below a folder, best first, a line each with its learning curve."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from spnr_jax.errors import UserError
from spnr_jax.scoring.learning_curve import series
from spnr_jax.training import checkpoint, metrics_log
from spnr_jax.training.run_record import read_starts

BARS = "▁▂▃▄▅▆▇█"
CURVE = 24  # characters of a learning curve


@dataclass(frozen=True, kw_only=True)
class Run:
    """What one line says of a run."""

    name: str
    preset: str
    steps: str
    best: float  # highest validation PSNR in dB, NaN before the first preview
    best_step: int
    loss: float
    minutes: float
    curve: str


def read_runs(folder: Path) -> list[Run]:
    """The runs below a folder (or in it), the best validation PSNR first; ValueError if there is none."""
    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such folder; name one that holds run folders")
    paths = sorted(path.parent for path in folder.rglob("config.json") if (path.parent / "metrics.jsonl").is_file())
    if not paths:
        raise UserError(f"{folder}: no run folders below it (config.json and metrics.jsonl); `spnr train` makes them")
    runs = [read_run(path, str(path.relative_to(folder)) if path != folder else path.name) for path in paths]
    return sorted(runs, key=lambda run: -run.best if math.isfinite(run.best) else math.inf)


def read_run(path: Path, name: str) -> Run:
    """One run, from its config, metrics and record."""
    config, rows = checkpoint.read_config(path), metrics_log.read_rows(path)
    at, psnr = series(rows, "val_psnr")
    best = int(psnr.argmax()) if len(psnr) else -1
    losses = [row["loss"] for row in rows if "loss" in row]
    seconds = [sum(entry.get("seconds", {}).values()) for entry in read_starts(path)]
    trained = f"{max((row['step'] for row in rows), default=0)} of {config.num_steps}"
    return Run(
        name=name,
        preset=config.preset,
        steps=trained,
        best=float(psnr[best]) if len(psnr) else math.nan,
        best_step=int(at[best]) if len(psnr) else 0,
        loss=losses[-1] if losses else math.nan,
        minutes=sum(seconds) / 60,
        curve=sparkline(series(rows, "psnr")[1].tolist()),
    )


def sparkline(values: Sequence[float], width: int = CURVE) -> str:
    """Values as `width` bars or fewer, from the lowest to the highest; several values are averaged in one bar."""
    if not len(values):
        return ""
    count = min(width, len(values))
    edges = [round(i * len(values) / count) for i in range(count + 1)]
    means = [sum(values[a:b]) / (b - a) for a, b in zip(edges, edges[1:], strict=False)]
    low, high = min(means), max(means)
    step = (high - low) / (len(BARS) - 1) or 1.0
    return "".join(BARS[round((value - low) / step)] for value in means)


def table(runs: Sequence[Run]) -> list[str]:
    """Lines of text, a heading first."""
    heads = ("run", "preset", "steps", "val PSNR", "at", "loss", "minutes", "training PSNR")
    cells = [
        (
            *(run.name, run.preset, run.steps),
            *(("-", "-") if math.isnan(run.best) else (f"{run.best:.2f}", str(run.best_step))),
            *("-" if math.isnan(run.loss) else f"{run.loss:.3g}", f"{run.minutes:.1f}", run.curve),
        )
        for run in runs
    ]
    widths = [max(map(len, column)) for column in zip(heads, *cells, strict=True)]
    return ["  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip() for row in (heads, *cells)]
