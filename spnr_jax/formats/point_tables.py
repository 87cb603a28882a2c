"""Tables of points as named columns, piece by piece: text (.xyz .txt .csv .asc .pts) and NumPy files (.npz .npy).

Numbers of text are separated by commas, semicolons or blanks, also behind the last one; a decimal comma is told by that
nothing else separates there.  Lines of one whole number count the points.  A header line names the columns, also behind
#, % or //, with units in brackets; a column without a name is a table's index.  Without a header the number of columns
tells, behind one that only counts, and for normals and colours their values:

    3 x y z | 4 + intensity | 6 + r g b, or + nx ny nz if these have length 1 | 7 + r g b alpha, r g b and any number,
    or intensity r g b (where both could be, in .pts alone) | 8 + r g b roughness metallic
    9 + r g b and nx ny nz in either order

    .npz    arrays (points, 3) or (points,) under the names of ARRAY_COLUMNS; beside a first one without a name,
            those that look like colours or normals; they come whole where they are compressed
    .npy    a structured array of named fields, or an array (points, columns) or (height, width, columns) as in text

Pickled objects, which could run code, are refused.  Every fault is a ValueError that says what is wrong with the file,
of text also in which line; its name is added by the caller.
"""

import contextlib
import io
import re
import threading
import warnings
from collections.abc import Collection, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats.columns import NORMAL, POSITION, Columns, Report, list_names

Line = tuple[int, str]  # its number in the file, from 1, and its text

COLOR = ("r", "g", "b")
OPAQUE = (1, 255, 65535)  # what an alpha is where nobody thought of it
NUMBERS = "fiu"  # kinds of types that hold real numbers
UNIT_LENGTH = 0.02  # how far from 1 the length of a normal may be
PIECE_LINES, PIECE_BYTES = 2**17, 2**25  # of text and of an array in memory at a time
SHOWN, LONGEST_HEADER = 60, 4096  # characters of a line that an error shows, and in which names are looked for
COMMENTS = ("#", "//", "%")
NUMBER = re.compile(r"[+-]?((\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|nan|inf(inity)?)", re.IGNORECASE)
WITH_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?")
EMPTY = re.compile(r"(?<=[,;])\s*(?=[,;]|$)")  # a number that was not known
UNDEFINED = re.compile(r"[+-]?(nan\([a-z]*\)|1\.#\w+)", re.IGNORECASE)  # as the libraries of Windows write it
UNITS = re.compile(r"[(\[][^)\]]*[)\]]")
UTF_16 = (b"\xff\xfe", b"\xfe\xff")  # byte order marks
INDEX = "index"  # the name of a column that only counts
MOST_BYTES = 2**31  # of an archive's arrays when unpacked: a small file can announce any number
PARSER = threading.Lock()  # Python's, which NumPy reads headers with, fails in two threads at once (gh-106905)
UNNAMED = tuple(f"arr_{i}" for i in range(9))  # names by np.savez of arrays that were given none
ARRAY_COLUMNS = {
    **dict.fromkeys(
        ("positions", "points", "xyz", "vertices", "pc", "pcd", "pos", "coord", "coords", "arr_0"), POSITION
    ),
    **dict.fromkeys(("base_color", "albedo"), ("base_color_r", "base_color_g", "base_color_b")),
    **dict.fromkeys(("colors", "rgb", "color"), COLOR),
    **{name: (name,) for name in (*POSITION, *COLOR, *NORMAL, "red", "green", "blue", "intensity", "roughness")},
    **dict.fromkeys(("metallic", "metalness"), ("metallic",)),
    **dict.fromkeys(("normals", "normal"), NORMAL),
}


