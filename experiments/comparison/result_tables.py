"""A table of results, and its Markdown, LaTeX and CSV.

A cell is a text, smaller ones behind it (an interval), whether it stands out, and the number behind it, which the CSV
holds unrounded: a line a cell, with the title of its table, its row and its column.
"""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from tabulate import tabulate

from spnr_jax.scoring import intervals

SIGNS = {"\N{UPWARDS ARROW}": r"$\uparrow$", "\N{DOWNWARDS ARROW}": r"$\downarrow$", "\N{NO-BREAK SPACE}": "~"}
BOLD, SMALL, END = "\x01", "\x02", "\x03"  # stand for LaTeX commands until tabulate has escaped the texts


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A text, smaller ones behind it, whether it is to stand out; and the number and interval that it shows."""

    text: str
    small: tuple[str, ...] = ()
    best: bool = False
    value: float | None = None
    interval: tuple[float, float] | None = None


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
    value: float | None,
    decimals: int,
    interval: Sequence[float] | None = None,
    *,
    sign: str = "",
    factor: float = 1,
    missing: str = "n/a",
    best: bool = False,
    more: tuple[str, ...] = (),
) -> Cell:
    """A number (times a factor) and its interval; `sign` is "+" for differences, `more` stands behind the interval."""
    if value is None:
        return Cell(text=missing)
    form, small, ends = f"{sign},.{decimals}f", more, None
    if interval is not None:
        low, high = (factor * end for end in interval)
        small, ends = (f"[{low:{form}}, {high:{form}}]", *more), (low, high)
    return Cell(text=f"{factor * value:{form}}", small=small, best=best, value=factor * value, interval=ends)


def mean_row(
    label: str, objects: Sequence[Sequence[float | None]] | np.ndarray, decimals: Sequence[int], sign: str = ""
) -> tuple[str, tuple[Cell, ...]]:
    """A row of means of columns over objects, with intervals; None and NaN are left out."""
    cells = []
    for column, digits in zip(np.array(objects, float).T, decimals, strict=True):
        known = column[~np.isnan(column)]
        interval = intervals.interval([np.array([x]) for x in known]) if len(known) > 1 else None
        cells.append(number(float(known.mean()) if len(known) else None, digits, interval, sign=sign))
    return label, tuple(cells)


def markdown(tables: Sequence[Table], notes: Sequence[str] = ()) -> str:
    """The tables, and the notes as a list."""
    parts = []
    for table in tables:
        rows = [[name, *(_plain(cell, "**{}**", "{}") for cell in cells)] for name, cells in _filled(table)]
        body = _tabulated(table, rows, "pipe").replace("\N{NO-BREAK SPACE}", " ")
        parts.append("\n".join([f"### {table.title}", "", *([table.note, ""] if table.note else []), body, ""]))
    return "\n".join([*parts, *(f"- {line}" for line in notes)]).rstrip() + "\n"


def latex(tables: Sequence[Table], notes: Sequence[str] = ()) -> str:
    """The tables for LaTeX with the package booktabs; the notes are comments at the top."""
    parts = [*(f"% {line}" for line in notes), "% needs \\usepackage{booktabs}"]
    for table in tables:
        rows = [
            [name, *(_plain(cell, f"{BOLD}{{}}{END}", f"{SMALL}{{}}{END}") for cell in cells)]
            for name, cells in _filled(table)
        ]
        body = _tabulated(table, rows, "latex_booktabs")
        caption = tabulate([[f"{table.title}. {table.note}".strip()]], tablefmt="latex").splitlines()[2].rstrip(" \\")
        parts += [r"\begin{table}", r"\centering\footnotesize", rf"\caption{{{caption.strip()}}}", body, r"\end{table}"]
    made = "\n".join(parts) + "\n"
    for sign, command in SIGNS.items():
        made = made.replace(sign, command)
    made = re.sub(f"{BOLD}(.*?){END}", r"\\textbf{\1}", made)
    return re.sub(f"{SMALL}(.*?){END}", r"{\\tiny \1}", made)


def csv_text(tables: Sequence[Table]) -> str:
    """One line for each cell that shows a number."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["table", "row", "column", "value", "low", "high"])
    for table in tables:
        for name, cells in table.rows:
            for head, cell in zip(table.heads, cells, strict=False):
                if cell.value is not None:
                    column = head.replace("\N{NO-BREAK SPACE}", " ")
                    writer.writerow([table.title, name, column, cell.value, *(cell.interval or ("", ""))])
    return stream.getvalue()


def _filled(table: Table) -> list[tuple[str, tuple[Cell, ...]]]:
    """The rows with as many cells as there are heads; a row that could not be made has its reason alone."""
    empty = Cell(text="")
    return [(name, (*cells, *[empty] * (len(table.heads) - len(cells)))) for name, cells in table.rows]


def _plain(cell: Cell, bold: str, small: str) -> str:
    text = bold.format(cell.text) if cell.best else cell.text
    return " ".join([text, small.format(" ".join(cell.small))]) if cell.small else text


def _tabulated(table: Table, rows: Sequence[Sequence[str]], form: str) -> str:
    align = ("left", *["right"] * len(table.heads))
    return tabulate(rows, ("", *table.heads), tablefmt=form, disable_numparse=True, colalign=align)
