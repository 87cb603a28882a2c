"""One table of points, and a writer of it for each format that holds points."""

import io
import itertools
from typing import NamedTuple

import numpy as np
import pytest

from support.gltf_files import GltfBuilder
from support.point_clouds import SRGB, ply_bytes, write


class Table(NamedTuple):
    """Positions (12, 3) that every format holds exactly, levels (12, 3) of red green blue, roughness (12,)."""

    positions: np.ndarray
    levels: np.ndarray
    roughness: np.ndarray


rng = np.random.default_rng(0)
WHOLE = Table(np.round(rng.uniform(-64, 64, (12, 3))) / 8, rng.integers(0, 256, (12, 3)), np.arange(12) / 16)
WHOLE.levels[:2] = [[255, 5, 188], [0, 9, 64]]
BROKEN = WHOLE._replace(positions=WHOLE.positions.copy())
BROKEN.positions[[1, 3, 5], [0, 1, 2]] = np.nan, -np.inf, 1e39
SOUND = np.delete(np.arange(12), [1, 3, 5])


def as_npy(array: np.ndarray, pickled: bool = False) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=pickled)
    return stream.getvalue()


PCD_FIELDS = [("x", "<f4"), ("y", "<f4"), ("pad", "u1", (3,)), ("z", "<f4"), ("rgb", "<f4"), ("roughness", "<f8")]


def compress_lzf(data: bytes) -> bytes:
    """LZF whose only copies are of runs of one byte."""
    out = b""
    for byte, run in itertools.groupby(data):
        left = len(list(run)) - 1
        out += bytes([0, byte])
        while left >= 3:
            size = min(left, 264)
            out += bytes([size - 2 << 5, 0]) if size < 9 else bytes([7 << 5, size - 9, 0])
            left -= size
        out += bytes([0, byte]) * left
    return out


def as_ply(form: str, newline: str = "\n"):
    names = ["z", "red", "x", "label", "green", "y", "blue", "roughness"]
    kinds = {"red": "uchar", "green": "uchar", "blue": "uchar", "label": "short"}

    def content(table):
        columns = dict(zip(["x", "y", "z", "red", "green", "blue"], [*table.positions.T, *table.levels.T], strict=True))
        columns |= {"roughness": table.roughness, "label": np.arange(12) - 6}
        rows = list(zip(*(columns[name].tolist() for name in names), strict=True))
        return ply_bytes(form, newline, rows, [(name, kinds.get(name, "double")) for name in names])

    return content


def as_pcd(encoding: str, newline: str = "\n", stored: bool = False):
    """A writer of PCD files in an encoding; what should be compressed may be stored as it is."""
    header = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", "FIELDS x y _ z rgb roughness"]
    header += ["SIZE 4 4 1 4 4 8", "TYPE F F U F F F", "COUNT 1 1 3 1 1 1", "WIDTH 12", "HEIGHT 1"]
    header += ["VIEWPOINT 0 0 0 1 0 0 0", "POINTS 12", f"DATA {encoding}", ""]
    head = newline.join(header).encode()

    def content(table):
        rows = np.zeros(12, PCD_FIELDS)
        with np.errstate(over="ignore"):
            rows["x"], rows["y"], rows["z"] = table.positions.T
        rows["rgb"] = (table.levels @ [1 << 16, 1 << 8, 1]).astype(np.uint32).view(np.float32)
        rows["roughness"] = table.roughness
        if encoding == "binary":
            return head + rows.tobytes()
        if encoding == "ascii":
            texts = (" ".join(repr(float(x)) for cell in row for x in np.ravel(cell)) + newline for row in rows)
            return head + "".join(text.replace(".0 ", " ") for text in texts).encode()
        plain = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
        body = plain if stored else compress_lzf(plain)
        return head + np.array([len(body), len(plain)], "<u4").tobytes() + body

    return content


def as_text(separator: str, header: str = "", factor: float = 1, start: str = "", columns: int = 8):
    def content(table):
        rows = np.column_stack([table.positions, table.levels * factor, table.roughness, np.zeros(12)])[:, :columns]
        return header + "".join(start + separator.join(f"{v:.17g}" for v in row) + "\n" for row in rows)

    return content


def as_numpy(path, table):
    if path.suffix == ".npz":
        columns = {"xyz": table.positions, "rgb": table.levels.astype(np.uint8), "roughness": table.roughness[:, None]}
        np.savez_compressed(path, **columns, notes=np.array([{}]))
    else:
        rows = np.zeros(12, [(name, "f8" if name in "xyz" or len(name) > 5 else "u1") for name in FIELDS])
        for name, column in zip(FIELDS, [*table.positions.T, *table.levels.T, table.roughness], strict=True):
            rows[name] = column
        np.save(path, rows)


def as_scan(path, table, point_format: int = 7, **extra):
    laspy = pytest.importorskip("laspy")
    scan = laspy.LasData(laspy.LasHeader(point_format=point_format, version="1.4"))
    scan.header.scales = [0.125] * 3
    scan.x, scan.y, scan.z = table.positions.T
    scan.intensity = 100 * np.arange(12)
    if point_format == 7:
        scan.red, scan.green, scan.blue = (257 * table.levels.T).astype(np.uint16)
    for name, values in extra.items():
        scan.add_extra_dim(laspy.ExtraBytesParams(name, values.dtype))
        scan[name] = values
    scan.write(path)


def as_scene(path, table):
    builder, (red, green, blue) = GltfBuilder(), SRGB[table.levels].T
    colors = np.stack([red, green, blue, np.ones(12)], axis=-1).astype("f4")
    with np.errstate(over="ignore"):
        points = builder.primitive((table.positions - [0, 0, 2]).astype("f4"), None, mode=0, COLOR_0=colors)
    builder.mesh(points, translation=[0, 0, 2])
    builder.write(path)


FIELDS = ["x", "y", "z", "red", "green", "blue", "roughness"]
WRITERS = {
    "ascii.ply": as_ply("ascii"),
    "little.ply": as_ply("binary_little_endian"),
    "big.ply": as_ply("binary_big_endian"),
    "carriage.ply": as_ply("binary_little_endian", "\r\n"),
    "ascii.pcd": as_pcd("ascii"),
    "binary.pcd": as_pcd("binary"),
    "carriage.pcd": as_pcd("binary", "\r\n"),
    "packed.pcd": as_pcd("binary_compressed"),
    "stored.pcd": as_pcd("binary_compressed", stored=True),
    "a.xyz": as_text(" "),
    "a.csv": as_text(",", "x,y,z,r,g,b,rough,metal\n"),
    "unit.txt": as_text(";", "//X;Y;Z;diffuse_red;diffuse_green;diffuse_blue\n", 1 / 255, columns=6),
    "a.npy": as_numpy,
    "a.npz": as_numpy,
    "a.las": as_scan,
    "a.laz": as_scan,
    "a.obj": as_text(" ", "# points\n", 1 / 255, "v ", 6),
    "a.off": as_text(" ", "COFF\n12 0 0\n", columns=6),
    "a.glb": as_scene,
    "a.gltf": as_scene,
}


def written(folder, name, table):
    """A file of a table."""
    writer = WRITERS[name]
    if writer in (as_numpy, as_scan, as_scene):
        writer(folder / name, table, **({"Roughness": table.roughness} if writer is as_scan else {}))
        return folder / name
    return write(folder, name, writer(table))
