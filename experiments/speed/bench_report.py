"""The rows of the benchmark as lines, as a Markdown table and as a plot."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.comparison import figures
from spnr_jax.scoring.score_tables import Cell, Table, number, text

Row = dict[str, Any]

LIMITS = {"plain": 0.7, "fast": 1.0}  # goals of ours / twin, for the same function
COLORS = {"plain": "#a8b3c7", "fast": "#2457d6", "compiled": "#12a37f"}
NAMES = {"network": "ours", "near points": "ours near points"}


def line(row: Row) -> str:
    """One row for the terminal."""
    what = f"{row['preset']} batch {row['batch']} {row['mode']}, {NAMES[row['function']]}: {row['ours_ms']:.1f} ms"
    if row["ratio"] is None:
        return what
    return f"{what}, twin {row['twin_variant']} {row['twin_ms']:.1f} ms, ratio {row['ratio']:.2f}"


def table(rows: Sequence[Row]) -> Table:
    """Milliseconds as median (least), the ratio with its quartiles over the rounds."""
    heads = ("mode", "function", "twin", "ours, ms", "twin, ms", "ours / twin", "ours, MB", "twin, MB", "compile, s")
    made = []
    for row in rows:
        ours = number(row["ours_ms"], 1, more=(f"({row['ours_min_ms']:.1f})",))
        theirs: tuple[Cell, ...] = (text("-"), text("-"))
        if row["ratio"] is not None:
            ratio = number(row["ratio"], 2, (row["ratio_low"], row["ratio_high"]))
            theirs = (number(row["twin_ms"], 1, more=(f"({row['twin_min_ms']:.1f})",)), ratio)
        memory = number(row["ours_peak_mb"], 0), number(row["twin_peak_mb"], 0, missing="-")
        what = text(row["mode"]), text(NAMES[row["function"]]), text(row["twin_variant"] or "-")
        cells = (*what, ours, *theirs, *memory, number(row["compile_s"], 1))
        made.append((f"{row['preset']}, batch {row['batch']}", cells))
    return Table(title="One step, one encoding, one view", heads=heads, rows=tuple(made))


def settings(rows: Sequence[Row]) -> list[str]:
    """What the rows were measured on and with, each setting once, and how busy the machine was."""
    names = ("hardware", "ours_software", "twin_software", "date")
    loads = [row["load"] for row in rows]
    busy = f"load of the machine before the rows, both sides and others: {min(loads):.1f} to {max(loads):.1f}"
    return [*dict.fromkeys(", ".join(str(row[name]) for name in names if row[name]) for row in rows), busy]


@figures.drawing
def plot(rows: Sequence[Row]) -> Figure:
    """A panel for each preset: time relative to the twin, or milliseconds where there is no twin."""
    presets = list(dict.fromkeys(row["preset"] for row in rows))
    timed = rows[0]["ratio"] is None
    figure = Figure((max(5.4 * len(presets), 8.2), 4.2))
    panels = np.atleast_1d(figure.subplots(1, len(presets), sharey=not timed))
    for panel, preset in zip(panels, presets, strict=True):
        draw(panel, [row for row in rows if row["preset"] == preset])
        panel.set_title(preset)
    panels[0].set_ylabel("ms" if timed else "time / time of the twin")
    labels = {text: handle for panel in panels for handle, text in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=3)
    return figure


def draw(panel: Any, rows: Sequence[Row]) -> None:
    """A group of bars for each mode: one for each variant of the twin, hatched for the function near points."""
    modes = list(dict.fromkeys(row["mode"] for row in rows))
    kinds = list(dict.fromkeys((row["function"], row["twin_variant"]) for row in rows))
    kinds.sort(key=lambda kind: list(NAMES).index(kind[0]))
    width = 0.84 / len(kinds)
    for i, (function, variant) in enumerate(kinds):
        found = [row for row in rows if (row["function"], row["twin_variant"]) == (function, variant)]
        values = [row["ours_ms"] if row["ratio"] is None else row["ratio"] for row in found]
        bars = panel.bar(
            [modes.index(row["mode"]) - 0.42 + (i + 0.5) * width for row in found],
            values,
            width,
            color=COLORS.get(variant, COLORS["fast"]),
            edgecolor="white",
            hatch="///" if function == "near points" else None,
            label=NAMES[function] + (f" / twin {variant}" if variant else ""),
        )
        panel.bar_label(bars, fmt="%.2f" if variant else "%.0f", fontsize=7, padding=2)
    if any(variant for _, variant in kinds):
        for variant, limit in LIMITS.items():
            name = f"goal: {limit:g} of twin {variant}"
            panel.axhline(limit, color=COLORS[variant], linewidth=1.2, linestyle="--", zorder=0, label=name)
    panel.set_xticks(range(len(modes)), modes)
