"""The tables of `speed_accuracy`: settings that no other beats, and what each step along them costs and gives."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spnr_jax.scoring.score_tables import Table, number, text


def front(rows: Sequence[dict]) -> list[int]:
    """Rows that no other beats in PSNR and time, cheapest first."""
    order = sorted(range(len(rows)), key=lambda i: (rows[i]["ms_view"], -rows[i]["psnr"]))
    chosen: list[int] = []
    for i in order:
        if not chosen or rows[i]["psnr"] > rows[chosen[-1]]["psnr"]:
            chosen.append(i)
    return chosen


def knee(rows: Sequence[dict], chosen: Sequence[int]) -> int:
    """The row of the front that lies farthest above the line from its cheapest to its best."""
    x = np.log([rows[i]["ms_view"] for i in chosen])
    y = np.array([rows[i]["psnr"] for i in chosen])
    x, y = ((v - v[0]) / (v[-1] - v[0]) if v[-1] != v[0] else np.zeros_like(v) for v in (x, y))
    return chosen[int(np.argmax(y - x))]


def both(rows: Sequence[dict]) -> tuple[Table, Table]:
    """All settings of a size, and the front alone."""
    return table(rows, front(rows)), steps(rows, front(rows))


def table(rows: Sequence[dict], chosen: Sequence[int]) -> Table:
    """Settings of one size; those of the front are marked, and differences are to the network's best level."""
    heads = ("setting", "PSNR, dB", "SSIM", "FLIP", "IoU", "ms a view", "s to encode", "MB")
    decimals = {"ssim": 3, "flip": 3, "iou": 3, "ms_view": 1, "s_encode": 2, "mb": 0}
    made = []
    for i, row in enumerate(rows):
        base = next(r for r in rows if r["run"] == row["run"])
        mark = " (front, knee)" if i == knee(rows, chosen) else " (front)" if i in chosen else ""
        change = () if row is base else (f"({row['psnr'] - base['psnr']:+.2f})",)
        cells = [text(row["name"] + mark), number(row["psnr"], 2, more=change)]
        made.append((Path(row["run"]).name, (*cells, *(number(row[name], n) for name, n in decimals.items()))))
    return Table(title=f"Quality and cost at {rows[0]['size']} px", heads=heads, rows=tuple(made))


def steps(rows: Sequence[dict], chosen: Sequence[int]) -> Table:
    """The front from its cheapest on: what each step costs and gives."""
    made = []
    for before, i in zip((None, *chosen), chosen, strict=False):
        row = rows[i]
        cells = [text(row["name"]), number(row["psnr"], 2), number(row["ms_view"], 1)]
        if before is not None:
            last = rows[before]
            cells.append(number(row["ms_view"] / last["ms_view"], 2))
            differences = {"psnr": 2, "flip": 3, "iou": 3}
            cells += [number(row[name] - last[name], n, sign="+") for name, n in differences.items()]
        made.append((Path(row["run"]).name, tuple(cells)))
    heads = ("setting", "PSNR, dB", "ms a view", "times as long as the row before", "PSNR", "FLIP", "IoU")
    return Table(title=f"The front at {rows[0]['size']} px, step by step", heads=heads, rows=tuple(made))
