"""PLY and PCD files as named columns of their points, piece by piece: a text header, then rows, or columns.

.ply    ASCII or binary, any byte order and scalar types.  The header lists elements and their properties.  Other
        elements may come before the vertices; lists of vertices are skipped unless they are known columns
.pcd    Point Cloud Library 0.6 and 0.7: ASCII, binary or LZF-compressed.  The header lists fields with sizes, types
        (F, I, U) and counts; the points follow row by row or, compressed, column by column

Both describe a row by properties: name, type and number of items (for a list: the type of its length).  One piece of a
file is in memory at a time; compressed files are read whole.
"""

import contextlib
import math
import re
from codecs import BOM_UTF8
from collections.abc import Iterable, Iterator
from io import SEEK_END, BufferedIOBase, BytesIO
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import ARRAYS, Columns, Report, list_names, name_columns, plain_name
from spnr_jax.formats.gaussian_files import unpack_columns
from spnr_jax.formats.point_tables import load_text

Properties = list[tuple[str, str, Any]]  # name, type, number of items, or for a list the type of its length
Lists = dict[str, tuple[np.ndarray, ...]]  # lengths (rows,), and the items of all rows concatenated

PIECE_BYTES, PIECE_LINES = 2**25, 2**17  # of a piece in memory
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8"},
}
FACES = ("face", "tristrips")  # elements that make a PLY a mesh
USED = ("vertex", "camera", *FACES)  # elements that are read; of a camera its place (orientation.py)
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_LIST = 2**20  # items
PLY_LIMIT, PCD_LIMIT = 2**20, 2**16  # bytes of a header
POINT_LIMIT = 2**16  # bytes of a point: histograms have hundreds of numbers; NumPy crashes on records of 2 GiB
ENCODINGS = ("ascii", "binary", "binary_compressed")
KINDS = {"F": "<f", "I": "<i", "U": "<u"}
LONGEST_LITERAL = 32  # LZF: a control byte c < 32 precedes c + 1 literal bytes; others copy earlier bytes