def text_pieces(path: Path, report: Report) -> Iterator[Columns]:
    """The columns of a text file, some points at a time; the last line before the numbers may name them."""
    with open_text(path) as file:
        numbered = ((number, line.strip().replace('"', "")) for number, line in enumerate(file, 1))
        header, is_comment, announced, first = _header(numbered)
        if not first[1]:
            raise UserError(f"holds 0 points: no row of numbers, only {header[:SHOWN]!r}")
        delimiter = next((mark for mark in ";," if mark in first[1]), None)
        parts = first[1].split()
        if delimiter == "," and len(parts) > 2 and all(map(WITH_COMMA.fullmatch, parts)):
            delimiter = None  # these are decimal commas
        trailing = ""  # separators behind the last number, which are none before one that is not known
        if delimiter and first[1].endswith(delimiter):
            of_header = header.rstrip(delimiter).count(delimiter)
            trailing = delimiter if of_header != first[1].count(delimiter) else ""

        def rows_of_numbers() -> Iterator[Line]:
            nonlocal announced
            for number, text in chain([first], numbered):
                if text.isdecimal():
                    announced += int(text[:SHOWN])
                elif not text.startswith(COMMENTS) and (plain := _plain(text, delimiter, trailing)):
                    yield number, plain

        lines = rows_of_numbers()
        names: tuple[str, ...] = ()
        found = 0
        while rows := list(islice(lines, PIECE_LINES)):
            words = rows[0][1].split(delimiter)
            count, found = len(names) or len(words), found + len(rows)
            table = load_text(rows, "line", count, delimiter, ndmin=2)
            names = names or _names(header, is_comment, table, path.suffix.lower() == ".pts", report)
            yield {name: column for name, column in zip(names, table.T, strict=True) if name != INDEX}
        if announced and announced != found:
            end = ": is the file cut off?" if announced > found else ""
            report(f"a line of the file announces {announced:,} points, {found:,} are there{end}")


def open_text(path: Path) -> TextIO:
    """A text file in UTF-8 or UTF-16."""
    with path.open("rb") as file:
        encoding = encoding_of(file.read(2))
    return path.open(encoding=encoding, errors="replace")


def encoding_of(head: bytes) -> str:
    """The encoding of text that begins so."""
    return "utf-16" if head[:2] in UTF_16 else "utf-8-sig"


def _plain(text: str, delimiter: str | None, trailing: str) -> str:
    """A row with decimal points, without separators behind the last number."""
    text = text.rstrip(" \t" + trailing)
    text = EMPTY.sub("nan", text) if delimiter else text
    return text if delimiter == "," else text.replace(",", ".")


def _header(lines: Iterator[Line]) -> tuple[str, bool, int, Line]:
    """What stands before the numbers: names or the last remark, whether as a comment, and a count of points.

    Then the first row of numbers (0, "" if there is none).
    """
    header, is_comment, announced = "", True, 0
    for number, line in lines:
        text = re.sub(r"^(#|//|%)\s*", "", line)
        words = re.split(r"[\s;,]+", text[:LONGEST_HEADER])
        if text and not NUMBER.fullmatch(words[0]):
            named = "x" in _split_names(header, r"[\s,;]+") and "x" not in map(str.lower, words)
            if re.search(r"\w", UNITS.sub("", text[:LONGEST_HEADER])) and not (named and text == line):
                header, is_comment = text[:LONGEST_HEADER], text != line
        elif words[0].isdecimal() and len(words) < (3 if text == line else 2):  # and perhaps of columns
            announced = max(announced, int(words[0]))
        elif text and text == line and words != list(map(str, range(len(words)))):  # as pandas names an array's
            return header, is_comment, announced, (number, line)
    return header, is_comment, announced, (0, "")


def _split_names(header: str, mark: str) -> list[str]:
    """The names in a header, in small letters, without units."""
    return [name.strip("\"' \t").lower() for name in re.split(mark, UNITS.sub("", header))]


def load_text(rows: Sequence[Line], what: str, count: int, delimiter: str | None = None, **layout: Any) -> np.ndarray:
    """Numbers of numbered rows of `count` numbers; ValueError names the first, a `what`, that holds others.

    Undefined numbers of every kind are NaN.
    """

    def load(texts: list[str]) -> np.ndarray:
        table = np.loadtxt(texts, delimiter=delimiter, comments=None, **layout)
        if "dtype" not in layout and table.shape[1] != count:
            raise ValueError
        return table

    texts = [text for _, text in rows]
    with contextlib.suppress(ValueError):
        return load(texts)
    texts = [UNDEFINED.sub("nan", text) for text in texts]
    with contextlib.suppress(ValueError):
        return load(texts)
    for (number, text), plain in zip(rows, texts, strict=True):
        try:
            load([plain])
        except ValueError:
            raise UserError(f"{what} {number}: expected {count} numbers, found {text[:SHOWN]!r}") from None
    raise UserError(f"{what} {rows[0][0]}: expected {count} numbers in each row")


