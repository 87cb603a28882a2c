"""Points in files of NumPy as named columns, and archives of named arrays.

    .npz    named arrays (points, c) or (points,); an array of positions may have more columns, as in text
    .npy    a structured array of named fields, or an array (points, columns) or (height, width, columns), as in text

Pickled objects, which could run code, are refused.
"""

import contextlib
import io
import threading
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats.columns import (
    ARRAYS,
    PLACES,
    POSITION,
    SHOWN_NAMES,
    Columns,
    Report,
    fits_columns,
    list_names,
    name_columns,
    plain_name,
)
from spnr_jax.formats.point_tables import MOST_COLUMNS, plain_names

SINGLE = 4  # an array of at most so many numbers does not belong to the points
FIRST_ROWS, PIECE_BYTES = 2**17, 2**25  # looked at for names; in memory at a time
MOST_BYTES = 2**31  # of an archive's arrays when unpacked: a small file can declare any size
PARSER = threading.Lock()  # ast.literal_eval, which NumPy reads headers with, is not thread-safe (gh-106905)
UNNAMED = tuple(f"arr{i}" for i in range(9))  # np.savez's names of arrays passed without one


def numpy_pieces(path: Path, report: Report) -> Iterator[Columns]:
    """The columns of an array (.npy), some points at a time, or of an archive (.npz)."""
    with path.open("rb") as file:
        magic = file.read(6)
        file.seek(0)
        if magic.startswith(b"PK"):
            arrays = read_arrays(file, (*PLACES.split(), "v", *ARRAYS, *UNNAMED), report)
            tables = {plain_name(name): _as_rows(array, report) for name, array in arrays.items()}
            others = {*PLACES.split(), *UNNAMED, *POSITION}
            if "v" in tables and tables.keys() & others:  # beside other places it holds something else
                report("arrays that are not used: v")
                del tables["v"]
            yield _archive_columns(tables, report)
            return
    broken = "is a broken, truncated or pickled NumPy file: save arrays, as np.savez(file, points=..., colors=...)"
    try:
        with _parsing(broken):
            rows = np.atleast_1d(np.lib.format.open_memmap(path, mode="r"))
    except MemoryError:  # the header is nested too deeply for Python's parser
        raise UserError(broken) from None
    if rows.ndim > 2 and rows.dtype == np.uint8:
        raise UserError(f"has the shape {rows.shape} and the bytes of a picture; expected points")
    fields = rows.dtype.names
    rows = rows.reshape(-1) if fields else _as_rows(rows, report)
    names = fields or plain_names(rows[:FIRST_ROWS], report)
    step = max(1, PIECE_BYTES // max(1, rows[:1].nbytes))
    for start in range(0, max(1, len(rows)), step):
        piece = np.array(rows[start : start + step])
        yield name_columns({name: piece[name] if fields else piece[:, i] for i, name in enumerate(names)})


def _as_rows(array: np.ndarray, report: Report) -> np.ndarray:
    """A table (points, c) of a table (points, c) or (c, points), or of point maps (..., h, w, c)."""
    if sum(size > 1 for size in array.shape[:-1]) > 1:
        report(f"an array of {' x '.join(map(str, array.shape))} taken as one cloud; of a batch, save array[0] alone")
    table = array.reshape(-1, array.shape[-1]) if array.ndim > 2 else array
    if table.ndim < 2 or not 3 <= len(table) <= MOST_COLUMNS < table.shape[1]:
        return table
    report(f"an array of {len(table)} x {table.shape[1]} taken as one column for each point")
    return table.T


@contextlib.contextmanager
def _parsing(broken: str) -> Iterator[None]:
    """Context for NumPy to read a file: one thread at a time, no warnings about old headers; UserError if broken."""
    with refusing(broken), PARSER, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def pack_arrays(arrays: dict[str, np.ndarray], *, compressed: bool = False) -> bytes:
    """The bytes of an .npz archive of named arrays."""
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def read_arrays(
    file: io.BufferedIOBase, wanted: Collection[str] | None = None, report: Report = lambda line: None
) -> dict[str, np.ndarray]:
    """The wanted arrays of an .npz archive; reports the others; ValueError if it is broken or unpacks to too much."""
    with _parsing("is a broken or truncated NumPy file"), np.load(file, allow_pickle=False) as archive:
        names = [name for name in archive.files if wanted is None or {name, plain_name(name)} & {*wanted}]
        sizes = {info.filename.removesuffix(".npy"): info.file_size for info in archive.zip.infolist()}
        if (unpacked := sum(sizes[name] for name in names)) > MOST_BYTES:
            raise UserError(f"unpacks to {unpacked} bytes, more than {MOST_BYTES}; use .npy, which is read in pieces")
        try:
            arrays = {name: np.asarray(archive[name]) for name in names}
        except MemoryError:  # a header can declare any size
            raise UserError("announces more than fits into the memory") from None
    if others := [name for name in sizes if name not in names]:
        report(f"arrays that are not used: {list_names(others)}")
    if not arrays:
        expected = list_names([*(wanted or ())][:SHOWN_NAMES])
        raise UserError(f"has none of the arrays {expected}; found {', '.join(sizes) or 'none'}")
    return arrays


def _archive_columns(arrays: dict[str, np.ndarray], report: Report) -> Columns:
    """The columns of named arrays (points, c) or (points,), and of unnamed ones that are as long."""
    columns: Columns = {}
    if name := next((name for name in (*PLACES.split(), "arr0", "v") if name in arrays), None):
        table = np.atleast_2d(arrays.pop(name))
        unnamed = [arrays.pop(other) for other in UNNAMED if other in arrays]
        beside = [array for array in unnamed if array.shape in ((len(table), 3), (len(table), 4))]
        table = np.concatenate([table, *beside], axis=1) if name in UNNAMED else table
        columns = dict(zip(plain_names(table, report), table.T, strict=True))
    count = len(columns["x"]) if name else np.size(arrays.get("x", ()))
    others = [
        other
        for other, x in arrays.items()
        if (name if other in POSITION else np.size(x) <= SINGLE < count or not fits_columns(x))
    ]
    if others:
        report(f"arrays that are not used, which name no column of the {count} points: {list_names(others)}")
    arrays = {other: x for other, x in arrays.items() if other not in others}
    columns |= name_columns(arrays)
    if len({len(column) for column in columns.values()}) > 1:
        raise UserError(f"has arrays of different lengths: { {name: len(array) for name, array in columns.items()} }")
    return columns
