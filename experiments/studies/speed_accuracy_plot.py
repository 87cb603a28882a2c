"""The plot of `speed_accuracy`: a row for each size, quality against cost, colours for groups, markers for networks."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from experiments.comparison import figures

MARKERS = "osD^v<>P"  # of networks
GROUPS = {  # of settings, as the plot colours them
    "level": "#1d2330",
    "fewer pixels": "#d9480f",
    "points": "#868e96",
    "samples": "#2457d6",
    "near points": "#2f9e44",
    "bfloat16": "#9c36b5",
    "surface": "#e8a200",
}
LABELS = {"psnr": "PSNR, dB", "flip": "FLIP (lower is better)", "iou": "opacity IoU"}
PANELS = (("ms_view", "psnr"), ("ms_view", "flip"), ("ms_view", "iou"), ("mb", "psnr"))


@figures.drawing
def plot(sizes: Sequence[tuple[Sequence[dict], Sequence[int], int]]) -> Figure:
    """Quality against cost: of each size its rows, which of them make the front, and its knee."""
    figure = Figure(figsize=(14, 0.6 + 3.3 * len(sizes)))
    for line, (rows, chosen, knee) in zip(figure.subplots(len(sizes), 4, squeeze=False), sizes, strict=True):
        for axes, (x, y) in zip(line, PANELS, strict=True):
            _scatter(axes, rows, x, y)
        first = line[0]
        first.set_title(f"{rows[0]['size']} x {rows[0]['size']}")
        first.plot([rows[i]["ms_view"] for i in chosen], [rows[i]["psnr"] for i in chosen], color="#adb5bd", zorder=2)
        place = (rows[knee]["ms_view"], rows[knee]["psnr"])
        first.annotate(f"knee: {rows[knee]['name']}", place, xytext=(8, -24), textcoords="offset points")
    handles = {label: h for axes in figure.axes for h, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6)
    return figure


def _scatter(axes: Axes, rows: Sequence[dict], x: str, y: str) -> None:
    """A point for each setting."""
    runs = list(dict.fromkeys(row["run"] for row in rows))
    for group, color in GROUPS.items():
        for marker, run in zip(MARKERS, runs, strict=False):
            if shown := [row for row in rows if (row["group"], row["run"]) == (group, run)]:
                label = group if len(runs) == 1 else f"{Path(run).name}, {group}"
                across, up = ([max(row[name], 1) if name == "mb" else row[name] for row in shown] for name in (x, y))
                axes.scatter(across, up, s=26, c=color, marker=marker, zorder=3, label=label)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("ms a view" if x == "ms_view" else "MB of memory")
    axes.set_ylabel(LABELS[y])