def _names(header: str, is_comment: bool, table: np.ndarray, intensity_first: bool, report: Report) -> tuple[str, ...]:
    """Names of the columns of a table from its header, or if that is a remark, from the numbers."""
    count, names = table.shape[1], [""]
    for mark in (*(mark for mark in ";," if mark in UNITS.sub("", header)), r"[\s,;]+"):
        names = _split_names(header, mark)
        while len(names) > count and not names[-1]:
            names.pop()
        if len(names) == count - 1 and "x" in names and len(table) > 1 and np.all(np.diff(table[:, 0]) == 1):
            names.insert(0, "")  # as R writes a table
        if len(names) == count:
            break
    known, fits = "x" in names, len(names) == count
    if not (known and fits) and (is_comment or not (known or fits)):  # a remark
        return plain_names(table, report, intensity_first)
    if not fits:
        raise UserError(f"names {len(names)} columns ({' '.join(names)}) above {count} columns of numbers")
    return tuple(INDEX if not name or name in names[:number] else name for number, name in enumerate(names))


def plain_names(table: np.ndarray, report: Report, intensity_first: bool = False) -> tuple[str, ...]:
    """Names of the columns of a table (points, columns) that has none.

    `intensity_first` tells where both the first and the last three of four numbers could be a colour.
    """
    count = table.shape[1] if table.ndim == 2 and table.dtype.kind in NUMBERS else 0
    steps = np.diff(table[:, 0].astype(np.float64)) if 3 < count < 11 and len(table) > 2 else np.zeros(1)
    timed = count in (4, 7, 10) and steps.min() > 0 and steps.std() < steps.mean() / 2
    if timed or np.all(steps == 1):
        report("the first column, which grows steadily, taken as a number or a time of each point")
        return (INDEX, *plain_names(table[:, 1:], report, intensity_first))
    if count and (known := np.isfinite(table).all(axis=1)).any():
        table = table[known]
    first = NORMAL if count in (6, 7, 9) and _are_normals(table[:, 3:6]) else COLOR
    more = {3: (), 4: ("intensity",), 6: first, 8: (*COLOR, "roughness", "metallic")}
    more[9] = (*first, *(NORMAL if first == COLOR else COLOR))
    if count == 7:
        last, starts, ends = table[:, 6], _are_colors(table[:, 3:6]), _are_colors(table[:, 4:])
        share = table[:, 3:].min() >= 0 and table[:, 3:].max() <= 1 and np.median(last) == 1 and (last % 1).any()
        color_first = first == NORMAL or (starts and not (ends and intensity_first))
        more[7] = (*first, "scalar") if color_first else ("intensity", *COLOR)
        more[7] = (*COLOR, "alpha") if share or (first == COLOR and np.isin(last, OPAQUE).all()) else more[7]
    if count > 6 and count in more:
        report(f"the {count} columns, which have no names, taken as {' '.join((*POSITION, *more[count]))}")
    if count not in more:
        raise UserError(
            f"has numbers of shape {table.shape} and type {table.dtype} without column names; expected rows of 3, 4, "
            "6, 7, 8 or 9 numbers (x y z; + intensity; + r g b; + r g b alpha; + r g b roughness metallic; + r g b and "
            "nx ny nz), or a header line that names the columns"
        )
    return (*POSITION, *more[count])


def _are_normals(vectors: np.ndarray) -> bool:
    """Whether vectors (n, 3) have length 1, up to rounding, and are not all in the octant of colours."""
    lengths = np.linalg.norm(np.asarray(vectors, np.float64), axis=-1)
    return bool((vectors < 0).any() and np.median(np.abs(lengths - 1)) < UNIT_LENGTH)


def _are_colors(values: np.ndarray) -> bool:
    """Whether values (n, 3) are 0 to 1, or whole ones of at most 16 bits, and no channel outshines the others."""
    highest = values.max(axis=0)
    whole = highest.max() <= OPAQUE[-1] and np.all(values % 1 == 0)
    return bool(values.min() >= 0 and highest.min() >= highest.max() / 16 and (whole or highest.max() <= 1))


# --- NumPy ------------------------------------------------------------------------------------------------------------


