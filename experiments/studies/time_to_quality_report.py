"""Tables, curves and sheets of pictures of `time_to_quality`, for real and for procedural objects apart."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.comparison import figures
from spnr_jax.formats import images
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation, intervals
from spnr_jax.scoring.score_tables import METHODS, Cell, Table, number

Marks = dict[str, Any]  # step, processor seconds, names of the objects shown, scores[object][metric] of each view
METRICS = {"psnr": ("PSNR, dB", 2), "color": ("mean colour: PSNR, dB", 2), "flip": ("FLIP", 3), "iou": ("IoU", 3)}
HOUR = 3600
SHEET_MARKS = (0.1, 0.4, 1.0)  # of the whole training


def groups(row: Marks) -> dict[str, list[str]]:
    """The scored objects that are meshes made by others, and procedural ones."""
    real = [name for name in row["scores"] if evaluation.category_of(name) == evaluation.MESHES]
    found = {"real": real, "procedural": [name for name in row["scores"] if name not in real]}
    return {name: objects for name, objects in found.items() if objects}


def values(row: Marks, metric: str, names: Sequence[str]) -> list[np.ndarray]:
    """A metric of each object's views; nothing where a network has no such thing."""
    return [np.asarray(row["scores"][name][metric]) for name in names if metric in row["scores"][name]]


def mean(row: Marks, metric: str, names: Sequence[str]) -> float | None:
    """Over all views of these objects."""
    found = values(row, metric, names)
    return float(np.concatenate(found).mean()) if found else None


def line(row: Marks) -> str:
    """A mark in a few words."""
    scores = {metric: mean(row, metric, list(row["scores"])) for metric in METRICS}
    told = ", ".join(f"{name} {value:.3f}" for name, value in scores.items() if value is not None)
    return f"step {row['step']}, {row['seconds']:.0f} s of the processor: {told}"


def label(preset: str) -> str:
    """Method and preset."""
    return f"{METHODS[PRESETS[preset]().model.method]} ({preset})"


def on_the_way(rows: Sequence[Marks], metric: str, group: str) -> list[tuple[float, float]]:
    """Seconds and mean at each mark, over the objects that every mark has."""
    names = groups(rows[0])[group]
    found = [(row["seconds"], mean(row, metric, names)) for row in rows]
    return [(seconds, value) for seconds, value in found if value is not None]


def reached(points: Sequence[tuple[float, float]], target: float) -> float | None:
    """Seconds at which a curve crosses the target, on a line between its points; None if it never does."""
    for (start, below), (end, value) in zip([(0.0, -np.inf), *points], points, strict=False):
        if value >= target:
            share = (target - below) / (value - below) if np.isfinite(below) else 1.0
            return start + share * (end - start)
    return None


def tables(curves: Mapping[str, Mapping[int, Sequence[Marks]]], target: float) -> list[Table]:
    """For each group of objects a line for each run: steps, time, last scores with intervals, time of the target."""
    made = []
    first = next(iter(next(iter(curves.values())).values()))
    for group in groups(first[-1]):
        rows: list[tuple[str, tuple[Cell, ...]]] = []
        for preset, runs in curves.items():
            for seed, marks in runs.items():
                last = marks[-1]
                names = groups(last)[group]
                cells = [number(last["step"], 0), number(last["seconds"] / HOUR, 2)]
                for metric, (_, decimals) in METRICS.items():
                    found = values(last, metric, names)
                    cells.append(
                        number(mean(last, metric, names), decimals, intervals.interval(found) if found else None)
                    )
                crossed = reached(on_the_way(marks, "psnr", group), target)
                cells.append(number(crossed, 0, missing="not reached"))
                rows.append((f"{label(preset)}, seed {seed}", tuple(cells)))
        heads = ("steps", "processor hours", *(head for head, _ in METRICS.values()), f"{target:g} dB after, s")
        title = f"Unseen {group} objects ({len(groups(first[-1])[group])}) after the last step"
        made.append(Table(title=title, heads=heads, rows=tuple(rows)))
    return made


def pictures(curves: Mapping[str, Mapping[int, Sequence[Marks]]], target: float) -> dict[str, bytes]:
    """The curves of each group of objects, as files."""
    first = next(iter(next(iter(curves.values())).values()))
    return {f"curves_{group}.png": plot(curves, target, group) for group in groups(first[0])}


@figures.drawing
def plot(curves: Mapping[str, Mapping[int, Sequence[Marks]]], target: float, group: str) -> Figure:
    """Every metric over processor hours: a colour for each preset, a line for each seed."""
    figure = Figure(figsize=(9.6, 5.6))
    axes = figure.subplots(2, 2, sharex=True)
    for one, (metric, (head, _)) in zip(axes.flat, METRICS.items(), strict=True):
        for (preset, runs), color in zip(curves.items(), figures.COLORS, strict=False):
            for number_of, rows in enumerate(runs.values()):
                points = on_the_way(rows, metric, group)
                hours, scores = [seconds / HOUR for seconds, _ in points], [value for _, value in points]
                name = None if number_of else label(preset)
                one.plot(hours, scores, "o-", color=color, markersize=3.5, label=name)
        one.set_ylabel(head)
        one.set_xlim(left=0)
    axes[0, 0].axhline(target, color=figures.INK_COLOR, linestyle="--", linewidth=1)
    for one in axes[1]:
        one.set_xlabel("hours of the processor in steps")
    axes[0, 0].legend(fontsize=7)
    return figure


def sheets(curves: Mapping[str, Mapping[int, Sequence[Marks]]], folders: Mapping[str, Path]) -> dict[str, bytes]:
    """One sheet: a column for each object shown; the reference, then each network early, later and at the end."""
    cells: list[list[np.ndarray]] = []
    heads: list[str] = []
    columns: list[str] = []
    for preset, runs in curves.items():
        rows = next(iter(runs.values()))
        chosen = [min(rows, key=lambda row: abs(row["step"] / rows[-1]["step"] - share)) for share in SHEET_MARKS]
        for row in {row["step"]: row for row in chosen}.values():
            with np.load(folders[preset] / f"{row['step']:07d}.npz", allow_pickle=False) as strips:
                found = [strips[name] for name in strips.files]
            if not cells:
                cells, heads, columns = [found[::2]], ["reference"], row["shown"]
            cells.append(found[1::2])
            heads.append(f"{preset}, {row['seconds'] / 60:.0f} min")
    return {"sheet.png": images.png(figures.grid(cells, columns, heads, size=128))}
