"""The learning curve of a run as a picture: PSNR over steps, between the floors that it has to leave below.

Rows are those of metrics.jsonl: {"step", "psnr", ...} of training batches, {"step", "val_psnr"} of validation views.
"""

import io
import math
from collections.abc import Mapping, Sequence

import numpy as np

SIZE = 10.4, 3.9  # inches; the page scales it
SMOOTHING = 1 / 25  # of the rows, in one mean
INK, GREY, ACCENT, VALIDATION = "#1d2330", "#8a92a3", "#2457d6", "#d9480f"
FLOOR_DASHES = ("--", ":", "-.")
STYLE: dict = {
    "svg.fonttype": "none",  # text stays text, in the font of the page
    "svg.hashsalt": "spnr",  # the same rows give the same bytes
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "axes.edgecolor": "#c9cfda",
}


def learning_curve_svg(rows: Sequence[Mapping], floors: Mapping) -> str:
    """An <svg> element: PSNR of training (raw and smoothed) and validation, and a line for every named floor."""
    from matplotlib import rc_context  # here, so that importing the package stays light
    from matplotlib.figure import Figure

    train, validation = series(rows, "psnr"), series(rows, "val_psnr")
    with rc_context(STYLE):
        figure = Figure(SIZE, layout="constrained")
        axes = figure.add_subplot()
        if len(train[0]):
            axes.plot(*train, color=ACCENT, alpha=0.22, linewidth=1)
            axes.plot(train[0], smooth(train[1]), color=ACCENT, linewidth=2, label="training batches (faint: each row)")
        if len(validation[0]):
            axes.plot(*validation, "o-", color=VALIDATION, linewidth=1.2, markersize=5, label="validation views")
        for i, (name, value) in enumerate(floors.items()):
            dashes = FLOOR_DASHES[i % len(FLOOR_DASHES)]
            axes.axhline(value, color=GREY, linewidth=1.3, linestyle=dashes, label=f"{name}, {value:.1f} dB")
        axes.set_xlabel("step")
        axes.set_ylabel("PSNR, dB")
        axes.set_xlim(left=0)
        axes.grid(axis="y", color="#eceff4")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        figure.legend(loc="outside right center", frameon=False)
        stream = io.StringIO()
        figure.savefig(
            stream, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    svg = stream.getvalue()
    return svg[svg.index("<svg") :]


def series(rows: Sequence[Mapping], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and finite values of one quantity, of the rows that have it."""
    found = [(row["step"], row[name]) for row in rows if row.get(name) is not None and math.isfinite(row[name])]
    steps, values = np.array(found, np.float64).reshape(-1, 2).T
    return steps, values


def smooth(values: np.ndarray) -> np.ndarray:
    """Centred running mean over SMOOTHING of the values; near the ends the window shrinks, so that it stays centred."""
    widest = round(len(values) * SMOOTHING / 2)
    number = np.arange(len(values))
    reach = np.minimum(widest, np.minimum(number, number[::-1]))
    total = np.concatenate([[0.0], np.cumsum(values)])
    return (total[number + reach + 1] - total[number - reach]) / (2 * reach + 1)
