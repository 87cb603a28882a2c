"""PLY, STL and OFF files of polygons as parts, with colours of vertices or faces, or a PLY's textures.

.ply    elements vertex, and face or tristrips; colours under the names of columns.py; comments `TextureFile name` with
        a list `texcoord` per face, or s t or u v per vertex (MeshLab, OpenMVS)
.stl    text: three lines `vertex x y z` per triangle; binary: 80 bytes, a count u32, 50 bytes per triangle; a count of
        0 means as many as fit
.off    `[[C][N]OFF]`, counts, vertices `x y z [normal] [colour]`, in MeshLab's NCOFF the colour first, faces
        `n i j k ... [colour]`; colours also without the C
"""

import contextlib
import io
import re
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.assets import RGB, Loading, Part, Texels, make_material
from spnr_jax.formats.columns import (
    LINEAR,
    NORMAL,
    SRGB,
    Columns,
    base_color,
    colors_of,
    describe_use,
    invisible,
    list_names,
    rename,
    useful,
)
from spnr_jax.formats.point_tables import load_text, open_text
from spnr_jax.formats.row_files import USED, Lists, read_elements, read_header
from spnr_jax.kernels.cloud_arrays import stack_columns
from spnr_jax.kernels.triangles import strip_faces, triangulate

UNREAD = ("roughness", "metallic", "classification", "withheld")  # of the vertices of meshes
TEXCOORDS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
STL_HEAD, STL_TRIANGLE = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
OFF_HEAD = re.compile(r"(?:((?:ST|C|N)*)OFF(?=\d|\b)\s*)?(?=\d+[^\S\n]+\d+)")


