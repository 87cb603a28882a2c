"""Point files of the Point Cloud Library as named columns: .pcd 0.6 and 0.7, ASCII, binary or LZF-compressed.

They are read piece by piece, compressed ones whole.  A header of text lines names the fields with their sizes, types
(F, I, U) and counts; then come the points, row by row, or, compressed, one column after the other.  Every fault is a
ValueError that says what is wrong; the file's name is added by the caller.
"""

import contextlib
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.ply import binary_rows, text_rows

HEADER_LIMIT = 2**16  # bytes
POINT_LIMIT = 2**16  # bytes: histograms have some hundreds of numbers, and NumPy crashes on records of 2 GiB
ENTRIES = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
ENCODINGS = ("ascii", "binary", "binary_compressed")
KINDS = {"F": "f", "I": "i", "U": "u"}
LONGEST_LITERAL = 32  # control bytes below it announce so many plain bytes, less one; the others copy earlier ones


@dataclass(frozen=True, kw_only=True)
class PcdHeader:
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
        return _header(file.read(HEADER_LIMIT))


def pcd_pieces(path: Path) -> Iterator[dict[str, np.ndarray]]:
    """The fields of a PCD file as columns, some points at a time; a field of several numbers is left out."""
    with path.open("rb") as file:
        header = _header(file.read(HEADER_LIMIT))
        file.seek(header.size)
        if header.encoding == "ascii":
            lines = (text for line in file if (text := line.decode("ascii", "replace").strip()))
            pieces = text_rows(lines, header.num_points, header.layout)
        elif header.encoding == "binary":
            pieces = binary_rows(file, header.num_points, header.layout)
        else:
            pieces = iter([_columns(file.read(), header)])
        for points in pieces:
            yield {name.lower(): points[name] for name in points.dtype.names or () if points[name].ndim == 1}


def _header(data: bytes) -> PcdHeader:
    """The header of a PCD file."""
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data[:HEADER_LIMIT], re.MULTILINE)
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
