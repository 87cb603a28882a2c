"""PLY and PCD files as named columns of their points, piece by piece: a header of text lines, then rows, or columns.

.ply    ASCII or binary, any order and scalar types.  The header names the elements and their properties; the vertices
        may stand behind other elements.  Lists, in or before the vertices, are stepped over, one row at a time
.pcd    of the Point Cloud Library, 0.6 and 0.7: ASCII, binary or LZF-compressed.  The header names the fields with
        their sizes, types (F, I, U) and counts; then come the points, row by row, or, compressed, one column after the
        other

Only one piece of a file is in memory at a time; compressed ones are read whole.  Every fault is a ValueError that says
what is wrong; the file's name is added by the caller.
"""

import contextlib
import math
import re
from collections.abc import Iterable, Iterator
from io import BufferedIOBase
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import Columns
from spnr_jax.formats.point_tables import SHOWN, load_text

PIECE_BYTES, PIECE_LINES = 2**25, 2**17  # of the points that are in memory at a time

# --- PLY --------------------------------------------------------------------------------------------------------------


Properties = list[tuple[str, str | tuple[str, str]]]  # names with types; of a list those of its length and its items
Element = tuple[str, int, Properties]  # name, count, properties
Lists = dict[str, tuple[np.ndarray, ...]]  # lengths (rows,), and the items of all rows one behind the other

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8"},
}
FACES = ("face", "tristrips")  # elements that make a PLY a mesh
BYTE_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_HEADER_LIMIT = 2**20  # bytes
LONGEST_LIST = 2**20  # items


class PlyHeader(NamedTuple):
    """What a PLY file announces; byte_order is None in a text file."""

    byte_order: str | None
    elements: list[Element]  # in the order of the file

    @property
    def faces(self) -> str | None:
        """The element of faces that make it a mesh."""
        return next((name for name, count, _ in self.elements if name in FACES and count), None)


def read_ply_header(file: BufferedIOBase) -> PlyHeader:
    """The header of an open PLY file, which is left at its data."""
    data = file.read(PLY_HEADER_LIMIT)
    newline = re.search(rb"\r\n|\n|\r", data[:PLY_HEADER_LIMIT])
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


def element_pieces(file: BufferedIOBase, header: PlyHeader, *wanted: str) -> Iterator[tuple[str, Columns, Lists]]:
    """(name, columns, lists) of elements of a PLY file that is at its data, in its order, some rows at a time."""
    left = list(wanted)
    for name, count, properties in header.elements:
        for columns, lists in _element_rows(file, count, properties, header.byte_order):
            if name in left:
                yield name, {field.lower(): column for field, column in columns.items()}, lists
        left = [other for other in left if other != name]
        if not left:
            return
    names = ", ".join(name for name, _, _ in header.elements)
    raise UserError(f"has no PLY element {left[0]!r}, only {names or 'none'}")


def read_elements(file: BufferedIOBase, header: PlyHeader, *wanted: str) -> dict[str, tuple[Columns, Lists]]:
    """All columns and lists of elements of a PLY file that is at its data."""
    pieces, found = list(element_pieces(file, header, *wanted)), {}
    for name in wanted:
        own = [(columns, lists) for element, columns, lists in pieces if element == name]
        parts = {key: [lists[key] for _, lists in own] for key in own[0][1]}
        joined = {key: tuple(map(np.concatenate, zip(*arrays, strict=True))) for key, arrays in parts.items()}
        found[name] = join_pieces(columns for columns, _ in own), joined
    return found


