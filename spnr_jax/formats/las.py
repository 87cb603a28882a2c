"""Airborne and terrestrial laser scans (.las, compressed .laz) as named columns, piece by piece, through laspy.

laspy allocates whatever the header declares, and lazrs, which unpacks .laz, aborts the process if a size in the file
is too large.  So all sizes are checked against the size of the file first (LASzip specification, LAZ 1.4 R1):
    record 22204 of "laszip encoded"   ... chunk size u32 at 12, number of items u16 at 32, items (type, size, version)
    at the offset of the points   i64 offset of the chunk table (-1: in the last 8 bytes), then the chunks
    chunk of layers        first point uncompressed, u32 number of points, u32 size of each layer, the layers
    chunk table            u32 version, u32 number of chunks
"""

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats.assets import extra
from spnr_jax.formats.columns import Columns, Report, name_columns

RECORD_HEAD, NAME, NUMBER = 54, b"laszip encoded", 22204
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of each item type; extra bytes (14) have one per byte
CHUNKED_LAYERS = 3  # number of the layered compressor
LARGEST_CHUNK = 2**24  # points; writers use 50,000
VARIABLE = 2**32 - 1  # chunk size: each chunk has its own
PIECE_BYTES = 2**23  # of points in memory at a time
COLUMNS = ("red", "green", "blue", "intensity", "classification", "withheld")
# offsets in the header (ASPRS LAS 1.4 R15, table 3): sizes and counts; version 1.4's counts of records and points
SIZES, EVLRS, COUNT_14, SMALLEST_HEADER = 94, 243, 247, 227
COMPRESSED = 0xC0  # flag bits of the point format


def las_pieces(path: Path, report: Report) -> Iterator[Columns]:
    """The columns x y z, COLUMNS, extra bytes, and what else differs among the first points, some at a time."""
    laspy, _ = extra("laspy", "formats"), extra("lazrs", "formats")
    backends = (laspy.LazBackend.Lazrs,)  # its parallel reader aborts the process on a damaged file
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        try:
            if more := _check_sizes(content):
                report(f"at least {more:,} points beyond those that the header announces are not read")
        except struct.error:
            raise UserError("is cut off: its header or compressed data ends too early") from None
    try:
        with (
            refusing("is a broken or truncated LAS file"),
            laspy.open(path, laz_backend=backends, read_evlrs=False) as scan,
        ):
            own, names = scan.header.point_format, list[str]()
            for points in scan.chunk_iterator(max(1, PIECE_BYTES // scan.header.point_format.size)):
                columns = {axis: np.asarray(getattr(points, axis), np.float64) for axis in "xyz"}
                if not names:  # the format's own fields are there even if nothing is known of them
                    needed = {*COLUMNS, *own.extra_dimension_names}
                    others = {name for name in {*own.dimension_names} - {*"XYZ"} - needed if np.ptp(points[name])}
                    names = [name for name in own.dimension_names if name in needed | others]
                yield columns | name_columns({name: np.asarray(points[name]) for name in names})
    except UserError as error:
        if not isinstance(error.__cause__, UnicodeDecodeError):
            raise
        raise UserError("has extra bytes whose names are not in UTF-8: export it without them") from None
    except BaseException as error:  # a panic in lazrs, a Rust library, is no Exception
        if type(error).__name__ != "PanicException":
            raise
        raise UserError(f"is a broken LAZ file ({error})") from None


def _check_sizes(content: mmap.mmap) -> int:
    """A lower bound of the points beyond the announced ones; ValueError if the file is too small for its sizes."""
    if content[:4] != b"LASF" or len(content) < SMALLEST_HEADER:
        raise UserError("is not a LAS file, or its header is cut off (expected 'LASF' and at least 227 bytes)")
    place, data, records, kind, length, points = struct.unpack_from("<HIIBHI", content, SIZES)
    if content[25] >= 4 and len(content) >= COUNT_14 + 8:
        (points,) = struct.unpack_from("<Q", content, COUNT_14)
    if not place + records * RECORD_HEAD <= data <= len(content):
        raise UserError(f"is broken: {records} records in its header, points from byte {data} of {len(content)} on")
    if not kind & COMPRESSED:
        if not length or data + points * length > len(content):
            raise UserError(f"is cut off: {points} points of {length} bytes are announced in {len(content)} bytes")
        followed = content[25] == 3 or (content[25] > 3 and any(content[EVLRS : EVLRS + 4]))  # by other data
        return 0 if followed else (len(content) - data) // length - points
    for _ in range(records):
        name, number, size = struct.unpack_from("<16sHH", content, place + 2)
        if name.rstrip(b"\0") == NAME and number == NUMBER:
            break
        place += RECORD_HEAD + size
    else:
        raise UserError("has no record that says how its points are compressed")
    compressor, chunk_size, count = struct.unpack_from("<H10xI16xH", content, place + RECORD_HEAD)
    items = [struct.unpack_from("<HH", content, place + RECORD_HEAD + 34 + 6 * i) for i in range(count)]
    layered = any(kind in LAYERS for kind, _ in items)
    if layered and compressor != CHUNKED_LAYERS:
        raise UserError(f"is broken: points in layers, and {compressor} as the way in which they are compressed")
    if layered and not chunk_size:
        chunk_size = VARIABLE  # COPC writes 0
    (table,) = struct.unpack_from("<q", content, data)
    if table == -1:
        (table,) = struct.unpack_from("<q", content, len(content) - 8)
    (chunks,) = struct.unpack_from("<4xI", content, max(table, 0))
    most = LARGEST_CHUNK if chunk_size == VARIABLE else chunk_size
    # each chunk begins with an uncompressed point
    if sum(size for _, size in items) != length or not 0 < most <= LARGEST_CHUNK or table < 0:
        raise UserError(f"is broken: points of {length} bytes, items {items}, chunks of {chunk_size}, table at {table}")
    if chunks * length > len(content) or chunks * most < points:
        raise UserError(f"is broken: {points} points in {chunks} chunks in {len(content)} bytes")
    place, layers = data + 8, sum(LAYERS.get(kind, size) for kind, size in items)
    held = 0 if layered or chunk_size == VARIABLE else (chunks - 1) * chunk_size + 1  # the last chunk may be shorter
    for number in range(chunks if layered else 0):
        count, *sizes = struct.unpack_from(f"<{1 + layers}I", content, place + length)
        place += length + 4 + 4 * layers + sum(sizes)
        held += count
        if place > len(content) or count > LARGEST_CHUNK:
            raise UserError(f"is cut off: a chunk of {count} points ends at byte {place} of {len(content)}")
        # else lazrs would read the next chunk from the middle of this one
        if chunk_size != VARIABLE and not (count == chunk_size or (count < chunk_size and number == chunks - 1)):
            raise UserError(f"is broken: a chunk of {count} points where each has {chunk_size}")
    if layered and held < points:
        raise UserError(f"is cut off: its header announces {points} points, its chunks hold {held}")
    return max(0, held - points)
