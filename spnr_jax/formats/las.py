"""Airborne and terrestrial laser scans (.las, compressed .laz) as named columns, piece by piece, through laspy.

Coordinates come scaled and shifted as the header says, in float64; colours are 16 bit.  What the header announces is
compared with the size of the file before laspy, which takes memory and time for whatever is announced, sees it.  Every
fault is a ValueError; the caller adds the file's name.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError, is_bug
from spnr_jax.formats.laz import RECORD_HEAD, check_laz

PIECE_BYTES = 2**23  # of points in memory at a time
COLUMNS = ("red", "green", "blue", "intensity", "classification", "withheld")
MISSING = "needs the package {package} to be read: pip install 'spnr-jax[formats]'"
# places in the header (ASPRS LAS 1.4 R15, table 3): sizes and counts, the count of version 1.4
SIZES, COUNT_14, SMALLEST_HEADER = 94, 247, 227
COMPRESSED = 0xC0  # bits of the point format
UNREADABLE: tuple[type[Exception], ...]
UNREADABLE = (EOFError, RuntimeError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, struct.error)


def las_pieces(path: Path) -> Iterator[dict[str, np.ndarray]]:
    """The columns x y z, the colours and the intensity of a scan, some points at a time."""
    try:
        import laspy  # an extra: only here
    except ImportError:
        raise UserError(MISSING.format(package="laspy")) from None
    if path.suffix.lower() == ".laz" and laspy.LazBackend.Lazrs not in laspy.LazBackend.detect_available():
        raise UserError(MISSING.format(package="lazrs"))
    # the parallel reader of lazrs ends the whole process on a damaged file
    backends = (laspy.LazBackend.Lazrs,)
    _check_header(path)
    try:
        with laspy.open(path, laz_backend=backends, read_evlrs=False) as scan:
            present = set(scan.header.point_format.dimension_names)
            for points in scan.chunk_iterator(max(1, PIECE_BYTES // scan.header.point_format.size)):
                columns = {axis: np.asarray(getattr(points, axis), np.float64) for axis in "xyz"}
                yield columns | {name: np.asarray(points[name]) for name in COLUMNS if name in present}
    except (laspy.errors.LaspyException, *UNREADABLE) as error:
        if is_bug(error):
            raise
        raise UserError(f"is a broken or truncated LAS file ({error})") from None
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
        check_laz(np.memmap(path, np.uint8, "r"), header_size, records, data, length, count)
    elif not length or data + count * length > size:
        raise UserError(f"is cut off: its header announces {count} points of {length} bytes, in {size} bytes")