def join_pieces(pieces: Iterable[Columns]) -> Columns:
    """The columns of all pieces in one; none if there are no pieces."""
    pieces = list(pieces)
    if len(pieces) < 2:
        return pieces[0] if pieces else {}
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def _element_rows(
    file: BufferedIOBase, count: int, properties: Properties, order: str | None
) -> Iterator[tuple[Columns, Lists]]:
    """The columns and lists of the next element, some rows at a time; the file is left behind them."""
    if all(isinstance(kind, str) for _, kind in properties):
        layout = np.dtype([(field, (order or "=") + str(kind)) for field, kind in properties])
        pieces = read_rows(file, count, layout, text=order is None)
        yield from (({field: piece[field] for field in layout.names or ()}, {}) for piece in pieces)
        return
    done = 0
    while done < max(count, 1):
        most = min(PIECE_LINES, count - done)
        piece = _equal_rows(file, most, properties, order, done) or _any_rows(file, most, properties, order, done)
        yield piece
        done += max(1, len(next(iter(piece[1].values()))[0]))


def _lines(file: BufferedIOBase) -> Iterator[str]:
    """The lines of text from the file's place on that are not empty."""
    return (text for line in iter(file.readline, b"") if (text := line.decode("ascii", "replace").strip()))


def _equal_rows(
    file: BufferedIOBase, count: int, properties: Properties, order: str | None, before: int
) -> tuple[Columns, Lists] | None:
    """At most `count` rows at once, whose lists have the lengths of the first; None, and no step, where some differ."""
    place = file.tell()
    _, first = _any_rows(file, min(count, 1), properties, order, before)
    file.seek(place)
    fields: list[tuple] = []
    for name, kind in properties:
        if isinstance(kind, str):
            fields.append((name, (order or "=") + kind))
        else:
            length, items = ((order or "=") + part for part in kind)
            fields += [(f"{name} length", length), (name, items, (len(first[name][1]),))]
    layout = np.dtype(fields)
    count = max(min(count, 1), min(count, PIECE_BYTES // layout.itemsize))
    try:
        if order:
            rows = np.frombuffer(file.read(count * layout.itemsize), layout)
        else:
            rows = np.loadtxt(list(islice(_lines(file), count)), dtype=layout, comments=None, ndmin=1)
    except ValueError:
        rows = np.empty(0, layout)
    lists: Lists = {name: (rows[f"{name} length"].astype(np.int64), rows[name].ravel()) for name in first}
    if len(rows) < count or any((sizes != first[name][0]).any() for name, (sizes, _) in lists.items()):
        file.seek(place)
        return None
    return {name: rows[name] for name, _ in properties if name not in first}, lists


def _any_rows(
    file: BufferedIOBase, count: int, properties: Properties, order: str | None, before: int
) -> tuple[Columns, Lists]:
    """`count` rows one by one, behind those `before`, with lists of any lengths."""
    found: dict[str, list[np.ndarray]] = {name: [] for name, _ in properties}
    sizes: dict[str, list[int]] = {name: [] for name, kind in properties if not isinstance(kind, str)}
    for number in range(before, before + count):
        words = iter([] if order else next(_lines(file), "").split())
        for name, kind in properties:
            size = 1
            if not isinstance(kind, str):
                size, kind = int(_take(file, words, kind[0], order, 1, number)[0]), kind[1]
                if not 0 <= size <= LONGEST_LIST:
                    raise UserError(f"has a list of {size} items in row {number} of a PLY element: broken file")
                sizes[name].append(size)
            found[name].append(_take(file, words, kind, order, size, number))
    kinds = {name: kind if isinstance(kind, str) else kind[1] for name, kind in properties}
    columns = {name: np.concatenate([np.zeros(0, kinds[name]), *found[name]]) for name in found}
    lists: Lists = {name: (np.array(sizes[name], np.int64), columns.pop(name)) for name in sizes}
    return columns, lists


def _take(
    file: BufferedIOBase, words: Iterator[str], kind: str, order: str | None, size: int, number: int
) -> np.ndarray:
    """The next numbers of a row, of the text's words, or of the file's bytes."""
    if order:
        data = file.read(size * np.dtype(kind).itemsize)
        if len(data) == size * np.dtype(kind).itemsize:
            return np.frombuffer(data, order + kind)
    elif len(chosen := list(islice(words, size))) == size:
        try:
            return np.array(chosen, str).astype(kind)
        except (ValueError, OverflowError):
            found = " ".join(chosen)[:SHOWN]
            raise UserError(f"row {number} of a PLY element: expected numbers, found {found!r}") from None
    raise UserError(f"is cut off: row {number} of a PLY element ends too early")


def camera_row(file: BufferedIOBase) -> dict[str, float]:
    """The numbers of the camera that an open PLY file begins with, by their names; none if it begins with another."""
    header = read_ply_header(file)
    if [name for name, _, _ in header.elements][:1] != ["camera"]:
        return {}
    _, columns, _ = next(element_pieces(file, header, "camera"))
    return {name: float(column[0]) for name, column in columns.items() if len(column)}


# --- PCD --------------------------------------------------------------------------------------------------------------


PCD_HEADER_LIMIT = 2**16  # bytes
POINT_LIMIT = 2**16  # bytes: histograms have some hundreds of numbers, and NumPy crashes on records of 2 GiB
ENTRIES = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
ENCODINGS = ("ascii", "binary", "binary_compressed")
KINDS = {"F": "f", "I": "i", "U": "u"}
LONGEST_LITERAL = 32  # control bytes below it announce so many plain bytes, less one; the others copy earlier ones


class PcdHeader(NamedTuple):
    """What a PCD file announces: the layout of a point, how many there are, and how and where they are written."""

    layout: np.dtype
    num_points: int
    encoding: str
    size: int  # bytes up to the data
    organised: bool  # one point for each pixel of a depth camera
    sensor: tuple[float, ...] | None  # its place; writers put 0 0 0 there if they do not know it


def read_pcd_header(path: Path) -> PcdHeader:
    """The header of a PCD file."""
    with path.open("rb") as file:
        return _header(file.read(PCD_HEADER_LIMIT))


def pcd_pieces(path: Path) -> Iterator[dict[str, np.ndarray]]:
    """The fields of a PCD file as columns, some points at a time; a field of several numbers is left out."""
    with path.open("rb") as file:
        header = _header(file.read(PCD_HEADER_LIMIT))
        file.seek(header.size)
        if header.encoding == "binary_compressed":
            pieces = iter([_columns(file.read(), header)])
        else:
            pieces = read_rows(file, header.num_points, header.layout, text=header.encoding == "ascii")
        for points in pieces:
            yield {name.lower(): points[name] for name in points.dtype.names or () if points[name].ndim == 1}


def _header(data: bytes) -> PcdHeader:
    """The header of a PCD file."""
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data[:PCD_HEADER_LIMIT], re.MULTILINE)
    if end is None:
        raise UserError("is not a PCD file, or its header is cut off (expected '# .PCD' ... 'DATA')")
    entries: dict[str, list[str]] = {}
    for line in data[: end.end()].decode("ascii", "replace").splitlines():
        word, *values = line.split() or ["#"]
        if word in ENTRIES:
            entries[word] = values
        elif not word.startswith("#"):
            raise UserError(f"has a PCD header line that is not understood: {line.strip()!r}")
    encoding = end[1].decode("ascii", "replace")
    if encoding not in ENCODINGS:
        raise UserError(f"has PCD data of kind {encoding!r}; expected one of {', '.join(ENCODINGS)}")
    try:
        names, kinds = entries["FIELDS"], entries["TYPE"]
        sizes = [int(size) for size in entries["SIZE"]]
        counts = [int(count) for count in entries.get("COUNT", ["1"] * len(names))]
        num_points = int(entries["POINTS"][0] if "POINTS" in entries else entries["WIDTH"][0])
        fields = [
            # padding is called "_" and may come several times
            (name if name != "_" else f"_{i}", KINDS[kind] + str(size), *([(count,)] if count != 1 else []))
            for i, (name, kind, size, count) in enumerate(zip(names, kinds, sizes, counts, strict=True))
        ]
        layout = np.dtype(fields).newbyteorder("<")
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise UserError(f"has a PCD header whose FIELDS, SIZE, TYPE, COUNT and POINTS disagree ({error})") from None
    size = sum(size * count for size, count in zip(sizes, counts, strict=True))  # that of the layout can overflow
    if size > POINT_LIMIT:
        raise UserError(f"has a PCD header with points of {size} bytes; expected at most {POINT_LIMIT}")
    if num_points < 0:
        raise UserError(f"has a PCD header that announces {num_points} points")
    organised = entries.get("HEIGHT", ["1"])[:1] not in (["0"], ["1"])
    sensor = None
    with contextlib.suppress(ValueError):
        place = tuple(float(value) for value in entries.get("VIEWPOINT", [])[:3])
        sensor = place if len(place) == 3 and all(map(math.isfinite, place)) else None
    return PcdHeader(
        layout=layout, num_points=num_points, encoding=encoding, size=end.end(), organised=organised, sensor=sensor
    )


def _columns(body: bytes, header: PcdHeader) -> np.ndarray:
    """The points of a compressed file, one field of all points after the other."""
    if len(body) < 8:
        raise UserError("is cut off: its compressed data is missing")
    compressed, plain = (int(size) for size in np.frombuffer(body, "<u4", 2))
    if len(body) - 8 < compressed:
        raise UserError(f"is cut off: expected {compressed} bytes of compressed data, found {len(body) - 8}")
    if plain != header.num_points * header.layout.itemsize:
        raise UserError(f"announces {plain} bytes of points, its header {header.num_points * header.layout.itemsize}")
    packed = body[8 : 8 + compressed]
    try:
        unpacked = decompress(packed, plain)
    except UserError:
        if compressed != plain:
            raise
        unpacked = packed  # some writers announce compressed data and store it as it is
    points, start = np.empty(header.num_points, header.layout), 0
    for name in header.layout.names or ():
        column = points[name]
        points[name] = np.frombuffer(unpacked, column.dtype, column.size, start).reshape(column.shape)
        start += column.size * column.dtype.itemsize
    return points


def decompress(data: bytes, size: int) -> bytes:
    """The `size` bytes that LZF data stands for: pieces of plain bytes, and copies of what came before."""
    plain, place = bytearray(), 0
    try:
        while place < len(data) and len(plain) <= size:
            control = data[place]
            place += 1
            if control < LONGEST_LITERAL:
                plain += data[place : place + control + 1]
                place += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[place]
                place += 1
            start = len(plain) - ((control & 31) << 8) - data[place] - 1
            place += 1
            if start < 0:
                raise IndexError
            length += 2
            distance = len(plain) - start
            # a copy may reach into itself: the piece so far is then repeated
            plain += (plain[start : start + length] * (length // distance + 1))[:length]
    except IndexError:
        raise UserError("has compressed data that is damaged") from None
    if len(plain) != size:
        raise UserError(f"has compressed data that is damaged: {len(plain)} bytes come out, {size} are announced")
    return bytes(plain)


# --- rows -------------------------------------------------------------------------------------------------------------


def read_rows(file: BufferedIOBase, count: int, layout: np.dtype, text: bool) -> Iterator[np.ndarray]:
    """`count` records from the file's place on, of lines of text or of bytes, some at a time."""
    if not count or not layout.itemsize:
        yield np.empty(0, layout)
        return
    step = PIECE_LINES if text else max(1, PIECE_BYTES // layout.itemsize)
    for found in range(0, count, step):
        wanted = min(step, count - found)
        lines = list(enumerate(islice(_lines(file), wanted), found)) if text else []
        data = b"" if text else file.read(wanted * layout.itemsize)
        held = len(lines) + len(data) // layout.itemsize
        if held < wanted:
            raise UserError(f"is cut off: its header announces {count} points, the data ends after {found + held}")
        names = layout.names or ()
        yield load_text(lines, "point", len(names), dtype=layout, ndmin=1) if text else np.frombuffer(data, layout)
