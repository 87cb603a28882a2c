"""PCD files made by hand, in every encoding."""

import itertools

import numpy as np

ENCODINGS = "ascii", "binary", "binary_compressed"
LAYOUT = np.dtype([("x", "<f4"), ("y", "<f4"), ("pad", "u1", (3,)), ("z", "<f4"), ("rgb", "<f4"), ("roughness", "<f8")])
COLORS = np.array([[255, 0, 3], [1, 128, 250], [7, 7, 7], [0, 255, 0]], np.uint32)


def points() -> np.ndarray:
    """Four points with colours packed into floats, and padding between their columns."""
    rows = np.zeros(4, LAYOUT)
    rows["x"], rows["y"], rows["z"] = [1.5, -2, 0, 3], [0.25, 1, 1, 1], [9, 8, 7, -6]
    rows["rgb"] = packed(COLORS)
    rows["roughness"] = [0, 0.25, 0.5, 1]
    return rows


def packed(colors: np.ndarray) -> np.ndarray:
    """Colours (n, 3) of 8 bits in the bits of floats (n,)."""
    return (colors[:, 0] << 16 | colors[:, 1] << 8 | colors[:, 2]).astype(np.uint32).view(np.float32)


def compress(data: bytes) -> bytes:
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


def content(encoding: str, rows: np.ndarray, newline: str = "\n", stored: bool = False) -> bytes:
    """A PCD file of the points in an encoding; what should be compressed may be stored as it is."""
    header = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", "FIELDS x y _ z rgb roughness"]
    header += ["SIZE 4 4 1 4 4 8", "TYPE F F U F F F", "COUNT 1 1 3 1 1 1", f"WIDTH {len(rows)}", "HEIGHT 1"]
    header += ["VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(rows)}", f"DATA {encoding}", ""]
    head = newline.join(header).encode()
    if encoding == "ascii":
        lines = [" ".join(repr(float(value)) for value in np.hstack([np.ravel(cell) for cell in row])) for row in rows]
        return head + newline.join([line.replace(".0 ", " ") for line in lines] + [""]).encode()
    if encoding == "binary":
        return head + rows.tobytes()
    plain = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
    body = plain if stored else compress(plain)
    return head + np.array([len(body), len(plain)], "<u4").tobytes() + body
