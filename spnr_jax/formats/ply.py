"""PLY files as named columns of their vertices, piece by piece: ASCII or binary, any order and scalar types.

A header of text lines names the elements and their properties; the vertices may stand behind other elements.  Lists,
in or before the vertices, are stepped over, one row at a time.  Only one piece of a file is in memory at a time.  Every
fault is a ValueError that says what is wrong; the file's name is added by the caller.
"""

import re
from collections.abc import Iterator
from io import BufferedIOBase
from itertools import islice
from typing import NamedTuple

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import Columns
from spnr_jax.formats.text import SHOWN

Lists = tuple[str, str]  # types of a list's length and of its items
Element = tuple[str, int, list[tuple[str, str | Lists]]]  # name, count, [(property, type)]

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
BYTE_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
HEADER_LIMIT = 2**20  # bytes
FACES = ("face", "tristrips")  # elements that make a PLY a mesh
LONGEST_LIST = 2**20  # items
PIECE_BYTES, PIECE_LINES = 2**25, 2**17  # of the vertices that are in memory at a time


class PlyHeader(NamedTuple):
    """What a PLY file announces; byte_order is None in a text file."""

    byte_order: str | None
    elements: list[Element]  # in the order of the file

    @property
    def is_mesh(self) -> bool:
        """Whether there are faces."""
        return any(name in FACES and count for name, count, _ in self.elements)


