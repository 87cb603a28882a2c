"""Files of points as named columns, whatever the format: {"x": (points,), "y": ..., "red": ...}.

    .ply              the vertices' properties, ASCII or binary, in any order and of any scalar type
    .xyz .txt .csv    numbers separated by commas, semicolons or blanks; a header line names the columns, or their
                      count does (3: x y z, 6: + r g b, 8: + roughness metallic)
    .pcd              the fields of a Point Cloud Library file (spnr_jax/pcd_files.py)
    .npz              arrays under the names of ARRAY_COLUMNS
    .npy              a structured array of named fields, or an array (points, 3 | 6 | 8) as in text

Columns keep the type that the file gives them; what they mean is the affair of spnr_jax/clouds.py.  Every fault is a
ValueError that says what is wrong with the file; its name is added by the caller.
"""

import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spnr_jax.pcd_files import read_pcd

Columns = dict[str, np.ndarray]
Element = tuple[str, int, list[tuple[str, str | None]]]  # name, count, [(property, type)]; the type of a list is None

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
BYTE_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_HEADER_LIMIT = 2**20  # bytes
FACES = ("face", "tristrips")  # elements that make a PLY a mesh
PLAIN_COLUMNS = ("x", "y", "z", "r", "g", "b", "roughness", "metallic")  # the order of columns without names
PLAIN_COUNTS = (3, 6, 8)
NUMBERS = "fiu"  # kinds of types that hold real numbers
ARRAY_COLUMNS = {
    **dict.fromkeys(("positions", "points", "xyz"), ("x", "y", "z")),
    "base_color": ("base_color_r", "base_color_g", "base_color_b"),
    **dict.fromkeys(("colors", "rgb"), ("r", "g", "b")),
    "roughness": ("roughness",),
    "metallic": ("metallic",),
}


@dataclass(frozen=True, kw_only=True)
class PlyHeader:
    """What a PLY file announces; byte_order is None in a text file."""

    byte_order: str | None
    elements: list[Element]  # in the order of the file
    size: int  # bytes up to the data

    @property
    def is_mesh(self) -> bool:
        """Whether there are faces."""
        return any(name in FACES and count for name, count, _ in self.elements)


def read_columns(path: Path) -> Columns:
    """The columns of a point file, by its suffix (one of READERS)."""
    return READERS[path.suffix.lower()](path)


def read_ply_header(path: Path) -> PlyHeader:
    """The header of a PLY file."""
    with path.open("rb") as file:
        return _ply_header(file.read(PLY_HEADER_LIMIT))