def load_ply_mesh(path: Path, loading: Loading) -> list[Part]:
    """The parts of a PLY file with faces or triangle strips."""
    file = io.BytesIO(path.read_bytes())
    header = read_header(file, ".ply")
    if (element := header.faces) is None:
        return []
    (vertices, _), (of_faces, lists) = read_elements(file, header, "vertex", element).values()
    name = next((name for name in ("vertex_indices", "vertex_index", *lists) if name in lists), None)
    if name is None:
        raise UserError("has faces without lists of vertices: broken file")
    sizes, corners = lists[name]
    if element == "tristrips":
        corners = strip_faces(np.insert(corners.astype(np.int64), np.cumsum(sizes), -1)).ravel()
        sizes, of_faces = np.full(len(corners) // 3, 3), {}
    texcoords = _texcoords(vertices, lists, corners, sizes)
    _note_loose(corners, len(vertices["x"]), loading)
    loading.ignored |= {f"PLY element {name:.40}" for name, count, _ in header.elements if count and name not in USED}
    images = [loading.read_image(texture) for texture in header.textures] if texcoords is not None else []
    if texcoords is None or not any(images):
        textured = header.textures or any("texture" in name for name, *_ in header.elements)
        if texcoords is not None or "texcoord" in lists or textured:
            loading.ignored.add("texture coordinates")
        return colored_part(vertices, corners, sizes, of_faces, loading)
    number = np.asarray(of_faces.get("texnumber", np.zeros(len(sizes))), np.int64)
    if len(number) and (number.min(), number.max()) == (1, len(images)):  # counted from 1
        number = number - 1
    columns = _describe_vertices(vertices, loading)
    if columns.keys() & {LINEAR[0], SRGB[0], "rgb", "rgba"}:
        loading.say("colours of the vertices not used beside those of a texture")
    wanted = [(image, number == i) for i, image in enumerate(images) if image is not None]
    parts = [
        _textured(columns, corners[np.repeat(own, sizes)], sizes[own], texcoords[np.repeat(own, sizes)], image)
        for image, own in wanted
    ]
    rest = ~np.any([own for _, own in wanted], axis=0)
    if not rest.any():
        _describe_faces(of_faces, {}, loading)
    else:
        loading.say(f"{rest.sum():,} of {len(rest):,} faces show no image of the file: their own colours taken")
        left = {name: column[rest] for name, column in of_faces.items()}
        parts += colored_part(vertices, corners[np.repeat(rest, sizes)], sizes[rest], left, loading)
    return parts


def _texcoords(vertices: Columns, lists: Lists, corners: np.ndarray, sizes: np.ndarray) -> np.ndarray | None:
    """Texture coordinates (corners, 2) of a PLY file's faces or vertices, or None; v is from the lower edge."""
    known = [np.asarray(vertices[name]) for pair in TEXCOORDS if set(pair) <= vertices.keys() for name in pair]
    of_faces, values = lists.get("texcoord", (np.zeros(0), np.zeros(0)))
    if np.array_equal(of_faces, 2 * sizes):
        return values.reshape(-1, 2)
    inside = len(corners) and corners.min() >= 0 and corners.max() < len(vertices["x"])  # else it is refused later
    return np.stack(known[:2], axis=-1)[corners] if known and inside else None


def _textured(vertices: Columns, corners: np.ndarray, sizes: np.ndarray, texcoords: np.ndarray, image: Texels) -> Part:
    """The part of polygons with `sizes` corners each that show an image; texture coordinates (corners, 2)."""
    positions = stack_columns(vertices)[corners]
    normals = stack_columns(vertices, NORMAL)[corners] if set(NORMAL) <= vertices.keys() else None
    faces, _ = triangulate(positions, np.arange(len(positions)), sizes)
    material, texcoords = make_material(image.values(RGB, "sRGB")), texcoords * [1, -1] + [0, 1]
    alpha = np.where(invisible(vertices), 0.0, 1.0)[corners]
    return Part(positions=positions, faces=faces, material=material, normals=normals, texcoords=texcoords, alpha=alpha)


def _note_loose(corners: np.ndarray, count: int, loading: Loading) -> None:
    """Notes how many of the vertices no face has."""
    if len(corners) and (loose := count - len(np.unique(corners))):
        loading.ignored.add(f"{loose:,} vertices of no face")


def load_stl(path: Path, loading: Loading) -> list[Part]:
    """The part of an STL file."""
    data = path.read_bytes()
    announced = int.from_bytes(data[80:STL_HEAD], "little")
    whole = len(data) == STL_HEAD + STL_TRIANGLE.itemsize * announced  # then it is binary, whatever its first bytes
    if not whole and re.match(rb"(\xef\xbb\xbf)?\s*(solid|facet)\b[^\0]*?(facet|endsolid|vertex)", data, re.IGNORECASE):
        rows = re.findall(r"(?i)\bvertex[ \t]+([^\r\n]*)", data.decode("ascii", "replace"))
        corners = load_text([*enumerate(rows, 1)], "vertex", 3, ndmin=2) if rows else np.zeros((0, 3))
        if not re.search(rb"(?i)\bendsolid\b", data):
            loading.say("no line 'endsolid' ends the file: it may be cut off")
        if len(rows) % 3:
            raise UserError(f"is cut off: {len(rows)} corners, where each triangle has 3")
    else:
        held = (len(data) - STL_HEAD) // STL_TRIANGLE.itemsize
        if announced > held or held < 0:
            raise UserError(f"is cut off: its header announces {announced} triangles, {max(held, 0)} are there")
        if held > announced:
            read = announced or held
            loading.say(f"the header announces {announced} triangles, {held} stand behind it, {read} are read")
        table = np.frombuffer(data, STL_TRIANGLE, announced or held, STL_HEAD)
        corners = table["corners"]
        loading.ignored |= {"colours in STL"} if table["attribute"].any() or b"COLOR=" in data[:80] else set()
    columns = dict(zip("xyz", corners.reshape(-1, 3).T, strict=True))
    return colored_part(columns, np.arange(corners.size // 3), np.full(corners.size // 9, 3), {}, loading)


def load_off(path: Path, loading: Loading) -> list[Part]:
    """The part of an OFF file."""
    with open_text(path) as file:
        lines = re.sub(r"#.*", "", file.read()).splitlines()
    text = "\n".join(line for line in lines if line.strip()).lstrip()
    if (head := OFF_HEAD.match(text)) is None:
        raise UserError("is not an OFF file that can be read: expected OFF, COFF, NOFF or CNOFF in text, then counts")
    counts, *rows = text[head.end() :].split("\n")
    num_vertices, num_faces = (int(word) for word in counts.split()[:2])
    if len(rows) < num_vertices + num_faces:
        raise UserError(f"is cut off: {num_vertices} vertices and {num_faces} faces announced, {len(rows)} lines found")
    kind, color = head[1] or "", (*SRGB, "alpha")
    behind_normals = TEXCOORDS[0] if "ST" in kind and "C" not in kind else color
    names = [*"xyz", *(NORMAL if "N" in kind else ()), *behind_normals]
    names = [*"xyz", *color, *NORMAL] if "NC" in kind else names
    vertices = [*enumerate(rows[:num_vertices])]
    table = load_text(vertices, "vertex", len(rows[0].split()), ndmin=2) if vertices else np.zeros((0, 3))
    columns = dict(zip(names, table.T, strict=False))
    faces = [[float(word) for word in row.split()] for row in rows[num_vertices:][:num_faces]]
    sizes = np.array([int(face[0]) for face in faces], np.int64)
    corners = [face[1 : 1 + size] for face, size in zip(faces, sizes, strict=True)]
    if [len(own) for own in corners] != sizes.tolist():
        raise UserError("is cut off: a face names fewer corners than it announces")
    behind = [face[1 + size :] for face, size in zip(faces, sizes, strict=True)]
    colored = bool(behind) and all(len(values) in (3, 4) for values in behind)
    width = min(map(len, behind), default=0)
    of_faces = dict(zip(color, np.array([x[:width] for x in behind]).T, strict=False)) if colored else {}
    if any(behind) and not colored and SRGB[0] not in columns:
        loading.ignored.add("colours of some faces alone, or by a palette")
    numbers = np.array([number for own in corners for number in own])
    _note_loose(numbers, num_vertices, loading)
    return colored_part(columns, numbers, sizes, of_faces, loading)


PLAIN = {".ply": load_ply_mesh, ".stl": load_stl, ".off": load_off}


def colored_part(
    vertices: Columns, corners: np.ndarray, sizes: np.ndarray, of_faces: Columns, loading: Loading
) -> list[Part]:
    """The part of polygons with `sizes` corners each, coloured by its vertices, else by its polygons.

    Vertices of one colour beside polygons of several do not count.
    """
    columns = _describe_vertices(vertices, loading)
    positions = stack_columns(columns)
    faces, owner = triangulate(positions, corners, sizes)
    normals = stack_columns(columns, NORMAL) if set(NORMAL) <= columns.keys() else None
    alpha, (colors, notes) = np.where(invisible(columns), 0.0, 1.0), colors_of(columns) or (None, [])
    used = Columns()
    if (found := _face_colors(of_faces, colors)) is not None:
        loading.ignored |= set() if colors is None else {"the one colour of all vertices, beside those of faces"}
        used = rename(of_faces)
        normals = None if normals is None else normals[faces.ravel()]
        alpha = alpha[faces.ravel()] * np.repeat(~invisible(used | {"x": sizes})[owner], 3)
        positions = positions[faces.ravel()]
        colors, notes = np.repeat(found[0][owner], 3, axis=0), found[1]
        faces = np.arange(faces.size).reshape(-1, 3)
    elif colors is None:
        colors = base_color(columns, loading.say)  # of intensities
    material = make_material(0.5 if colors is None else 1.0)
    loading.say(*notes)
    _describe_faces(of_faces, used, loading)
    return [Part(positions=positions, faces=faces, material=material, normals=normals, colors=colors, alpha=alpha)]


def _describe_vertices(vertices: Columns, loading: Loading) -> Columns:
    """The columns of vertices under our names; notes say what of them is not used."""
    columns = useful(vertices)
    loading.say(*describe_use({name: x for name, x in vertices.items() if name not in sum(TEXCOORDS, ())}))
    loading.ignored |= {f"{name} of vertices" for name in UNREAD if name in columns}
    return columns


def _describe_faces(of_faces: Columns, used: Columns, loading: Loading) -> None:
    """Notes which columns of faces are not used."""
    taken = {"texnumber", *(name for name, x in of_faces.items() if any(x is own for own in used.values()))}
    if left := [name for name in of_faces if name not in taken]:
        loading.say(f"columns of faces that are not used: {list_names(left)}")


def _face_colors(of_faces: Columns, colors: np.ndarray | None) -> tuple[np.ndarray, list[str]] | None:
    """Colours (f, 3) of polygons, and lines about them, if those of the vertices (n, 3) are unknown, or one for all."""
    columns = rename(of_faces)
    if colors is None:
        return colors_of(columns)
    if (colors != colors[:1]).any():
        return None
    with contextlib.suppress(UserError):  # those of the vertices can be read
        found = colors_of({name: columns[name] for name in SRGB if name in columns})
        return found if found is not None and (found[0] != found[0][:1]).any() else None
    return None
