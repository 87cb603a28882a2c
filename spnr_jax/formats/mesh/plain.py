"""PLY, STL and OFF files of triangles and polygons as raw assets: no materials, colours of vertices or faces at most.

.ply    elements vertex and face through trimesh; colours by any of the names that those of points may have
.stl    text through trimesh; binary: 80 bytes, a count u32, 50 bytes a triangle.  Where the count and the size of
        the file disagree the size counts
.off    [C][N]OFF, counts, vertices x y z [normal] [colour], faces n i j k ... [colour]
"""

import io
import re
from dataclasses import replace

import numpy as np
from trimesh.exchange.ply import load_ply
from trimesh.exchange.stl import load_stl_ascii
from trimesh.geometry import triangulate_quads

from spnr_jax.formats.mesh.assets import Asset, Part, RejectedAsset, make_material
from spnr_jax.formats.mesh.file_colors import PACKED, SRGB, colors_of
from spnr_jax.formats.mesh.polygons import triangulate

STL_HEAD, STL_TRIANGLE = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
OFF_HEAD = re.compile(r"(ST)?(C?)(N?)(4?)(n?)OFF\b")


def color_part(part: Part, colors: np.ndarray | None, owner: np.ndarray | None = None) -> Part:
    """The part with linear colours (n, 3) of its vertices or, with the `owner` of each face, of polygons."""
    if colors is None:
        return part
    if owner is None:
        return replace(part, colors=colors, material=make_material(1.0))
    corners = np.arange(part.faces.size).reshape(-1, 3)
    own = part.positions[part.faces.ravel()], np.repeat(colors[owner], 3, axis=0)
    return Part(positions=own[0], faces=corners, material=make_material(1.0), colors=own[1])


def load_ply_mesh(data: bytes) -> Asset:
    """The raw asset of a PLY file with faces."""
    end = data.find(b"end_header")
    if end > 0 and b"\n" not in data[:end]:  # trimesh reads lines that end in a line feed alone
        data = data[:end].replace(b"\r", b"\n") + b"end_header\n" + data[end + len(b"end_header\r") :]
    loaded = load_ply(io.BytesIO(data), fix_texture=False, skip_materials=True)
    if loaded.get("faces") is None:
        return Asset(parts=())
    raw = loaded["metadata"]["_ply_raw"]
    positions, polygons = np.asarray(loaded["vertices"], np.float64), loaded["faces"]
    whole = isinstance(polygons, np.ndarray) and polygons.ndim == 2 and polygons.shape[1] == 3
    faces, owner = (polygons.astype(np.int64), np.arange(len(polygons))) if whole else triangulate(positions, polygons)
    part = Part(positions=positions, faces=faces, material=make_material(), normals=loaded.get("vertex_normals"))
    ignored = ("texture coordinates (of formats other than glTF and OBJ)",) if "visual" in loaded else ()
    for element, owners in (("vertex", None), ("face", owner)):
        found = colors_of(_columns(raw[element]["data"]))
        if found is not None:
            return Asset(parts=(color_part(part, found[0], owners),), ignored=ignored, notes=tuple(found[1]))
    return Asset(parts=(part,), ignored=ignored)


def _columns(data: dict | np.ndarray) -> dict[str, np.ndarray]:
    """The columns of numbers among what trimesh read of an element."""
    names = data if isinstance(data, dict) else data.dtype.names or ()
    columns = {name.lower(): np.asarray(data[name]) for name in names}
    columns = {name: x[:, 0] if x.ndim == 2 and x.shape[1] == 1 else x for name, x in columns.items()}
    kinds = {name: column for name, column in columns.items() if column.ndim == 1 and column.dtype.kind in "fiu"}
    return {name: column for name, column in kinds.items() if name not in PACKED or column.dtype.itemsize >= 4}


def load_stl(data: bytes) -> Asset:
    """The raw asset of an STL file."""
    if data[:5].lower() == b"solid" and b"facet" in data[:1024]:
        loaded = load_stl_ascii(io.BytesIO(data))
        meshes = loaded["geometry"].values() if "geometry" in loaded else [loaded]
        parts = [
            Part(
                positions=np.asarray(m["vertices"], np.float64),
                faces=triangulate_quads(m["faces"]),
                material=make_material(),
            )
            for m in meshes
            if m.get("faces") is not None
        ]
        return Asset(parts=tuple(parts))
    if len(data) < STL_HEAD:
        raise RejectedAsset(f"is cut off: a binary STL file has {STL_HEAD} bytes before its triangles")
    announced = int.from_bytes(data[80:84], "little")
    notes: tuple[str, ...] = ()
    held = (len(data) - STL_HEAD) // STL_TRIANGLE.itemsize
    if announced > held:
        raise RejectedAsset(f"is cut off: its header announces {announced} triangles, {held} are there")
    count = announced or held
    if count != announced:
        notes = (f"the header announces {announced} triangles, {held} stand behind it: these are drawn",)
    rows = np.frombuffer(data, STL_TRIANGLE, count, STL_HEAD)
    positions = rows["corners"].reshape(-1, 3).astype(np.float64)
    ignored = ("STL attribute bytes",) if rows["attribute"].any() else ()
    part = Part(positions=positions, faces=np.arange(3 * count).reshape(-1, 3), material=make_material())
    return Asset(parts=(part,), ignored=ignored, notes=notes)


def load_off(data: bytes) -> Asset:
    """The raw asset of an OFF file with faces."""
    columns, rows = _off(data)
    positions = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    corners = [np.array(row[1 : 1 + int(row[0])], np.int64) for row in rows]
    if any(len(polygon) != int(row[0]) for polygon, row in zip(corners, rows, strict=True)):
        raise RejectedAsset("is cut off: a face names fewer corners than it announces")
    faces, owner = triangulate(positions, corners)
    part = Part(positions=positions, faces=faces, material=make_material())
    found, owners = colors_of(columns), None
    behind = [row[1 + int(row[0]) :] for row in rows]
    if found is None and behind and all(len(values) in (3, 4) for values in behind):
        colors = np.array([values[:3] for values in behind], np.float64)
        found, owners = colors_of(dict(zip(SRGB, colors.T, strict=True))), owner
    ignored = ("colours of some faces alone",) if found is None and any(behind) else ()
    if found is None:
        return Asset(parts=(part,), ignored=ignored)
    return Asset(parts=(color_part(part, found[0], owners),), notes=tuple(found[1]))


def off_points(path) -> dict[str, np.ndarray] | None:
    """The columns of an OFF file without faces; None if it has some."""
    columns, rows = _off(path.read_bytes())
    return None if rows else columns


def _off(data: bytes) -> tuple[dict[str, np.ndarray], list[list[float]]]:
    """The columns of the vertices of an OFF file, and the rows of its faces."""
    text = re.sub(r"#.*", "", data.decode("utf-8", "replace"))
    lines = [line for line in (line.strip() for line in text.splitlines()) if line]
    head = OFF_HEAD.match(lines[0]) if lines else None
    if head is None or head[1] or head[4] or head[5]:
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
