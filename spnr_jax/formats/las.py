"""Airborne and terrestrial laser scans (.las, compressed .laz) as named columns, piece by piece, through laspy.

Coordinates come scaled and shifted as the header says, in float64; colours are 16 bit.  What the header announces is
compared with the size of the file before laspy, which takes memory and time for whatever is announced, sees it; and
lazrs, which unpacks .laz, ends the whole process where a size in the file is too large, which no `except` sees.  So the
sizes are walked through before (LASzip specification, LAZ 1.4 R1):
    record 22204 of "laszip encoded"   ... chunk size u32 at 12, number of items u16 at 32, items (type, size, version)
    at the points' place   i64 place of the chunk table (-1: it stands in the last 8 bytes), then the chunks
    chunk of layers        first point as it is, u32 number of points, u32 size of each layer, the layers
    chunk table            u32 version, u32 number of chunks
"""

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats.assets import extra

RECORD_HEAD, NAME, NUMBER = 54, b"laszip encoded", 22204
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of an item of this type; those of extra bytes (14) have one a byte
ITEMS_AT, CHUNK_SIZE_AT = 32, 12
LARGEST_CHUNK = 2**24  # points; writers use 50,000
VARIABLE = 2**32 - 1  # chunk size that says that every chunk has its own
PIECE_BYTES = 2**23  # of points in memory at a time
COLUMNS = ("red", "green", "blue", "intensity", "classification", "withheld")
# places in the header (ASPRS LAS 1.4 R15, table 3): sizes and counts, the count of version 1.4
SIZES, COUNT_14, SMALLEST_HEADER = 94, 247, 227
COMPRESSED = 0xC0  # bits of the point format


def las_pieces(path: Path) -> Iterator[dict[str, np.ndarray]]:
    """The columns x y z, the colours and the intensity of a scan, some points at a time."""
    laspy, _ = extra("laspy", "formats"), extra("lazrs", "formats")
    backends = (laspy.LazBackend.Lazrs,)  # its parallel reader ends the whole process on a damaged file
    _check_header(path)
    try:
        with (
            refusing("is a broken or truncated LAS file"),
            laspy.open(path, laz_backend=backends, read_evlrs=False) as scan,
        ):
            present = set(scan.header.point_format.dimension_names)
            for points in scan.chunk_iterator(max(1, PIECE_BYTES // scan.header.point_format.size)):
                columns = {axis: np.asarray(getattr(points, axis), np.float64) for axis in "xyz"}
                yield columns | {name: np.asarray(points[name]) for name in COLUMNS if name in present}
    except BaseException as error:  # lazrs, a library in Rust, panics, which is no Exception
        if type(error).__name__ != "PanicException":
            raise
        raise UserError(f"is a broken LAZ file ({error})") from None


def _check_header(path: Path) -> None:
    """ValueError if the header announces more than the file can hold."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(COUNT_14 + 8)
    if head[:4] != b"LASF" or len(head) < SMALLEST_HEADER:
        raise UserError("is not a LAS file, or its header is cut off (expected 'LASF' and at least 227 bytes)")
    minor = head[25]
    header_size, data, records, kind, length, count = struct.unpack_from("<HIIBHI", head, SIZES)
    if minor >= 4 and len(head) == COUNT_14 + 8:
        (count,) = struct.unpack_from("<Q", head, COUNT_14)
    if not header_size + records * RECORD_HEAD <= data <= size:
        raise UserError(f"is broken: {records} records in its header, points from byte {data} on, in {size} bytes")
    if kind & COMPRESSED:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            check_laz(content, header_size, records, data, length, count)
    elif not length or data + count * length > size:
        raise UserError(f"is cut off: its header announces {count} points of {length} bytes, in {size} bytes")


def check_laz(content: mmap.mmap, first_record: int, records: int, data: int, length: int, points: int) -> None:
    """ValueError unless lazrs can be trusted with the bytes of a scan.

    `records` stand from `first_record` on, `points`, of `length` bytes when unpacked, from `data` on.
    """
    try:
        items, chunk_size = _items(content, first_record, records)
        if sum(size for _, size in items) != length:
            raise UserError(f"its points have {length} bytes, their items {[size for _, size in items]}")
        if not chunk_size and any(kind in LAYERS for kind, _ in items):
            chunk_size = VARIABLE  # as writers of COPC put it
        if chunk_size != VARIABLE and not 0 < chunk_size <= LARGEST_CHUNK:
            raise UserError(f"chunks of {chunk_size} points, expected 1 to {LARGEST_CHUNK}")
        (table,) = struct.unpack_from("<q", content, data)
        if table == -1:
            (table,) = struct.unpack_from("<q", content, len(content) - 8)
        if table < 0:
            raise UserError(f"its table of chunks lies at byte {table}")
        _, chunks = struct.unpack_from("<II", content, table)
        if chunks * length > len(content):  # each begins with a point as it is
            raise UserError(f"{chunks} chunks in {len(content)} bytes")
        if chunks * (LARGEST_CHUNK if chunk_size == VARIABLE else chunk_size) < points:
            raise UserError(f"{points} points in {chunks} chunks")
        if any(kind in LAYERS for kind, _ in items):
            _walk(content, data + 8, chunks, length, sum(LAYERS.get(kind, size) for kind, size in items))
    except struct.error:
        raise UserError("is cut off: its compressed data ends too early") from None


def _items(content: mmap.mmap, place: int, records: int) -> tuple[list[tuple[int, ...]], int]:
    """((type, size) of each item of a point, points in a chunk) as LASzip's record says."""
    for _ in range(records):
        name, number, size = struct.unpack_from("<16sHH", content, place + 2)
        if name.rstrip(b"\0") == NAME and number == NUMBER:
            start = place + RECORD_HEAD
            (count,) = struct.unpack_from("<H", content, start + ITEMS_AT)
            (chunk_size,) = struct.unpack_from("<I", content, start + CHUNK_SIZE_AT)
            places = range(start + ITEMS_AT + 2, start + ITEMS_AT + 2 + 6 * count, 6)
            return [struct.unpack_from("<HH", content, at) for at in places], chunk_size
        place += RECORD_HEAD + size
    raise UserError("has no record that says how its points are compressed")


def _walk(content: mmap.mmap, place: int, chunks: int, length: int, layers: int) -> None:
    """ValueError unless all layers of all chunks end inside the file."""
    for _ in range(chunks):
        count, *sizes = struct.unpack_from(f"<{1 + layers}I", content, place + length)
        place += length + 4 + 4 * layers + sum(sizes)
        if place > len(content) or count > LARGEST_CHUNK:
            raise UserError(f"is cut off: a chunk of {count} points ends at byte {place} of {len(content)}")
