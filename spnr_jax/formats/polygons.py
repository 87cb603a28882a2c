"""PLY, STL and OFF files of triangles and polygons as raw assets: no materials, colours of vertices or faces at most.

Polygons become fans of triangles, or ears where they are not convex (Meisters 1975), so that a notch stays empty.

.ply    elements vertex, and face or tristrips; colours by any of the names that those of points may have
.stl    text: three lines `vertex x y z` a triangle; binary: 80 bytes, a count u32, 50 bytes a triangle.  The size of
        the file counts where the count is 0
.off    [C][N]OFF, counts, vertices x y z [normal] [colour], faces n i j k ... [colour]
"""

import io
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spnr_jax.formats.assets import Asset, Part, RejectedAsset, make_material
from spnr_jax.formats.columns import NORMAL, SRGB, Columns, colors_of, rename, useful
from spnr_jax.formats.row_files import read_elements, read_ply_header
from spnr_jax.kernels.cloud_arrays import stack_columns

TEXCOORDS = ({"s", "t"}, {"u", "v"}, {"texture_u", "texture_v"})
MOST_CORNERS = 2048  # of a polygon whose ears are looked for; a larger one becomes a fan
STL_HEAD, STL_TRIANGLE = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
OFF_HEAD = re.compile(r"(ST)?(C?)(N?)(4?)(n?)OFF\b")


def load_ply_mesh(data: bytes) -> Asset:
    """The raw asset of a PLY file with faces, or strips of them."""
    file = io.BytesIO(data)
    header = read_ply_header(file)
    if (element := header.faces) is None:
        return Asset(parts=())
    (vertices, _), (of_faces, lists) = read_elements(file, header, "vertex", element).values()
    name = next((name for name in ("vertex_indices", "vertex_index") if name in lists), next(iter(lists), None))
    if name is None:
        raise RejectedAsset("has faces without lists of vertices: broken file")
    sizes, corners = lists[name]
    if element == "tristrips":
        strips = (strip for row in np.split(corners, np.cumsum(sizes)[:-1]) for strip in _ended(row))
        corners = np.concatenate([np.zeros((0, 3), np.int64), *map(strip_faces, strips)]).ravel()
        sizes, of_faces = np.full(len(corners) // 3, 3), {}
    texcoords = "texcoord" in lists or any(pair <= vertices.keys() for pair in TEXCOORDS)
    ignored = ("texture coordinates (of formats other than glTF and OBJ)",) if texcoords else ()
    return _colored(vertices, corners, sizes, of_faces, ignored)


def strip_faces(order: np.ndarray) -> np.ndarray:
    """Triangles (f, 3) of a strip of vertices (n,), every other one turned."""
    faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=-1) if len(order) > 2 else np.zeros((0, 3), np.int64)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def _ended(row: np.ndarray) -> list[np.ndarray]:
    """The strips of a row of vertices, which -1 ends."""
    return [strip[strip >= 0] for strip in np.split(row, np.flatnonzero(row == -1))]


def _colored(
    vertices: Columns, corners: np.ndarray, sizes: np.ndarray, of_faces: Columns, ignored: tuple[str, ...] = ()
) -> Asset:
    """The asset of polygons of so many corners, with the colours of their vertices, else those of the polygons."""
    columns = useful(vertices)
    positions = stack_columns(columns)
    faces, owner = triangulate(positions, corners, sizes)
    normals = stack_columns(columns, NORMAL) if set(NORMAL) <= columns.keys() else None
    part = Part(positions=positions, faces=faces, material=make_material(), normals=normals)
    if (found := colors_of(columns)) is not None:
        part = replace(part, colors=found[0], material=make_material(1.0))
    elif (found := colors_of(rename(of_faces))) is not None:
        corners, colors = np.arange(faces.size).reshape(-1, 3), np.repeat(found[0][owner], 3, axis=0)
        part = Part(positions=positions[faces.ravel()], faces=corners, material=make_material(1.0), colors=colors)
    return Asset(parts=(part,), ignored=ignored, notes=tuple(found[1]) if found else ())


def load_stl(data: bytes) -> Asset:
    """The raw asset of an STL file."""
    ignored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    if re.match(rb"\s*solid\b[^\0]*?\b(facet|endsolid)\b", data, re.IGNORECASE):
        numbers = np.fromstring(b" ".join(re.findall(rb"(?i)\bvertex[ \t]+([^\r\n]*)", data)), sep=" ")
        if len(numbers) % 9:
            raise RejectedAsset(f"is cut off: {len(numbers)} coordinates, where each triangle has 9")
        positions = numbers.reshape(-1, 3, 3)
    else:
        if len(data) < STL_HEAD:
            raise RejectedAsset(f"is cut off: a binary STL file has {STL_HEAD} bytes before its triangles")
        announced = int.from_bytes(data[80:84], "little")
        held = (len(data) - STL_HEAD) // STL_TRIANGLE.itemsize
        if announced > held:
            raise RejectedAsset(f"is cut off: its header announces {announced} triangles, {held} are there")
        if not announced:
            notes = (f"the header announces 0 triangles, {held} stand behind it: these are drawn",)
        rows = np.frombuffer(data, STL_TRIANGLE, announced or held, STL_HEAD)
        positions = rows["corners"].astype(np.float64)
        ignored = ("STL attribute bytes",) if rows["attribute"].any() else ()
    faces = np.arange(3 * len(positions)).reshape(-1, 3)
    part = Part(positions=positions.reshape(-1, 3), faces=faces, material=make_material())
    return Asset(parts=(part,), ignored=ignored, notes=notes)