def read_ply_header(file: BufferedIOBase) -> PlyHeader:
    """The header of an open PLY file, which is left at its data."""
    data = file.read(HEADER_LIMIT)
    newline = re.search(rb"\r\n|\n|\r", data[:HEADER_LIMIT])
    # lines that end in \r alone may be followed by a byte of data that is a \n
    end = re.search(rb"(?<=[\r\n])end_header[ \t]*" + newline[0], data) if newline else None
    if not data.startswith(b"ply") or end is None:
        raise UserError("is not a PLY file, or its header is cut off (expected 'ply' ... 'end_header')")
    byte_order: str | None = "unknown"
    elements: list[Element] = []
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", name, _]:
                byte_order = BYTE_ORDERS.get(name, "unknown")
            case ["element", name, count] if count.isdecimal():
                elements.append((name, int(count), []))
            case ["property", "list", length, items, name] if elements and {length, items} <= TYPES.keys():
                elements[-1][2].append((name, (TYPES[length], TYPES[items])))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append((name, TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise UserError(f"has a PLY header line that is not understood: {line.strip()!r}")
    if byte_order == "unknown":
        raise UserError(f"has a PLY header without a known format; expected one of {', '.join(BYTE_ORDERS)}")
    file.seek(end.end())
    return PlyHeader(byte_order, elements)


def element_pieces(file: BufferedIOBase, wanted: str = "vertex") -> Iterator[Columns]:
    """The columns of an element of an open PLY file, some rows at a time; elements before it are skipped."""
    header = read_ply_header(file)
    for name, count, properties in header.elements:
        if name == wanted:
            rows = _element_rows(file, count, properties, header.byte_order)
            yield from ({field.lower(): piece[field] for field in piece.dtype.names or ()} for piece in rows)
            return
        if header.byte_order is None:
            for _ in islice((line for line in iter(file.readline, b"") if line.strip()), count):
                pass
        else:
            for _ in _element_rows(file, count, properties, header.byte_order):
                pass
    names = ", ".join(name for name, _, _ in header.elements)
    raise UserError(f"has no PLY element {wanted!r}, only {names or 'none'}")


def _element_rows(
    file: BufferedIOBase, count: int, properties: list[tuple[str, str | Lists]], order: str | None
) -> Iterator[np.ndarray]:
    """The records of an element, some at a time, without their lists; the file is left behind them."""
    layout = np.dtype([(field, (order or "=") + kind) for field, kind in properties if isinstance(kind, str)])
    if not layout.names and properties and order is None:
        raise UserError("has only lists in its PLY element: no numbers of points")
    if order is None:
        lines = (text for line in iter(file.readline, b"") if (text := line.decode("ascii", "replace").strip()))
        if any(not isinstance(kind, str) for _, kind in properties):
            lines = (" ".join(_without_lists(line.split(), properties)) for line in lines)
        yield from text_rows(lines, count, layout)
    elif all(isinstance(kind, str) for _, kind in properties):
        yield from binary_rows(file, count, layout)
    else:
        yield from _rows_with_lists(file, count, properties, layout, order)


def _without_lists(words: list[str], properties: list[tuple[str, str | Lists]]) -> list[str]:
    """The words of a row of text that stand for single numbers."""
    kept, place = [], 0
    for _, kind in properties:
        if isinstance(kind, str):
            kept += words[place : place + 1]
            place += 1
        elif place < len(words):
            place += 1 + (int(words[place]) if words[place].isdecimal() else 0)
    return kept


def _rows_with_lists(
    file: BufferedIOBase, count: int, properties: list[tuple[str, str | Lists]], layout: np.dtype, order: str
) -> Iterator[np.ndarray]:
    """`count` binary records that lists make of different lengths."""
    for start in range(0, max(1, count), PIECE_LINES):
        rows = []
        for number in range(start, min(count, start + PIECE_LINES)):
            row = []
            for _, kind in properties:
                length, items = (kind, kind) if isinstance(kind, str) else kind
                data = file.read(np.dtype(length).itemsize)
                if len(data) < np.dtype(length).itemsize:
                    raise UserError(f"is cut off: its header announces {count} rows, the data ends after {number}")
                if isinstance(kind, str):
                    row.append(data)
                    continue
                size = int(np.frombuffer(data, order + length)[0])
                if not 0 <= size <= LONGEST_LIST:
                    raise UserError(f"has a list of {size} items in row {number} of a PLY element: broken file")
                file.seek(size * np.dtype(items).itemsize, 1)
            rows.append(b"".join(row))
        yield np.frombuffer(b"".join(rows), layout, len(rows)) if layout.names else np.empty(len(rows), layout)


def camera_row(file: BufferedIOBase) -> dict[str, float]:
    """The numbers of the camera that an open PLY file begins with, by their names; none if it begins with another."""
    if [name for name, _, _ in read_ply_header(file).elements][:1] != ["camera"]:
        return {}
    file.seek(0)
    return {name: float(column[0]) for name, column in next(element_pieces(file, "camera")).items() if len(column)}


def text_rows(lines: Iterator[str], count: int, layout: np.dtype) -> Iterator[np.ndarray]:
    """`count` records from as many lines of text, some at a time."""
    found = 0
    while found < count:
        rows = list(islice(lines, min(PIECE_LINES, count - found)))
        found += len(rows)
        if not rows or (len(rows) < PIECE_LINES and found < count):
            raise UserError(f"is cut off: its header announces {count} points, the data ends after {found}")
        try:
            yield np.loadtxt(rows, dtype=layout, comments=None, ndmin=1)
        except ValueError:
            wanted = len(layout.names or ())
            for place, row in enumerate(rows, found - len(rows)):
                try:
                    np.loadtxt([row], dtype=layout, comments=None, ndmin=1)
                except ValueError:
                    raise UserError(f"point {place}: expected {wanted} numbers, found {row[:SHOWN]!r}") from None
            raise
    if not count:
        yield np.empty(0, layout)


def binary_rows(file: BufferedIOBase, count: int, layout: np.dtype) -> Iterator[np.ndarray]:
    """`count` records of binary data from the file's place on, some at a time."""
    size, found = layout.itemsize, 0
    if not size:
        yield np.empty(0, layout)
        return
    while found < count:
        wanted = min(max(1, PIECE_BYTES // size), count - found)
        data = file.read(wanted * size)
        if len(data) < wanted * size:
            raise UserError(
                f"is cut off: its header announces {count} points, the data ends after {found + len(data) // size}"
            )
        yield np.frombuffer(data, layout, wanted)
        found += wanted
    if not count:
        yield np.empty(0, layout)