def _ply_header(data: bytes) -> PlyHeader:
    end = re.search(rb"^end_header[ \t]*(\r\n|\n|\r)", data, re.MULTILINE)
    if not data.startswith(b"ply") or end is None:
        raise ValueError("is not a PLY file, or its header is cut off (expected 'ply' ... 'end_header')")
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
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1][2].append((name, PLY_TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"has a PLY header line that is not understood: {line.strip()!r}")
    if byte_order == "unknown":
        raise ValueError(f"has a PLY header without a known format; expected one of {', '.join(BYTE_ORDERS)}")
    return PlyHeader(byte_order=byte_order, elements=elements, size=end.end())


def parse_ply(content: bytes) -> Columns:
    """The columns of the vertices in the bytes of a PLY file; elements before them are skipped."""
    header = _ply_header(content[:PLY_HEADER_LIMIT])
    rows_before = bytes_before = 0
    for name, count, properties in header.elements:
        if count and any(kind is None for _, kind in properties):
            raise ValueError(
                f"has lists in its PLY element {name!r}, in or before the vertices: not readable as points"
            )
        order = header.byte_order or "="
        dtype = np.dtype([(field, order + kind) for field, kind in properties if kind is not None])
        if name == "vertex":
            body = content[header.size :]
            if header.byte_order is None:
                return _by_name(_text_rows(body, rows_before, count, dtype))
            return _by_name(_binary_rows(body, bytes_before, count, dtype))
        rows_before, bytes_before = rows_before + count, bytes_before + count * dtype.itemsize
    raise ValueError(f"has no PLY element 'vertex', only {', '.join(name for name, _, _ in header.elements) or 'none'}")


def _text_rows(body: bytes, before: int, count: int, dtype: np.dtype) -> np.ndarray:
    """`count` records of ASCII data behind `before` other lines."""
    lines = [line for line in body.decode("ascii", "replace").splitlines() if line.strip()]
    rows = lines[before : before + count]
    _check_complete(len(rows), count)
    return np.loadtxt(rows, dtype=dtype, comments=None, ndmin=1) if rows else np.empty(0, dtype)


def _binary_rows(body: bytes, before: int, count: int, dtype: np.dtype) -> np.ndarray:
    """`count` records of binary data behind `before` other bytes."""
    _check_complete(max(0, len(body) - before) // max(1, dtype.itemsize), count)
    return np.frombuffer(body, dtype, count, before)


def _check_complete(found: int, announced: int) -> None:
    if found < announced:
        raise ValueError(f"is cut off: its header announces {announced} points, the data ends after {found}")


def _read_text(path: Path) -> Columns:
    """The columns of a text file; the last line before the numbers may name them, also behind # or //."""
    header, is_comment = "", True
    numbers: list[str] = []
    for line in path.read_bytes().decode("utf-8-sig", "replace").splitlines():
        line = line.strip()
        text = re.sub(r"^(#|//)\s*", "", line)
        if not numbers and text and not _is_number(_split(text)[0]):
            header, is_comment = text, text != line
        elif text and text == line:
            numbers.append(line)
    if not numbers:
        return {}
    delimiter = next((mark for mark in ";," if mark in numbers[0]), None)
    table = np.loadtxt(numbers, delimiter=delimiter, comments=None, ndmin=2)
    names = [name.strip("\"'").lower() for name in _split(header)]
    if is_comment and ("x" not in names or len(names) != table.shape[1]):
        return _plain_columns(table)
    if len(names) != table.shape[1]:
        raise ValueError(f"names {len(names)} columns ({' '.join(names)}) above {table.shape[1]} columns of numbers")
    return dict(zip(names, table.T, strict=True))


def _read_numpy(path: Path) -> Columns:
    """The columns of an array or archive; pickled objects, which could run code, are refused."""
    with path.open("rb") as file:
        if not file.read(6).startswith((b"\x93NUMPY", b"PK")):
            raise ValueError("is not a NumPy file")
        file.seek(0)
        try:
            loaded = np.load(file, allow_pickle=False)
            if not isinstance(loaded, np.ndarray):
                return _named_arrays(loaded)
        except (EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"is a broken or truncated NumPy file ({error})") from None
    return _by_name(np.atleast_1d(loaded)) if loaded.dtype.names else _plain_columns(loaded)


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


def _by_name(rows: np.ndarray) -> Columns:
    return {name.lower(): rows[name] for name in rows.dtype.names or ()}


def _plain_columns(table: np.ndarray) -> Columns:
    """Columns of a table (points, 3 | 6 | 8) without names."""
    if table.ndim != 2 or table.shape[1] not in PLAIN_COUNTS or table.dtype.kind not in NUMBERS:
        raise ValueError(
            f"has numbers of shape {table.shape} and type {table.dtype} without column names; expected rows of "
            f"3, 6 or 8 numbers ({' '.join(PLAIN_COLUMNS)}), or a header line that names the columns"
        )
    return dict(zip(PLAIN_COLUMNS, table.T, strict=False))


def _split(line: str) -> list[str]:
    return re.split(r"[\s,;]+", line)


def _is_number(text: str) -> bool:
    return (
        re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", text, re.IGNORECASE) is not None
    )


READERS = {
    ".ply": lambda path: parse_ply(path.read_bytes()),
    ".pcd": read_pcd,
    **dict.fromkeys((".xyz", ".txt", ".csv"), _read_text),
    **dict.fromkeys((".npz", ".npy"), _read_numpy),
}