def read_rows(file: BufferedIOBase, count: int, properties: Properties, text: bool) -> Iterator[tuple[Columns, Lists]]:
    """Columns and lists of the next `count` rows of the file, some at a time.

    A piece whose lists all have the lengths of its first row is read at once, others row by row.
    """
    lists, done = [name for name, _, width in properties if isinstance(width, str)], 0
    if not count or not properties:
        yield _any_rows(file, 0, properties, text, 0)
    while done < count and properties:
        place, lengths = file.tell(), {}
        if lists:
            lengths = {name: int(found[0][0]) for name, found in _any_rows(file, 1, properties, text, done)[1].items()}
            file.seek(place)
        layout, words = _layout(properties, lengths)
        fitting = max(1, PIECE_BYTES // max(1, layout.itemsize))
        wanted = min(count - done, PIECE_LINES if text or lists else fitting, PIECE_LINES if text else fitting)
        try:
            lines = list(enumerate(islice(_lines(file), wanted), done)) if text else []
            data = b"" if text else file.read(wanted * layout.itemsize)
            held = done + (len(lines) if text else len(data) // max(1, layout.itemsize))
            if held < done + wanted:
                raise UserError(f"is cut off: its header announces {count} points, the data ends after {held}")
            rows = load_text(lines, "point", words, dtype=layout, ndmin=1) if text else np.frombuffer(data, layout)
            found = {name: rows[f"{name} length"].astype(np.int64) for name in lists}
            if any((found[name] != length).any() for name, length in lengths.items()):
                raise UserError("has lists of several lengths")
        except UserError:
            if not lists:
                raise
            file.seek(place)
            yield _any_rows(file, wanted, properties, text, done)
        else:
            items = {name: rows[name].ravel() if lengths[name] else np.zeros(0) for name in lists}
            yield _columns(properties, rows), {name: (found[name], items[name]) for name in lists}
        done += wanted


def _columns(properties: Properties, rows: Any) -> Columns:
    """The columns of a structured array, or of a dict from property names to values."""
    fields = [(name, width) for name, _, width in properties if not isinstance(width, str)]
    return name_columns({name: rows[name].reshape(-1, width) for name, width in fields})


def _layout(properties: Properties, lengths: dict[str, int]) -> tuple[np.dtype, int]:
    """The layout of a row whose lists have these lengths, and its number of items."""
    fields: list[tuple] = []
    for name, kind, width in properties:
        if isinstance(width, str):
            fields.append((f"{name} length", width))
            width = lengths[name]
        if width:  # NumPy cannot read empty fields from text
            fields.append((name, kind, *([(width,)] if width > 1 else [])))
    return np.dtype(fields), sum(math.prod(field[2]) if len(field) > 2 else 1 for field in fields)


def _any_rows(
    file: BufferedIOBase, count: int, properties: Properties, text: bool, before: int
) -> tuple[Columns, Lists]:
    """The next `count` rows, read one by one, with lists of any lengths; `before`: number of rows already read."""
    raw: dict[str, list] = {name: [] for name, *_ in properties}
    sizes: dict[str, list[int]] = {name: [] for name, _, width in properties if isinstance(width, str)}
    lines, row, words = _lines(file), before, [""]

    def take(kind: str, number: int) -> Any:
        nonlocal words
        size = number * (1 if text else np.dtype(kind).itemsize)
        data, words = (words[:size], words[size:]) if text else (file.read(size), words)
        if len(data) < size:
            raise UserError(f"is cut off: row {row} of a PLY element ends too early")
        return data

    def join(parts: list, kind: str) -> np.ndarray:
        if not text:
            return np.frombuffer(b"".join(parts), kind)
        try:
            return np.array(list(chain(*parts)), str).astype(kind)
        except (ValueError, OverflowError):
            raise UserError(f"has other things than numbers in a PLY element, up to its row {row}") from None

    for row in range(before, before + count):
        words = next(lines, "").split() if text else words
        for name, kind, width in properties:
            if isinstance(width, str):
                width = int(join([take(width, 1)], width)[0])
                if not 0 <= width <= LONGEST_LIST:
                    raise UserError(f"has a list of {width} items in row {row} of a PLY element: broken file")
                sizes[name].append(width)
            raw[name].append(take(kind, width))
    values = {name: join(raw[name], kind) for name, kind, _ in properties}
    return _columns(properties, values), {name: (np.array(sizes[name], np.int64), values[name]) for name in sizes}


def _lines(file: BufferedIOBase) -> Iterator[str]:
    """The remaining lines of text that are not empty."""
    return (text for line in iter(file.readline, b"") if (text := line.decode("ascii", "replace").strip()))


class Header(NamedTuple):
    """The header of a PLY or PCD file: encoding; name, count and properties of each element in order.

    The points of both are the element `vertex`.
    """

    encoding: str  # ascii, binary or binary_compressed
    elements: list[tuple[str, int, Properties]]
    textures: tuple[str, ...] = ()  # file names in MeshLab's comments
    organised: bool = False  # one point per pixel of a depth camera
    sensor: tuple[float, ...] | None = None  # its position; often 0 0 0 if unknown
    carriage: bool = False  # lines of a text end in a bare \r

    @property
    def faces(self) -> str | None:
        """The name of the element of faces, if it is a mesh."""
        return next((name for name, count, _ in self.elements if name in FACES and count), None)


def read_header(file: BufferedIOBase, kind: str) -> Header:
    """The header of an open .ply or .pcd file, which is left at the start of its data."""
    return _ply_header(file) if kind == ".ply" else _pcd_header(file)


def row_pieces(path: Path, report: Report, kind: str) -> Iterator[Columns]:
    """The columns of the points of a .ply or .pcd file, some at a time; reports rows beyond the header's count.

    Compressed files come in one piece.
    """
    with path.open("rb") as file:
        header = read_header(file, kind)
        if header.encoding == "binary_compressed":
            yield _packed_columns(file.read(), *header.elements)
            return
        if any(field == "packed_position" for *_, properties in header.elements for field, *_ in properties):
            found = read_elements(file, header, "chunk", "vertex")
            yield unpack_columns(found["chunk"][0], found["vertex"][0])
            return
        if others := [name for name, count, _ in header.elements if count and name not in USED]:
            report(f"not read: the PLY elements {list_names(others)}")
        for _, columns, lists in element_pieces(file, header, "vertex"):
            fields = {name: found for name, found in lists.items() if plain_name(name) in ARRAYS}
            if any(np.ptp(sizes) for sizes, _ in fields.values() if len(sizes)):
                raise UserError(f"has lists of several lengths: {list_names([*fields])}")
            columns |= {f"{name} (lists)": sizes for name, (sizes, _) in lists.items() if name not in fields}
            yield columns | name_columns({name: x.reshape(len(sizes), -1) for name, (sizes, x) in fields.items()})
        (name, count, properties), begin = header.elements[-1], file.tell()
        if name != "vertex" or any(isinstance(width, str) for *_, width in properties):
            return
        size = max(1, _layout(properties, {})[0].itemsize)
        binary = header.encoding == "binary"
        if held := (file.seek(0, SEEK_END) - begin) // size if binary else sum(1 for _ in _lines(file)):
            report(f"the header announces {count:,} points, {held:,} more stand behind them and are not read")


def element_pieces(file: BufferedIOBase, header: Header, *wanted: str) -> Iterator[tuple[str, Columns, Lists]]:
    """(name, columns, lists) of the wanted elements of a PLY file at its data, in file order, some rows at a time."""
    left = set(wanted)
    file = BytesIO(file.read().replace(b"\r", b"\n")) if header.carriage else file
    for name, count, properties in header.elements:
        for columns, lists in read_rows(file, count, properties, header.encoding == "ascii") if left else ():
            if name in left:
                yield name, columns, lists
        left -= {name}
    if left:
        names = ", ".join(name for name, _, _ in header.elements)
        raise UserError(f"has no PLY element {min(left)!r}, only {names or 'none'}")


def read_elements(file: BufferedIOBase, header: Header, *wanted: str) -> dict[str, tuple[Columns, Lists]]:
    """All columns and lists of the wanted elements of a PLY file at its data."""
    pieces, found = list(element_pieces(file, header, *wanted)), {}
    for name in wanted:
        own = [(columns, lists) for element, columns, lists in pieces if element == name]
        joined = {
            key: tuple(map(np.concatenate, zip(*(lists[key] for _, lists in own), strict=True))) for key in own[0][1]
        }
        found[name] = join_pieces(columns for columns, _ in own), joined
    return found


def join_pieces(pieces: Iterable[Columns]) -> Columns:
    """The pieces concatenated; empty if there are none."""
    first, *others = list(pieces) or [{}]
    return {name: np.concatenate([first[name], *(piece[name] for piece in others)]) for name in first}


def _ply_header(file: BufferedIOBase) -> Header:
    data = file.read(PLY_LIMIT)
    newline = re.search(rb"\r\n|\n|\r", data)
    # after a header with \r line ends, the first byte of data may be a \n
    end = re.search(rb"(?<=[\r\n])end_header[ \t]*" + newline[0], data) if newline else None
    if newline is None or end is None or not data.removeprefix(BOM_UTF8).startswith(b"ply"):
        raise UserError("is not a PLY file, or its header is cut off (expected 'ply' ... 'end_header')")
    order: str | None = None
    textures: list[str] = []
    elements: list[tuple[str, int, Properties]] = []
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        match line.lower().split():
            case ["format", name, _]:
                order = BYTE_ORDERS.get(name)
            case ["element", name, count] if count.isdecimal():
                elements.append((name, int(count), []))
            case ["property", "list", length, items, name] if elements and {length, items} <= TYPES.keys():
                elements[-1][2].append((name, TYPES[items], TYPES[length]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append((name, TYPES[kind], 1))
            case ["comment", "texturefile", *_]:
                textures.append(line.split(None, 2)[-1].strip())
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise UserError(f"has a PLY header line that is not understood: {line.strip()!r}")
    if order is None:
        raise UserError(f"has a PLY header without a known format; expected one of {', '.join(BYTE_ORDERS)}")
    file.seek(end.end())
    for _, _, own in elements:  # "float" in ASCII is read as f8: the text may have more digits
        own[:] = [(name, order + kind, order + width if isinstance(width, str) else width) for name, kind, width in own]
        own[:] = [(name, kind.replace("=f4", "=f8"), width) for name, kind, width in own]
    text = order == "="
    return Header("ascii" if text else "binary", elements, tuple(textures), carriage=text and newline[0] == b"\r")


def _pcd_header(file: BufferedIOBase) -> Header:
    data = file.read(PCD_LIMIT)
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        raise UserError("is not a PCD file, or its header is cut off (expected '# .PCD' ... 'DATA')")
    entries: dict[str, list[str]] = {}
    for line in data[: end.end()].decode("utf-8-sig", "replace").splitlines():
        word, *values = line.split() or ["#"]
        entries[word.upper().replace("COLUMNS", "FIELDS")] = values
    if (encoding := end[1].decode("ascii", "replace").lower()) not in ENCODINGS:
        raise UserError(f"has PCD data of kind {encoding!r}; expected one of {', '.join(ENCODINGS)}")
    try:
        names = entries["FIELDS"]
        counts = map(int, entries.get("COUNT", ["1"] * len(names)))
        num_points = int(entries["POINTS"][0]) if entries.get("POINTS") else _count_pixels(entries)
        types = [KINDS[kind] + str(int(size)) for kind, size in zip(entries["TYPE"], entries["SIZE"], strict=True)]
        # "F 4" in ASCII is read as f8: the text may have more digits
        types = [kind if encoding != "ascii" else kind.replace("<f4", "<f8") for kind in types]
        # padding is called "_" and may occur several times
        plain = [name if name != "_" else f"_{i}" for i, name in enumerate(names)]
        properties: Properties = list(zip(map(str.lower, plain), types, counts, strict=True))
        size = sum(np.dtype(kind).itemsize * width for _, kind, width in properties)
        if len(dict(zip(plain, types, strict=True))) < len(plain) or any(width < 0 for *_, width in properties):
            raise ValueError("a name twice, or a negative COUNT")
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise UserError(f"has a PCD header whose FIELDS, SIZE, TYPE, COUNT and POINTS disagree ({error})") from None
    if size > POINT_LIMIT or num_points < 0:
        raise UserError(f"has a PCD header of {num_points} points of {size} bytes; expected at most {POINT_LIMIT}")
    file.seek(end.end())
    sensor = None
    with contextlib.suppress(ValueError):
        place = tuple(map(float, entries.get("VIEWPOINT", [])[:3]))
        sensor = place if len(place) == 3 and all(map(math.isfinite, place)) else None
    organised = entries.get("HEIGHT", ["1"])[:1] not in (["0"], ["1"])
    points = "vertex", num_points, [field for field in properties if field[2]]
    return Header(encoding, [points], organised=organised, sensor=sensor)


def _count_pixels(entries: dict[str, list[str]]) -> int:
    """The number of points of a PCD header that names none: those of its rows and columns."""
    return int(entries["WIDTH"][0]) * max(int((entries.get("HEIGHT") or ["1"])[0]), 1)


# --- compressed PCD ---------------------------------------------------------------------------------------------------


def _packed_columns(body: bytes, points: tuple[str, int, Properties]) -> Columns:
    """The columns of a compressed file: one field of all points after the other."""
    compressed, plain = (int.from_bytes(body[i : i + 4], "little") for i in (0, 4))
    packed = body[8 : 8 + compressed]
    columns: Columns = {}
    if len(body) < 8 or len(packed) < compressed:
        raise UserError(f"is cut off: expected {compressed} bytes of compressed data, found {len(packed)}")
    try:
        stream = BytesIO(decompress(packed, plain))
    except UserError:
        if compressed != plain:
            raise
        stream = BytesIO(packed)  # some writers store uncompressed data here
    for field in points[2]:
        columns |= join_pieces(found for found, _ in read_rows(stream, points[1], [field], text=False))
    if stream.read(1):
        raise UserError(f"announces {plain} bytes of points, more than its header")
    return columns


def decompress(data: bytes, size: int) -> bytes:
    """The `size` bytes of LZF-compressed data: literal bytes, and copies of earlier bytes."""
    plain, place = bytearray(), 0
    try:
        while place < len(data) and len(plain) <= size:
            control, place = data[place], place + 1
            if control < LONGEST_LITERAL:
                plain += data[place : place + control + 1]
                place += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length, place = length + data[place], place + 1
            distance, place = ((control & 31) << 8) + data[place] + 1, place + 1
            start = len(plain) - distance
            if start < 0:
                raise IndexError
            # a copy longer than its distance repeats itself
            plain += (plain[start : start + length] * (length // distance + 1))[:length]
        if len(plain) != size:
            raise IndexError
    except IndexError:
        raise UserError("has compressed data that is damaged") from None
    return bytes(plain)
