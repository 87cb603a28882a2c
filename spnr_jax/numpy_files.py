"""NumPy files of points (.npz .npy) as named columns, piece by piece where they are not compressed.

    .npz    arrays (points, 3) or (points,) under the names of ARRAY_COLUMNS
    .npy    a structured array of named fields, or an array (points, columns) as in text files

Pickled objects, which could run code, are refused.  Every fault is a ValueError; the caller adds the file's name.
"""

import zipfile
import zlib
from collections.abc import Iterator
from io import BufferedIOBase
from pathlib import Path

import numpy as np

from spnr_jax.text_files import NUMBERS, Columns, plain_names

PIECE_BYTES = 2**25  # of an array in memory at a time
ARRAY_COLUMNS = {
    **dict.fromkeys(("positions", "points", "xyz", "vertices"), ("x", "y", "z")),
    **dict.fromkeys(("base_color", "albedo"), ("base_color_r", "base_color_g", "base_color_b")),
    **dict.fromkeys(("colors", "rgb", "color"), ("r", "g", "b")),
    "roughness": ("roughness",),
    **dict.fromkeys(("metallic", "metalness"), ("metallic",)),
}


def numpy_pieces(path: Path) -> Iterator[Columns]:
    """The columns of an array, some points at a time, or of an archive."""
    with path.open("rb") as file:
        magic = file.read(6)
        file.seek(0)
        if magic.startswith(b"PK"):
            yield _archive(file)
            return
    if not magic.startswith(b"\x93NUMPY"):
        raise ValueError("is not a NumPy file")
    try:
        loaded = np.lib.format.open_memmap(path, mode="r")
    except (EOFError, ValueError) as error:
        raise ValueError(f"is a broken, truncated or pickled NumPy file ({error})") from None
    rows = np.atleast_1d(loaded)
    names = rows.dtype.names or plain_names(rows)
    step = max(1, PIECE_BYTES // max(1, rows[:1].nbytes))
    for start in range(0, max(1, len(rows)), step):
        piece = np.array(rows[start : start + step])
        values = [piece[name] for name in names] if rows.dtype.names else piece.T
        yield {name.lower(): column for name, column in zip(names, values, strict=True)}


def _archive(file: BufferedIOBase) -> Columns:
    """The columns of an archive, which comes whole: its arrays are compressed as such."""
    try:
        with np.load(file, allow_pickle=False) as archive:
            return _named_arrays(archive)
    except (EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"is a broken or truncated NumPy file ({error})") from None


def _named_arrays(archive: np.lib.npyio.NpzFile) -> Columns:
    """The columns of arrays (points, c), or (points,) for scalars, under the names of ARRAY_COLUMNS."""
    columns: Columns = {}
    for name in [name for name in archive if name in ARRAY_COLUMNS]:
        array, targets = archive[name], ARRAY_COLUMNS[name]
        table = array[:, None] if array.ndim == 1 else array
        if table.ndim != 2 or table.shape[1] != len(targets) or table.dtype.kind not in NUMBERS:
            raise ValueError(
                f"has {name!r} of shape {array.shape} and type {array.dtype}, not (points, {len(targets)})"
            )
        columns |= dict(zip(targets, table.T, strict=True))
    if "x" not in columns:
        raise ValueError(f"has no array named positions, points or xyz; found {', '.join(archive) or 'none'}")
    if len({len(column) for column in columns.values()}) > 1:
        raise ValueError(f"has arrays of different lengths: { {name: len(array) for name, array in columns.items()} }")
    return columns
