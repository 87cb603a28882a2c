"""Tables of results (spnr_jax/scoring/score_tables.py) as Markdown, LaTeX and CSV.

The CSV holds the numbers behind the cells unrounded: a line a cell, with the title of its table, its row and column.
"""

import csv
import io
import re
from collections.abc import Sequence

from tabulate import tabulate

from spnr_jax.scoring.score_tables import Cell, Table

SIGNS = {"\N{UPWARDS ARROW}": r"$\uparrow$", "\N{DOWNWARDS ARROW}": r"$\downarrow$", "\N{NO-BREAK SPACE}": "~"}
BOLD, SMALL, END = "\x01", "\x02", "\x03"  # stand for LaTeX commands until tabulate has escaped the texts


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
