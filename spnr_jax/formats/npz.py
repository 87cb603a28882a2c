"""NumPy files of points (.npz .npy) as named columns, piece by piece where they are not compressed.

    .npz    arrays (points, 3) or (points,) under the names of ARRAY_COLUMNS
    .npy    a structured array of named fields, or an array (points, columns) or (height, width, columns) as in text

Pickled objects, which could run code, are refused.  Every fault is a ValueError; the caller adds the file's name.
"""

import contextlib
import io
import math
import threading
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.text import NUMBERS, Columns, plain_names

HEADERS = threading.Lock()  # Python's parser, which NumPy reads headers with, fails in two threads at once (gh-106905)
PIECE_BYTES = 2**25  # of an array in memory at a time
MOST_BYTES = 2**31  # of an archive's arrays when unpacked: a small file can announce any number
# what NumPy and zipfile raise on files that break their rules
UNREADABLE: tuple[type[Exception], ...]
UNREADABLE = (ValueError, LookupError, TypeError, ArithmeticError, EOFError, OSError, RuntimeError, SyntaxError)
UNREADABLE += (tokenize.TokenError, zipfile.BadZipFile, zlib.error)
ARRAY_COLUMNS = {
    **dict.fromkeys(("positions", "points", "xyz", "vertices"), ("x", "y", "z")),
    **dict.fromkeys(("base_color", "albedo"), ("base_color_r", "base_color_g", "base_color_b")),
    **dict.fromkeys(("colors", "rgb", "color"), ("r", "g", "b")),
    "roughness": ("roughness",),
    **dict.fromkeys(("metallic", "metalness"), ("metallic",)),
    "normals": ("nx", "ny", "nz"),
}


def numpy_pieces(path: Path) -> Iterator[Columns]:
    """The columns of an array, some points at a time, or of an archive."""
    with path.open("rb") as file:
        magic = file.read(6)
        file.seek(0)
        if magic.startswith(b"PK"):
            yield _name_columns(read_arrays(file, ARRAY_COLUMNS))
            return
    if not magic.startswith(b"\x93NUMPY"):
        raise UserError("is not a NumPy file")
    try:
        with _parsing():
            loaded = np.lib.format.open_memmap(path, mode="r")
    except UNREADABLE as error:
        raise UserError(f"is a broken, truncated or pickled NumPy file ({error})") from None
    rows = np.atleast_1d(loaded)
    if rows.ndim == 3:  # the pixels of a picture
        rows = rows.reshape(-1, rows.shape[2])
    names = rows.dtype.names or plain_names(rows)
    step = max(1, PIECE_BYTES // max(1, rows[:1].nbytes))
    for start in range(0, max(1, len(rows)), step):
        piece = np.array(rows[start : start + step])
        values = [piece[name] for name in names] if rows.dtype.names else piece.T
        yield {name.lower(): column for name, column in zip(names, values, strict=True)}


def pack_arrays(arrays: dict[str, np.ndarray], *, compressed: bool = False) -> bytes:
    """An .npz archive of arrays by their names."""
    stream = io.BytesIO()
    save = np.savez_compressed if compressed else np.savez
    save(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def read_arrays(file: io.BufferedIOBase, wanted: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an .npz archive, those whose names are wanted; ValueError if it is broken or unpacks to too much.

    An array's size is checked before memory is taken for it: its header must not announce more than its bytes.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            names = [name for name in members if wanted is None or name in wanted]
            unpacked = sum(members[name].file_size for name in names)
            if unpacked > MOST_BYTES:
                raise UserError(
                    f"unpacks to {unpacked} bytes, more than {MOST_BYTES}; use .npy, which is read in pieces"
                )
            for name in names:
                arrays[name] = _member(archive, members[name])
    except UNREADABLE as error:
        raise UserError(f"is a broken or truncated NumPy file ({error})") from None
    if not arrays:
        raise UserError(f"has none of the arrays {', '.join(wanted or ())}; found {', '.join(members) or 'none'}")
    return arrays


@contextlib.contextmanager
def _parsing() -> Iterator[None]:
    """Headers are read by one thread at a time; NumPy warns of those of Python 2, which it reads well."""
    with HEADERS, warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*required additional header parsing", UserWarning)
        yield


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """One array of an archive."""
    with _parsing(), archive.open(info) as stream:
        version = np.lib.format.read_magic(stream)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(stream)
        if dtype.hasobject or any(size < 0 for size in shape):
            raise UserError(f"{info.filename} holds objects or a negative size, shape {shape} and type {dtype}")
        if math.prod(shape) * dtype.itemsize > info.file_size:
            raise UserError(f"{info.filename} is cut off: shape {shape} of {dtype} in {info.file_size} bytes")
    with _parsing(), archive.open(info) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _name_columns(archive: dict[str, np.ndarray]) -> Columns:
    """The columns of arrays (points, c), or (points,) for scalars, under the names of ARRAY_COLUMNS."""
    columns: Columns = {}
    for name, array in archive.items():
        targets = ARRAY_COLUMNS[name]
        table = array[:, None] if array.ndim == 1 else array
        if table.ndim != 2 or table.shape[1] != len(targets) or table.dtype.kind not in NUMBERS:
            raise UserError(f"has {name!r} of shape {array.shape} and type {array.dtype}, not (points, {len(targets)})")
        columns |= dict(zip(targets, table.T, strict=True))
    if "x" not in columns:
        raise UserError(f"has no array named positions, points or xyz; found {', '.join(archive) or 'none'}")
    if len({len(column) for column in columns.values()}) > 1:
        raise UserError(f"has arrays of different lengths: { {name: len(array) for name, array in columns.items()} }")
    return columns