def numpy_pieces(path: Path, report: Report) -> Iterator[Columns]:
    """The columns of an array, some points at a time, or of an archive."""
    with path.open("rb") as file:
        magic = file.read(6)
        file.seek(0)
        if magic.startswith(b"PK"):
            yield _name_columns(read_arrays(file, (*ARRAY_COLUMNS, *UNNAMED[1:]), report), report)
            return
    if not magic.startswith(b"\x93NUMPY"):
        raise UserError("is not a NumPy file")
    advice = "save arrays, as np.savez(file, points=..., colors=...)"
    with refusing(f"is a broken, truncated or pickled NumPy file: {advice}"), _parsing():
        rows = np.atleast_1d(np.lib.format.open_memmap(path, mode="r"))
    if rows.ndim == 3 and rows.dtype == np.uint8:
        raise UserError(f"has the shape {rows.shape} and the bytes of a picture; expected points")
    if rows.ndim == 3 and rows.dtype.kind in NUMBERS:
        if min(rows.shape[:2]) > 1:
            report(
                f"an array of {' x '.join(map(str, rows.shape))} taken as one cloud; of a batch, save array[0] alone"
            )
        rows = rows.reshape(-1, rows.shape[2])
    elif rows.dtype.names:
        rows = rows.reshape(-1)
    names = rows.dtype.names or plain_names(rows[:PIECE_LINES], report)
    step = max(1, PIECE_BYTES // max(1, rows[:1].nbytes))
    for start in range(0, max(1, len(rows)), step):
        piece = np.array(rows[start : start + step])
        named = zip(names, [piece[name] for name in names] if rows.dtype.names else piece.T, strict=True)
        yield {name.lower(): column for name, column in named if column.dtype.kind in NUMBERS + "b"}


def pack_arrays(arrays: dict[str, np.ndarray], *, compressed: bool = False) -> bytes:
    """An .npz archive of arrays by their names."""
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def read_arrays(
    file: io.BufferedIOBase, wanted: Collection[str] | None = None, report: Report = lambda line: None
) -> dict[str, np.ndarray]:
    """The arrays of an .npz archive, those that are wanted; ValueError if it is broken or unpacks to too much.

    `report` gets a line about the others.
    """
    with refusing("is a broken or truncated NumPy file"), _parsing(), np.load(file, allow_pickle=False) as archive:
        names = [name for name in archive.files if wanted is None or name in wanted]
        sizes = {info.filename.removesuffix(".npy"): info.file_size for info in archive.zip.infolist()}
        if (unpacked := sum(sizes[name] for name in names)) > MOST_BYTES:
            raise UserError(f"unpacks to {unpacked} bytes, more than {MOST_BYTES}; use .npy, which is read in pieces")
        try:
            arrays = {name: np.asarray(archive[name]) for name in names}
        except MemoryError:  # a header can announce any number
            raise UserError("announces more than fits into the memory") from None
    if others := [name for name in sizes if name not in names]:
        report(f"arrays that are not used: {list_names(others)}")
    if not arrays:
        raise UserError(f"has none of the arrays {', '.join(wanted or ())}; found {', '.join(sizes) or 'none'}")
    return arrays


@contextlib.contextmanager
def _parsing() -> Iterator[None]:
    """Headers are read by one thread at a time; NumPy warns of those of Python 2, which it reads well."""
    with PARSER, warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*required additional header parsing", UserWarning)
        yield


def _name_columns(archive: dict[str, np.ndarray], report: Report) -> Columns:
    """The columns of arrays (points, c), or (points,) for scalars, under the names of ARRAY_COLUMNS."""
    columns: Columns = {}
    if unnamed := [archive.pop(name) for name in UNNAMED if name in archive]:
        first, *others = unnamed
        shapes = [(len(first), width) for width in (3, 4)] if first.ndim == 2 and len(first) else []
        tables = [array for array in others if array.shape in shapes and array.dtype.kind in NUMBERS]
        beside = [table for table in tables if _are_colors(table[:, :3]) or _are_normals(table[:, :3])]
        archive[UNNAMED[0]] = np.concatenate([first, *beside], axis=1) if beside else first
    for name, array in archive.items():
        targets, table = ARRAY_COLUMNS[name], array[:, None] if array.ndim == 1 else array
        if targets == COLOR and table.shape[1:] == (4,):
            targets = (*COLOR, "alpha")
        if targets == POSITION and table.shape[1:] != (3,):
            targets = plain_names(table, report)
        if table.ndim != 2 or table.shape[1] != len(targets) or table.dtype.kind not in NUMBERS:
            raise UserError(f"has {name!r} of shape {array.shape} and type {array.dtype}, not (points, {len(targets)})")
        columns |= dict(zip(targets, table.T, strict=True))
    if len({len(column) for column in columns.values()}) > 1:
        raise UserError(f"has arrays of different lengths: { {name: len(array) for name, array in columns.items()} }")
    return columns
