"""Text files of points (.xyz .txt .csv) as named columns, piece by piece.

Numbers are separated by commas, semicolons or blanks.  A header line names the columns, also behind # or //; without
one their number, and for normals their values, tell:

    3 x y z | 4 + intensity | 6 + r g b, or + nx ny nz if these have length 1 | 8 + r g b roughness metallic
    9 + r g b and nx ny nz in either order

Every fault is a ValueError that says what is wrong with the file; its name is added by the caller.
"""

import re
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError

Columns = dict[str, np.ndarray]

POSITION, COLOR, NORMAL = ("x", "y", "z"), ("r", "g", "b"), ("nx", "ny", "nz")
PLAIN_COLUMNS = {3: POSITION, 4: (*POSITION, "intensity"), 8: (*POSITION, *COLOR, "roughness", "metallic")}
NUMBERS = "fiu"  # kinds of types that hold real numbers
UNIT_LENGTH = 0.02  # how far from 1 the length of a normal may be
COMMENTS = ("#", "//")
PIECE_LINES = 2**17  # in memory at a time


def text_pieces(path: Path) -> Iterator[Columns]:
    """The columns of a text file, some points at a time; the last line before the numbers may name them."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header, is_comment, first = _header(file)
        lines = (text for line in chain([first], file) if (text := line.strip()) and not text.startswith(COMMENTS))
        names: tuple[str, ...] = ()
        delimiter = next((mark for mark in ";," if mark in first), None)
        while rows := list(islice(lines, PIECE_LINES)):
            table = np.loadtxt(rows, delimiter=delimiter, comments=None, ndmin=2)
            names = names or _names(header, is_comment, table)
            if len(names) != table.shape[1]:
                raise UserError(f"the number of columns changed from {len(names)} to {table.shape[1]}")
            yield dict(zip(names, table.T, strict=True))


def _header(lines: Iterator[str]) -> tuple[str, bool, str]:
    """What stands before the numbers last, whether as a comment, and the first line of numbers ("" if none)."""
    header, is_comment = "", True
    for line in lines:
        text = re.sub(r"^(#|//)\s*", "", line.strip())
        if text and not _is_number(_split(text)[0]):
            header, is_comment = text, text != line.strip()
        elif text and text == line.strip():
            return header, is_comment, line
    return header, is_comment, ""


def _names(header: str, is_comment: bool, table: np.ndarray) -> tuple[str, ...]:
    """Names of the columns of a table from its header, or if that is a remark, from the numbers."""
    names = tuple(name.strip("\"'").lower() for name in _split(header.strip(",; \t")))
    if is_comment and ("x" not in names or len(names) != table.shape[1]):
        return plain_names(table)
    if len(names) != table.shape[1]:
        raise UserError(f"names {len(names)} columns ({' '.join(names)}) above {table.shape[1]} columns of numbers")
    return names


def plain_names(table: np.ndarray) -> tuple[str, ...]:
    """Names of the columns of a table (points, columns) that has none."""
    if table.ndim == 2 and table.dtype.kind in NUMBERS:
        count = table.shape[1]
        if count in PLAIN_COLUMNS:
            return PLAIN_COLUMNS[count]
        if count == 6:
            return (*POSITION, *(NORMAL if _are_normals(table[:, 3:]) else COLOR))
        if count == 9:
            rest = (*NORMAL, *COLOR) if _are_normals(table[:, 3:6]) else (*COLOR, *NORMAL)
            return (*POSITION, *rest)
    raise UserError(
        f"has numbers of shape {table.shape} and type {table.dtype} without column names; expected rows of 3, 4, 6, 8 "
        "or 9 numbers (x y z; + intensity; + r g b; + r g b roughness metallic; + r g b nx ny nz), or a header line "
        "that names the columns"
    )


def _are_normals(vectors: np.ndarray) -> bool:
    """Whether vectors (n, 3) have length 1, up to rounding, and are not all in the octant of colours."""
    lengths = np.linalg.norm(np.asarray(vectors, np.float64), axis=-1)
    return bool((vectors < 0).any() and np.median(np.abs(lengths - 1)) < UNIT_LENGTH)


def _split(line: str) -> list[str]:
    return re.split(r"[\s,;]+", line)


def _is_number(text: str) -> bool:
    return (
        re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", text, re.IGNORECASE) is not None
    )
