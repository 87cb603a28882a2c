"""Tables of the relighting study: a row a light, a number of points and a method.

Scores of an object are a list of its views: by size the four of HEADS, "shadows" the two of SHADOWS; of a turned light
a dictionary of decibels by step ("inside") and of how well its changes are told ("change").
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.comparison import results_folder
from experiments.comparison.result_tables import Cell, Table, number
from spnr_jax.devices import machine
from spnr_jax.scoring import intervals

Row = tuple[str, str, int]  # light, method, number of points (0: takes none)
Found = dict[Row, list]  # a value for each object

HEADS = ("PSNR, dB", "inside, dB", "FLIP", "log error")
DECIMALS = (2, 2, 3, 3)
SHADOWS = ("shadows: correlation", "shadows: log error")
TURNS = ("inside, dB", "worst step, dB", "change: correlation", "change: log error", "change: share missed")
MARGINS = ("below the room", "above split-sum", "above Poisson")
BESIDE = ("splats", "poisson")  # methods of the last two
ROWS, SIZE = 8, 192  # objects of a sheet, pixels of a picture
NOTE = "Means over objects with 95 % intervals; pictures are never rescaled."


def write(out: Path, found: Found, turns: Found, labels: Mapping[str, str], sizes: Sequence[int]) -> None:
    """Writes and prints the tables."""
    made = [_quality(found, labels, size) for size in sizes]
    made += [_margins(found, size) for size in sizes if any(method == "network" for _, method, _ in found)]
    if any("shadows" in view for of in found.values() for views in of for view in views):
        made.append(_shadows(found, labels, min(sizes)))
    if turns:
        made.append(_turns(turns, labels, min(sizes)))
    results = {
        "scores": {_named(row): _known(of) for row, of in found.items()},
        "turns": {_named(row): _known(of) for row, of in turns.items()},
        "hardware": machine.hardware(),
    }
    results_folder.write(out, results, made)


def mean(values: Iterable[float]) -> float:
    """The mean of those that are numbers; NaN if none is."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def by_object(of: Sequence[Sequence[Mapping]], key: str, column: int) -> list[float]:
    """A score of each object: the mean of its views."""
    return [mean(view[key][column] for view in views if key in view) for views in of]


def _quality(found: Found, labels: Mapping[str, str], size: int) -> Table:
    rows = [
        (_label(row, labels), [_cell(by_object(of, str(size), i), DECIMALS[i]) for i in range(len(HEADS))])
        for row, of in found.items()
    ]
    return _table(f"Relighting, {size} pixels", HEADS, rows, NOTE)


def _shadows(found: Found, labels: Mapping[str, str], size: int) -> Table:
    rows = [
        (_label(row, labels), [_cell(by_object(of, "shadows", i), 3) for i in range(len(SHADOWS))])
        for row, of in found.items()
        if any("shadows" in view for views in of for view in views)
    ]
    note = "log(picture / the same without shadows) beside the reference's, in nepers. " + NOTE
    return _table(f"Shadows, {size} pixels", SHADOWS, rows, note)


def _turns(turns: Found, labels: Mapping[str, str], size: int) -> Table:
    rows = []
    for row, of in turns.items():
        inside = [[mean(one["inside"]) for one in of], [min(one["inside"]) for one in of]]
        change = [[one["change"][i] for one in of] for i in range(3)]
        decimals = (2, 2, 3, 3, 3)
        rows.append((_label(row, labels), [_cell(x, n) for x, n in zip([*inside, *change], decimals, strict=True)]))
    steps = len(next(iter(turns.values()))[0]["inside"])
    note = f"The light turned {steps} times by {360 / steps:g} degrees; 1 of the change is missed by a still picture."
    return _table(f"Turned light, {size} pixels", TURNS, rows, note)


def _margins(found: Found, size: int) -> Table:
    """The network beside itself in the room, discs and Poisson surfaces: decibels of whole pictures, and inside."""
    rows = []
    for (light, method, count), of in found.items():
        if method != "network" or light == "room":
            continue
        others = [found.get(("room", method, count)), *(found.get((light, name, count)) for name in BESIDE)]
        cells = []
        for column in (0, 1):
            own = by_object(of, str(size), column)
            for other, sign in zip(others, (-1, 1, 1), strict=True):
                theirs = by_object(other, str(size), column) if other else [float("nan")] * len(own)
                cells.append(_cell([sign * (a - b) for a, b in zip(own, theirs, strict=True)], 2, "+"))
        rows.append((f"{light}, {count:,}", cells))
    heads = (*(f"PSNR {name}" for name in MARGINS), *(f"inside {name}" for name in MARGINS))
    return _table(f"The network's margins, {size} pixels, dB", heads, rows, "Of the same objects. " + NOTE)


def _table(title: str, heads: Sequence[str], rows: Sequence[tuple[str, list[Cell]]], note: str) -> Table:
    return Table(title=title, heads=tuple(heads), rows=tuple((label, tuple(cells)) for label, cells in rows), note=note)


def _cell(values: Sequence[float], decimals: int, sign: str = "") -> Cell:
    known = [value for value in values if not np.isnan(value)]
    interval = intervals.interval([np.array([value]) for value in known]) if len(known) > 1 else None
    return number(float(np.mean(known)) if known else None, decimals, interval, sign=sign)


def _label(row: Row, labels: Mapping[str, str]) -> str:
    light, method, count = row
    return ", ".join([light, *([f"{count:,}"] if count else []), labels[method]])


def _named(row: Row) -> str:
    return "/".join(map(str, row))


def _known(values):
    """The same with None for NaN, which JSON has not."""
    if isinstance(values, dict):
        return {name: _known(value) for name, value in values.items()}
    if isinstance(values, list):
        return [_known(value) for value in values]
    return None if isinstance(values, float) and np.isnan(values) else values
