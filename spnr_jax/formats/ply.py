"""PLY files as named columns of their vertices, piece by piece: ASCII or binary, any order and scalar types.

A header of text lines names the elements and their properties; the vertices may stand behind other elements, but not
behind lists.  Only one piece of a file is in memory at a time.  Every fault is a ValueError that says what is wrong;
the file's name is added by the caller.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedIOBase
from itertools import islice
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError

Columns = dict[str, np.ndarray]
Element = tuple[str, int, list[tuple[str, str | None]]]  # name, count, [(property, type)]; the type of a list is None

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
BYTE_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
HEADER_LIMIT = 2**20  # bytes
FACES = ("face", "tristrips")  # elements that make a PLY a mesh
PIECE_BYTES, PIECE_LINES = 2**25, 2**17  # of the vertices that are in memory at a time


@dataclass(frozen=True, kw_only=True)
class PlyHeader:
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
    end = re.search(rb"^end_header[ \t]*(\r\n|\n|\r)", data, re.MULTILINE)
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
            case ["property", "list", _, _, name] if elements:
                elements[-1][2].append((name, None))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append((name, TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise UserError(f"has a PLY header line that is not understood: {line.strip()!r}")
    if byte_order == "unknown":
        raise UserError(f"has a PLY header without a known format; expected one of {', '.join(BYTE_ORDERS)}")
    file.seek(end.end())
    return PlyHeader(byte_order=byte_order, elements=elements)


def ply_pieces(path: Path) -> Iterator[Columns]:
    """The columns of the vertices of a PLY file, some points at a time."""
    with path.open("rb") as file:
        yield from vertex_pieces(file)


def vertex_pieces(file: BufferedIOBase) -> Iterator[Columns]:
    """The columns of the vertices of an open PLY file, some points at a time; elements before them are skipped."""
    header = read_ply_header(file)
    rows_before = bytes_before = 0
    for name, count, properties in header.elements:
        if count and any(kind is None for _, kind in properties):
            raise UserError(f"has lists in its PLY element {name!r}, in or before the vertices: not readable as points")
        order = header.byte_order or "="
        layout = np.dtype([(field, order + kind) for field, kind in properties if kind is not None])
        if name == "vertex":
            if header.byte_order is None:
                rows = _text_rows(file, rows_before, count, layout)
            else:
                file.seek(bytes_before, 1)
                rows = binary_rows(file, count, layout)
            yield from ({field.lower(): piece[field] for field in layout.names or ()} for piece in rows)
            return
        rows_before, bytes_before = rows_before + count, bytes_before + count * layout.itemsize
    raise UserError(f"has no PLY element 'vertex', only {', '.join(name for name, _, _ in header.elements) or 'none'}")


def camera_row(file: BufferedIOBase) -> dict[str, float]:
    """The numbers of the camera that an open PLY file begins with, by their names; none if it begins with another."""
    header = read_ply_header(file)
    name, count, properties = header.elements[0] if header.elements else ("", 0, [])
    if name != "camera" or not count or any(kind is None for _, kind in properties):
        return {}
    layout = np.dtype([(field, (header.byte_order or "=") + str(kind)) for field, kind in properties])
    rows = _text_rows(file, 0, 1, layout) if header.byte_order is None else binary_rows(file, 1, layout)
    row = next(rows)[0]
    return {field: float(row[field]) for field in layout.names or ()}


def _text_rows(file: BufferedIOBase, before: int, count: int, layout: np.dtype) -> Iterator[np.ndarray]:
    """`count` records of ASCII data behind `before` other lines."""
    lines = (text for line in file if (text := line.decode("ascii", "replace").strip()))
    for _ in islice(lines, before):
        pass
    yield from text_rows(lines, count, layout)


def text_rows(lines: Iterator[str], count: int, layout: np.dtype) -> Iterator[np.ndarray]:
    """`count` records from as many lines of text, some at a time."""
    found = 0
    while found < count:
        rows = list(islice(lines, min(PIECE_LINES, count - found)))
        found += len(rows)
        if not rows or (len(rows) < PIECE_LINES and found < count):
            raise UserError(f"is cut off: its header announces {count} points, the data ends after {found}")
        yield np.loadtxt(rows, dtype=layout, comments=None, ndmin=1)
    if not count:
        yield np.empty(0, layout)


def binary_rows(file: BufferedIOBase, count: int, layout: np.dtype) -> Iterator[np.ndarray]:
    """`count` records of binary data from the file's place on, some at a time."""
    size, found = max(1, layout.itemsize), 0
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
