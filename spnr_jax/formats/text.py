"""Text files of points (.xyz .txt .csv .asc .pts) as named columns, piece by piece.

Numbers are separated by commas, semicolons or blanks, also behind the last one; a decimal comma is told by that nothing
else separates there.  Lines of one whole number count the points.  A header line names the columns, also behind # or
//, with units in brackets; a column without a name is a table's index.  Without a header the number of columns tells,
and for normals their values:

    3 x y z | 4 + intensity | 6 + r g b, or + nx ny nz if these have length 1 | 7 + r g b alpha or intensity r g b
    8 + r g b roughness metallic | 9 + r g b and nx ny nz in either order

Every fault is a ValueError that says what is wrong with the file, and in which line; its name is added by the caller.
"""

import re
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import Columns

Line = tuple[int, str]  # its number in the file, from 1, and its text

POSITION, COLOR, NORMAL = ("x", "y", "z"), ("r", "g", "b"), ("nx", "ny", "nz")
PLAIN_COLUMNS = {3: POSITION, 4: (*POSITION, "intensity"), 8: (*POSITION, *COLOR, "roughness", "metallic")}
OPAQUE = (1, 255, 65535)  # what an alpha is where nobody thought of it
NUMBERS = "fiu"  # kinds of types that hold real numbers
UNIT_LENGTH = 0.02  # how far from 1 the length of a normal may be
COMMENTS = ("#", "//")
PIECE_LINES = 2**17  # in memory at a time
SHOWN = 60  # characters of a line that an error shows
LONGEST_HEADER = 4096  # characters in which names are looked for
NUMBER = r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)"
WITH_COMMA = r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?"
INDEX = "index"  # the name of a column that only counts


class Layout(NamedTuple):
    """How a file writes its rows: what separates numbers (None: blanks), and whether commas are decimal points."""

    delimiter: str | None
    decimal_comma: bool

    def plain(self, text: str) -> str:
        """A row with decimal points, without separators behind the last number."""
        text = text.rstrip(" \t" + (self.delimiter or ""))
        return text.replace(",", ".") if self.decimal_comma else text


def text_pieces(path: Path) -> Iterator[Columns]:
    """The columns of a text file, some points at a time; the last line before the numbers may name them."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        numbered = ((number, line.strip()) for number, line in enumerate(file, 1))
        header, is_comment, first = _header(numbered)
        layout = _layout(first[1])
        lines = (
            (number, plain)
            for number, text in chain([first], numbered)
            if not text.startswith(COMMENTS) and not text.isdecimal() and (plain := layout.plain(text))
        )
        names: tuple[str, ...] = ()
        while rows := list(islice(lines, PIECE_LINES)):
            table = _table(rows, layout)
            names = names or _names(header, is_comment, table, layout)
            if len(names) != table.shape[1]:
                number, text = rows[0]
                raise UserError(f"line {number}: expected {len(names)} numbers as before, found {text[:SHOWN]!r}")
            yield {name: column for name, column in zip(names, table.T, strict=True) if name != INDEX}


def _header(lines: Iterator[Line]) -> tuple[str, bool, Line]:
    """What stands before the numbers last, whether as a comment, and the first row of numbers (0, "" if none)."""
    header, is_comment = "", True
    for number, line in lines:
        text = re.sub(r"^(#|//)\s*", "", line)
        first = re.split(r"[\s;]+", text)[0]
        if text and not re.fullmatch(NUMBER, first.split(",")[0], re.IGNORECASE):
            header, is_comment = text[:LONGEST_HEADER], text != line
        elif text and text == line and not text.isdecimal():
            return header, is_comment, (number, line)
    return header, is_comment, (0, "")


def _layout(row: str) -> Layout:
    """How a row of numbers is written."""
    delimiter = next((mark for mark in ";," if mark in row), None)
    parts = row.strip("; \t").split(";") if delimiter == ";" else row.split()
    comma = len(parts) > 2 and "," in row and all(re.fullmatch(WITH_COMMA, part.strip()) for part in parts if part)
    return Layout(delimiter if delimiter == ";" or not comma else None, comma)


def _table(rows: Sequence[Line], layout: Layout) -> np.ndarray:
    """Numbers (rows, columns); ValueError names the first line that is not like the first one."""
    try:
        return np.loadtxt([text for _, text in rows], delimiter=layout.delimiter, comments=None, ndmin=2)
    except ValueError:
        count = len(rows[0][1].split(layout.delimiter))
        for number, text in rows:
            values = [value.strip() for value in text.split(layout.delimiter)]
            if len(values) != count or not all(re.fullmatch(NUMBER, value, re.IGNORECASE) for value in values):
                raise UserError(f"line {number}: expected {count} numbers, found {text[:SHOWN]!r}") from None
        raise


def _names(header: str, is_comment: bool, table: np.ndarray, layout: Layout) -> tuple[str, ...]:
    """Names of the columns of a table from its header, or if that is a remark, from the numbers."""
    count = table.shape[1]
    plain = re.sub(r"[(\[][^)\]]*[)\]]", "", header)  # units
    marks = [rf"\s*{mark}\s*" for mark in ";," if mark in plain]
    found = [[name.strip("\"' \t").lower() for name in re.split(mark, plain)] for mark in (*marks, r"[\s,;]+")]
    for names in found:
        while len(names) > count and not names[-1]:
            names.pop()
        if len(names) == count - 1 and "x" in names and len(table) > 1 and np.all(np.diff(table[:, 0]) == 1):
            names.insert(0, "")  # as R writes a table
    names = next((names for names in found if len(names) == count), found[-1])
    if is_comment and ("x" not in names or len(names) != count):
        return plain_names(table)
    if len(names) != count:
        raise UserError(f"names {len(names)} columns ({' '.join(names)}) above {count} columns of numbers")
    return tuple(name or INDEX for name in names)


def plain_names(table: np.ndarray) -> tuple[str, ...]:
    """Names of the columns of a table (points, columns) that has none."""
    if table.ndim == 2 and table.dtype.kind in NUMBERS:
        count = table.shape[1]
        if count in PLAIN_COLUMNS:
            return PLAIN_COLUMNS[count]
        if count == 6:
            return (*POSITION, *(NORMAL if _are_normals(table[:, 3:]) else COLOR))
        if count == 7:
            alpha_last = np.isin(table[:, 6], OPAQUE).all() or (table[:, 3:].min() >= 0 and table[:, 3:].max() <= 1)
            return (*POSITION, *((*COLOR, "alpha") if alpha_last else ("intensity", *COLOR)))
        if count == 9:
            rest = (*NORMAL, *COLOR) if _are_normals(table[:, 3:6]) else (*COLOR, *NORMAL)
            return (*POSITION, *rest)
    raise UserError(
        f"has numbers of shape {table.shape} and type {table.dtype} without column names; expected rows of 3, 4, 6, 7, "
        "8 or 9 numbers (x y z; + intensity; + r g b; + r g b alpha; + r g b roughness metallic; + r g b nx ny nz), or "
        "a header line that names the columns"
    )


def _are_normals(vectors: np.ndarray) -> bool:
    """Whether vectors (n, 3) have length 1, up to rounding, and are not all in the octant of colours."""
    lengths = np.linalg.norm(np.asarray(vectors, np.float64), axis=-1)
    return bool((vectors < 0).any() and np.median(np.abs(lengths - 1)) < UNIT_LENGTH)
