"""Points on a ball, and PLY files made by hand."""

import numpy as np

from spnr_jax.formats.clouds import read_cloud
from spnr_jax.formats.point_files import column_pieces, kind_of
from spnr_jax.formats.row_files import join_pieces
from spnr_jax.surfels.sides import spiral

BALL = np.round(spiral(420), 4)
GREEN = (40, 170, 60)
LINEAR = np.array([0.0212, 0.4020, 0.0452])  # of GREEN
SRGB = np.where(np.arange(256) <= 10, np.arange(256) / 255 / 12.92, ((np.arange(256) / 255 + 0.055) / 1.055) ** 2.4)
VERTEX = [("y", "double"), ("red", "uchar"), ("x", "float"), ("label", "short"), ("z", "float")]
NUMPY = {"double": "f8", "uchar": "u1", "float": "f4", "short": "i2"}
ROWS = [(0.125, 255, -1.5, -7, 3.0), (2.5, 0, 1e-3, 300, -4.25), (0.0, 7, 9.0, 0, 1.0)]


def ply_bytes(form: str, newline: str = "\n", rows=ROWS, properties=VERTEX, before: int = 2) -> bytes:
    """A PLY file of `rows`, behind an element of `before` cameras and in front of an element of edges."""
    header = ["ply", f"format {form} 1.0", "comment made by hand", "obj_info none"]
    header += [f"element camera {before}", "property float f", "property int id", f"element vertex {len(rows)}"]
    header += [f"property {kind} {name}" for name, kind in properties]
    header += ["element edge 1", "property list uchar int ends", "end_header", ""]
    head = newline.join(header).encode()
    if form == "ascii":
        lines = ["1.5 3"] * before + [" ".join(map(str, row)) for row in rows] + ["2 0 1", ""]
        return head + newline.join(lines).encode()
    order = "<" if "little" in form else ">"
    camera = np.array([(1.5, 3)] * before, [("f", order + "f4"), ("id", order + "i4")])
    vertex = np.array(rows, [(name, order + NUMPY[kind]) for name, kind in properties])
    return head + camera.tobytes() + vertex.tobytes() + b"\x02\0\0\0\0\1\0\0\0"


def packed_splats(points: np.ndarray, color: int) -> bytes:
    """A compressed .ply of splats at points (n, 3) in [-1, 1], all of one colour 0xRRGGBBAA."""
    chunks = -(-len(points) // 256)
    head = f"ply\nformat binary_little_endian 1.0\nelement chunk {chunks}\n"
    head += "".join(f"property float {end}_{axis}\n" for end in ("min", "max") for axis in "xyz")
    head += f"element vertex {len(points)}\n"
    head += "".join(f"property uint packed_{name}\n" for name in ("position", "rotation", "scale", "color"))
    x, y, z = np.round((points + 1) / 2 * [2047, 1023, 2047]).astype("<u4").T
    rows = np.stack([x << 21 | y << 11 | z, 0 * x, 0 * x, np.full_like(x, color)], axis=1)
    return (head + "end_header\n").encode() + np.array(chunks * ([-1] * 3 + [1] * 3), "<f4").tobytes() + rows.tobytes()


def sphere_points(seed: int, num_points: int) -> np.ndarray:
    """Points on a sphere, much denser at one pole."""
    points = np.random.default_rng(seed).normal(size=(num_points, 3)) + [0, 1.5, 0]
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


XYZRGB = [("x", "float"), ("y", "float"), ("z", "float"), ("red", "uchar"), ("green", "uchar"), ("blue", "uchar")]


def write(folder, name: str, content: bytes | str):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def write_rows(folder, positions, **columns):
    """A structured .npy file of positions (n, 3) and other columns by their names."""
    columns = dict(zip("xyz", np.asarray(positions, float).T, strict=True)) | columns
    rows = np.zeros(len(positions), [(name, np.asarray(column).dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    np.save(folder / "a.npy", rows)
    return folder / "a.npy"


def read(path, **options):
    """The cloud and the lines that it reported."""
    lines: list[str] = []
    return read_cloud(path, report=lines.append, **options), lines


def read_columns(path) -> dict[str, np.ndarray]:
    """The columns of a whole file of points."""
    return join_pieces(column_pieces(path, kind_of(path), print))
