"""Tables of results: their cells, and rows of scores of methods, as reports and experiments show them.

A cell is a text, smaller ones behind it (an interval), whether it stands out, and the number behind it.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spnr_jax.methods import label_of
from spnr_jax.scoring.perceptual import NO_LPIPS
from spnr_jax.scoring.summary import interval

OTHERS = {  # what is shown beside the methods that are trained -> its name in tables and pictures
    "ours": "Ours",
    "nearest": "Nearest-point shading",
    "splat": "Base-colour splat",
    "white": "White image",
}
HIGHER, LOWER = 1, -1  # what is better
QUALITY = {  # metric -> head of its column, decimals, what is better
    "psnr": ("PSNR, dB", 2, HIGHER),
    "ssim": ("SSIM", 3, HIGHER),
    "cpsnr": ("cPSNR, dB", 2, HIGHER),
    "flip": ("FLIP", 3, LOWER),
    "lpips": ("LPIPS", 3, LOWER),
    "iou": ("Opacity IoU", 3, HIGHER),
}
ARROWS = {HIGHER: "\N{UPWARDS ARROW}", LOWER: "\N{DOWNWARDS ARROW}"}
MISSING = {"lpips": NO_LPIPS, "iou": "n/a (no opacity)"}  # metric -> what stands where there is no number


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A text, smaller ones behind it, whether it is to stand out; and the number and interval that it shows."""

    text: str
    small: tuple[str, ...] = ()
    best: bool = False
    value: Any = None
    interval: tuple[Any, Any] | None = None


@dataclass(frozen=True, kw_only=True)
class Table:
    """Heads (with units), rows of a name and cells, and a line that says how to read them."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]
    note: str = ""


def text(value: object) -> Cell:
    """A cell that is no measurement."""
    return Cell(text=str(value))


def number(
    value: Any,
    decimals: int,
    interval: Sequence[Any] | None = None,
    *,
    sign: str = "",
    factor: float | int = 1,
    missing: str = "n/a",
    best: bool = False,
    more: tuple[str, ...] = (),
) -> Cell:
    """A number (times a factor) and its interval; `sign` is "+" for differences, `more` stands behind the interval."""
    if value is None or not math.isfinite(value):
        return Cell(text=missing)
    form, small, ends = f"{sign},.{decimals}f", more, None
    if interval is not None:
        low, high = (factor * end for end in interval)
        small, ends = (f"[{low:{form}}, {high:{form}}]", *more), (low, high)
    return Cell(text=f"{factor * value:{form}}", small=small, best=best, value=factor * value, interval=ends)


def mean_row(
    label: str, objects: Sequence[Sequence[Any]] | np.ndarray, decimals: Sequence[int], sign: str = ""
) -> tuple[str, tuple[Cell, ...]]:
    """A row of means of columns over objects, with intervals; None and NaN are left out."""
    cells = []
    for column, digits in zip(np.array(objects, float).T, decimals, strict=True):
        known = column[~np.isnan(column)]
        mean = float(known.mean()) if len(known) else None
        cells.append(number(mean, digits, interval([np.array([x]) for x in known]) if len(known) else None, sign=sign))
    return label, tuple(cells)


def head(metric: str) -> str:
    """Head of a metric's column."""
    name, _, better = QUALITY[metric]
    return f"{name}\N{NO-BREAK SPACE}{ARROWS[better]}"


def quality(methods: Mapping[str, Mapping], metrics: Iterable[str]) -> dict[str, tuple[Cell, ...]]:
    """The cells of metrics by method, of rows of `summarise`: means with intervals, the best of a column marked."""
    columns = []
    for metric in metrics:
        _, decimals, better = QUALITY[metric]
        values = [row.get(metric) for row in methods.values()]
        known = [value for value in values if value is not None and math.isfinite(value)]
        best = max(known, key=lambda value: better * value) if known else None
        ends = [row.get(f"{metric}_interval") for row in methods.values()]
        missing = MISSING.get(metric, "n/a")
        pairs = zip(values, ends, strict=True)
        columns.append([number(x, decimals, e, missing=missing, best=x == best) for x, e in pairs])
    return dict(zip(methods, zip(*columns, strict=True), strict=True))


def difference(found: Mapping | None, metric: str) -> Cell:
    """The cell of a paired difference (`summary.differences`), with its interval and p-value."""
    if found is None:
        return text(MISSING.get(metric, "n/a"))
    p_value = found["p_value"]
    test = () if p_value is None else ("p < 0.001",) if p_value < 0.001 else (f"p = {p_value:.3f}",)
    return number(found["mean"], QUALITY[metric][1], found["interval"], sign="+", more=test)


def label(method: str) -> str:
    """What tables and pictures call a method."""
    return OTHERS.get(method) or label_of(method)


def lowered(method: str) -> str:
    """A method's name inside a sentence."""
    name = label(method)
    return name if name[:2].isupper() else name[:1].lower() + name[1:]
