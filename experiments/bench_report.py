"""The rows of the benchmark as lines, as a Markdown table and as a plot."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

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


def table(rows: Sequence[Row]) -> str:
    """Markdown: milliseconds as median (least), the ratio with its quartiles over the rounds."""
    lines = [
        "| preset, batch | mode | function | twin | ours ms | twin ms | ratio | ours MB | twin MB | compile s |",
        "|---|---|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        entries = [f"{row['preset']}, {row['batch']}", row["mode"], NAMES[row["function"]], row["twin_variant"] or "-"]
        entries += [f"{row['ours_ms']:.1f} ({row['ours_min_ms']:.1f})"]
        if row["ratio"] is None:
            entries += ["-", "-", str(row["ours_peak_mb"]), "-"]
        else:
            entries += [f"{row['twin_ms']:.1f} ({row['twin_min_ms']:.1f})"]
            entries += [f"{row['ratio']:.2f} ({row['ratio_low']:.2f} to {row['ratio_high']:.2f})"]
            entries += [str(row["ours_peak_mb"]), str(row["twin_peak_mb"])]
        lines.append("| " + " | ".join([*entries, f"{row['compile_s']:.1f}"]) + " |")
    return "\n".join([*lines, "", *settings(rows), ""])


def settings(rows: Sequence[Row]) -> list[str]:
    """What the rows were measured on, each setting once."""
    names = ("hardware", "device", "dtype", "ours_software", "twin_software", "date")
    return list(dict.fromkeys(", ".join(str(row[name]) for name in names if row[name]) for row in rows))


def plot(rows: Sequence[Row]) -> bytes:
    """PNG, a panel for each preset: time relative to the twin, or milliseconds where there is no twin."""
    from matplotlib.figure import Figure

    presets = list(dict.fromkeys(row["preset"] for row in rows))
    figure = Figure((max(5.4 * len(presets), 8.2), 4.2), dpi=110, layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(presets), sharey=rows[0]["ratio"] is not None))
    for panel, preset in zip(panels, presets, strict=True):
        draw(panel, [row for row in rows if row["preset"] == preset])
        panel.set_title(f"{preset}, batch {next(row['batch'] for row in rows if row['preset'] == preset)}")
    timed = rows[0]["ratio"] is None
    panels[0].set_ylabel("ms" if timed else "time / time of the twin")
    labels = {text: handle for panel in panels for handle, text in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


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
    panel.spines[["top", "right"]].set_visible(False)