def load_off(data: bytes) -> Asset:
    """The raw asset of an OFF file with faces."""
    columns, rows = _off(data)
    if not rows:
        return Asset(parts=(), points=columns)
    sizes = np.array([int(row[0]) for row in rows])
    corners = np.concatenate([np.array(row[1 : 1 + size], np.int64) for row, size in zip(rows, sizes, strict=True)])
    if len(corners) < sizes.sum():
        raise RejectedAsset("is cut off: a face names fewer corners than it announces")
    behind = [row[1 + int(row[0]) :] for row in rows]
    colored = bool(behind) and all(len(values) in (3, 4) for values in behind)
    of_faces = (
        dict(zip(SRGB, np.array([values[:3] for values in behind], np.float64).T, strict=True)) if colored else {}
    )
    ignored = ("colours of some faces alone",) if any(behind) and not colored and SRGB[0] not in columns else ()
    return _colored(columns, corners, sizes, of_faces, ignored)


def _off(data: bytes) -> tuple[Columns, list[list[float]]]:
    """The columns of the vertices of an OFF file, and the rows of its faces."""
    text = re.sub(r"#.*", "", data.decode("utf-8", "replace"))
    lines = [line for line in (line.strip() for line in text.splitlines()) if line]
    head = OFF_HEAD.match(lines[0]) if lines else None
    if head is None or head[4] or head[5]:
        raise RejectedAsset("is not an OFF file that can be read: expected OFF, COFF, NOFF or CNOFF in text")
    rest = lines[0][head.end() :].split()
    rows = lines[1:] if not rest else [" ".join(rest), *lines[1:]]
    num_vertices, num_faces = (int(word) for word in rows[0].split()[:2]) if rows else (0, 0)
    if min(num_vertices, num_faces) < 0 or len(rows) < 1 + num_vertices + num_faces:
        raise RejectedAsset(
            f"is cut off: it announces {num_vertices} vertices and {num_faces} faces in {len(rows)} lines"
        )
    names = [*"xyz", *(("nx", "ny", "nz") if head[3] else ()), *((*SRGB, "alpha") if head[2] else ())]
    table = np.loadtxt(rows[1 : 1 + num_vertices], ndmin=2) if num_vertices else np.zeros((0, 3))
    columns = dict(zip(names, table.T, strict=False))
    faces = [[float(word) for word in row.split()] for row in rows[1 + num_vertices :][:num_faces]]
    return columns, [row for row in faces if row]


PLAIN = {".ply": load_ply_mesh, ".stl": load_stl, ".off": load_off}


def triangulate(
    positions: np.ndarray, corners: np.ndarray, sizes: Sequence[int] | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Faces (f, 3) of polygons of so many corners, vertex numbers, in their order, and the polygon that each is of."""
    count, corners = np.array(sizes, np.int64), corners.astype(np.int64)
    begin = np.cumsum(count) - count
    faces, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for size in np.unique(count[count > 2]):
        rows = np.flatnonzero(count == size)
        own = corners[begin[rows, None] + np.arange(size)]
        fan = np.stack([np.broadcast_to(own[:, :1], (len(rows), size - 2)), own[:, 1:-1], own[:, 2:]], axis=-1)
        if 3 < size <= MOST_CORNERS and (own >= 0).all() and own.max() < len(positions):
            for row in np.flatnonzero(~_convex(positions[own])):
                fan[row] = own[row][ears(positions[own[row]])]
        faces.append(fan.reshape(-1, 3))
        owners.append(np.repeat(rows, size - 2))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(faces)[order], owner[order]


def _convex(corners: np.ndarray) -> np.ndarray:
    """Whether no corner of polygons (m, n, 3) turns against the sense of the whole."""
    edges = np.roll(corners, -1, axis=1) - corners
    turns = np.cross(np.roll(edges, 1, axis=1), edges)
    centred = corners - corners.mean(axis=1, keepdims=True)
    whole = np.cross(centred, np.roll(centred, -1, axis=1)).sum(axis=1)
    share = np.einsum("mnc,mc->mn", turns, whole)
    against = share < -1e-9 * np.abs(share).max(axis=1, initial=0)[:, None]
    return ~against.any(axis=1) | ~np.isfinite(share).all(axis=1)


def ears(corners: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3) of a simple polygon (n, 3), as numbers of its corners; a fan of what is not simple."""
    centred = corners - corners.mean(axis=0)
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.delete(centred, axis, axis=1) * [1, (1 if axis != 1 else -1) * np.sign(normal[axis] or 1)]
    left, found, i, failed = list(range(len(corners))), [], 0, 0
    while len(left) > 3 and failed < len(left):
        ear = [left[i - 1], left[i], left[(i + 1) % len(left)]]
        if _is_ear(flat, ear, left):
            found.append(tuple(ear))
            left.pop(i)
            i, failed = max(i - 1, 0), 0  # what lies before was no ear, and still is none
        else:
            i, failed = (i + 1) % len(left), failed + 1
    return np.array(found + [(left[0], b, c) for b, c in zip(left[1:-1], left[2:], strict=True)])


def _is_ear(flat: np.ndarray, ear: list[int], left: list[int]) -> bool:
    """Whether three of the points (n, 2) turn left and no other of those left lies in their triangle or on it."""
    edges = flat[[ear[1], ear[2], ear[0]]] - flat[ear]
    if edges[0, 0] * edges[1, 1] <= edges[0, 1] * edges[1, 0]:
        return False
    x, y = np.moveaxis(flat[[j for j in left if j not in ear]][:, None] - flat[ear], -1, 0)
    return not (edges[:, 0] * y - edges[:, 1] * x >= 0).all(axis=1).any()
