"""Wavefront OBJ + MTL as raw assets.

Vertices with the same position, texture coordinates and normal are one.  Vertex colours are read as those of points are
(columns.py). Kd is linear (as Blender writes it) and counts only without map_Kd (sRGB), for most exporters leave a
placeholder beside a map; roughness is Pr, else sqrt(2 / (Ns + 2)), else 0.5; metallic is Pm, else 0. Transparent: d
below 1, map_d, or Tr strictly between 0 and 1 (writers disagree which end of Tr is the opaque one); where a picture is
wanted (assets.py) map_d is a cut-out at a half, and a library or an image that is missing leaves grey. Of faces with
the same three corners, in either order, one is kept, that of the material used first: ShapeNet has many, one for each
side, and a ray could not tell which it hits.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spnr_jax.formats.assets import (
    MOSTLY_OPAQUE,
    Alpha,
    Asset,
    Material,
    MissingFile,
    Part,
    RejectedAsset,
    Tolerance,
    TransparentParts,
    Wrap,
    color_texels,
    make_material,
    read_companion,
    read_image,
    value_texels,
)
from spnr_jax.formats.columns import NORMAL, SRGB, Columns, colors_of, full_scale
from spnr_jax.formats.polygons import triangulate
from spnr_jax.kernels.cloud_arrays import stack_columns

READ = {"newmtl", "kd", "map_kd", "pr", "map_pr", "pm", "map_pm", "ns", "d", "tr", "map_d"}
SILENT = {"ka", "ks", "ni", "illum", "tf", "sharpness"}  # the older lighting model: has no principled counterpart
Read = Callable[[str], bytes]  # the bytes of a companion file, by its name in the text
Library = dict[str, dict[str, str]]  # material name -> keyword in lower case -> rest of the line
MAPS = ("map_kd", "map_pr", "map_pm", "map_d")
OPTION = re.compile(r"-(\w+)((?:\s+(?:on|off|[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)(?=\s))*)\s+")


class Text(NamedTuple):
    """An OBJ file: rows behind v, vt and vn; the corners of all faces; size and material of each face; libraries.

    A corner is a word like 1/2/3: numbers of rows, from 1.
    """

    rows: dict[str, list[str]]
    corners: list[str]
    sizes: list[int]
    used: list[str]
    libraries: list[str]


def load_obj(path: Path, root: Path | None = None, transparent_parts: TransparentParts = "refuse") -> Asset:
    """The file's faces grouped by material, as they lie in the file; RejectedAsset if it cannot be used.

    `root` is the folder that libraries and images must not lead out of (default: the file's own).
    """
    read, tolerance = partial(read_companion, path.parent, root=root), Tolerance(transparent_parts)
    text = _parse(path)
    columns = _columns(text)
    if not (text.sizes or text.rows["v"]):
        raise RejectedAsset("has no faces, and no vertices")
    if not text.sizes:
        return Asset(parts=(), points=columns)
    library: Library = {}
    for names in text.libraries:
        library |= parse_mtl(_read_library(read, path.parent, names, tolerance))
    colors, notes = colors_of(columns) or (None, [])
    looks: dict[str, Material | None] = {}
    for name in dict.fromkeys(text.used):
        looks[name] = _look(read, name, library, tolerance) if name else make_material()
        if colors is not None and name not in library:  # what has colours of its own is not multiplied with grey
            looks[name] = make_material(1.0)
    parts = _parts(text, columns, colors, looks)
    if text.rows["vn"] and any(part.normals is None for part in parts):
        tolerance.ignored.add("normals that only some faces have (flat shading is used)")
    return tolerance.asset(_without_doubles(parts, tolerance) if parts else [], *notes)


def _parse(path: Path) -> Text:
    """What stands in the lines of a file that matter."""
    found, material = Text({"v": [], "vt": [], "vn": []}, [], [], [], []), ""
    for line in path.read_text("utf-8-sig", errors="replace").replace("\\\n", " ").splitlines():
        keyword, rest = (*line.split(None, 1), "", "")[:2]
        if keyword == "f":
            words = rest.partition("#")[0].split()
            found.corners.extend(_count_from_start(words, found.rows) if "-" in rest else words)
            found.sizes.append(len(words))
            found.used.append(material)
        elif keyword in found.rows:
            found.rows[keyword].append(rest)
        elif keyword == "usemtl":
            material = rest.strip()
        elif keyword == "mtllib":
            found.libraries.append(rest.strip())
    return found


def _count_from_start(words: list[str], rows: dict[str, list[str]]) -> list[str]:
    """The corners of a face with numbers that count from the start, where they counted back from here."""
    counts = [len(x) + 1 for x in rows.values()]
    corners = [zip(word.split("/"), counts, strict=False) for word in words]
    return ["/".join(str(int(n) + count) if n.startswith("-") else n for n, count in corner) for corner in corners]


def _table(rows: list[str], width: int) -> np.ndarray:
    """The first numbers (rows, width) of each row."""
    return np.loadtxt(rows, usecols=range(width), ndmin=2, comments="#") if rows else np.zeros((0, width))


def _columns(text: Text) -> Columns:
    """The columns of the vertices: positions, colours where every row has them, normals where no face does."""
    try:
        table = np.loadtxt(text.rows["v"] or ["0 0 0"], ndmin=2, comments="#")
    except ValueError:  # rows of different lengths
        table = _table(text.rows["v"], 3)
    columns = dict(zip((*"xyz", *SRGB, "alpha"), table.T if table.shape[1] >= 6 else table.T[:3], strict=False))
    if not text.sizes and len(text.rows["vn"]) == len(table):
        columns |= dict(zip(NORMAL, _table(text.rows["vn"], 3).T, strict=True))
    return columns


def _parts(text: Text, columns: Columns, colors: np.ndarray | None, looks: dict[str, Material | None]) -> list[Part]:
    """The faces of each material that is to be seen, apart also by whether they have texture coordinates or normals."""
    numbers = {word: i for i, word in enumerate(dict.fromkeys(text.corners))}
    corners = np.array([[int(n or 0) for n in f"{word}//".split("/")[:3]] for word in numbers])  # of vertices
    if corners.min() < 0 or corners[:, 0].min() < 1:
        raise RejectedAsset("has faces that name vertices before the first: broken file")
    for last, (keyword, rows) in zip(corners.max(axis=0), text.rows.items(), strict=True):
        if last > len(rows):
            raise RejectedAsset(f"has faces that name {keyword} {last} of {len(rows)}: broken file")
    positions = stack_columns(columns)[corners[:, 0] - 1]
    faces, owner = triangulate(positions, np.array([numbers[word] for word in text.corners]), text.sizes)
    number = {name: i for i, name in enumerate(looks)}
    _, has_texcoords, has_normals = (corners[faces] > 0).all(axis=1).T
    kind = 4 * np.array([number[name] for name in text.used])[owner] + 2 * has_texcoords + has_normals
    texcoords, normals = _table(text.rows["vt"], 2), _table(text.rows["vn"], 3)
    parts = []
    for code in np.unique(kind):
        material = list(looks.values())[code // 4]
        if material is None:
            continue
        used, own = np.unique(faces[kind == code], return_inverse=True)
        of_v, of_vt, of_vn = corners[used].T - 1
        part = Part(
            positions=positions[used],
            faces=own.reshape(-1, 3),
            material=material,
            normals=normals[of_vn] if code & 1 else None,
            texcoords=texcoords[of_vt] * [1, -1] + [0, 1] if code & 2 else None,  # v is from the lower edge
            colors=None if colors is None else colors[of_v],
        )
        parts.append(part)
    return parts


def _without_doubles(parts: list[Part], tolerance: Tolerance) -> list[Part]:
    """The parts without the faces whose three corners an earlier face, of any part, has in some order."""
    corners = np.concatenate([part.positions[part.faces] for part in parts])
    order = np.lexsort(np.moveaxis(corners, -1, 0)[::-1], axis=-1)
    sorted_corners = np.take_along_axis(corners, order[..., None], axis=1)
    first = np.unique(sorted_corners.reshape(-1, 9), axis=0, return_index=True)[1]
    kept = np.zeros(len(corners), bool)
    kept[first] = True
    if kept.all():
        return parts
    tolerance.ignored.add(f"{int((~kept).sum())} doubled faces (one of each is kept)")
    ends = np.cumsum([len(part.faces) for part in parts])[:-1]
    return [replace(part, faces=part.faces[here]) for part, here in zip(parts, np.split(kept, ends), strict=True)]


def parse_mtl(text: str) -> Library:
    """Statements of an MTL file."""
    library: Library = {}
    current: dict[str, str] = {}
    for line in text.splitlines():
        keyword, rest = (*line.split(None, 1), "", "")[:2]
        if keyword.lower() == "newmtl":
            current = library.setdefault(rest.strip(), {})
        elif keyword and not keyword.startswith("#"):
            current[keyword.lower()] = re.sub(r"\s#.*", "", rest).strip()
    return library


def _read_library(read: Read, folder: Path, names: str, tolerance: Tolerance) -> str:
    """Text of the material libraries of one `mtllib` line: one name with spaces, or several without."""
    single = (folder / names).is_file() or len(names.split()) == 1
    found = []
    for name in [names] if single else names.split():
        try:
            found.append(read(name.replace("\\", "/")))
        except MissingFile as missing:
            tolerance.goes_on_without(missing)
    return "\n".join(data.decode("utf-8-sig", errors="replace") for data in found)


def _look(read: Read, name: str, library: Library, tolerance: Tolerance) -> Material | None:
    """The principled material of an MTL entry; None where it is nowhere to be seen."""
    if name not in library:
        tolerance.goes_on_without(MissingFile(f"uses a material that no library defines: {name!r}"))
        return make_material()
    entry = library[name]
    if tolerance.strict:  # that it is transparent is a plainer reason than a missing file
        tolerance.cut_out(name, make_material(), _alpha(entry, None))
    maps: dict[str, np.ndarray] = {}
    wrap: Wrap = "repeat"
    for key in MAPS:
        if key not in entry:
            continue
        options, file = _options(entry[key])
        tolerance.ignored |= {f"MTL map option -{option}" for option in options if option != "clamp"}
        try:
            maps[key] = read_image(read(file), file)
            wrap = "clamp" if options.get("clamp") == ["on"] else wrap
        except MissingFile as missing:
            tolerance.goes_on_without(missing)
    tolerance.ignored |= {f"MTL {key}" for key in entry if key not in READ | SILENT and entry[key].strip("0. ")}
    color = np.array([float(x) for x in entry.get("kd", "0.5").split()[:3]])
    color = np.repeat(color, 3) if len(color) == 1 else color  # as the format has it
    white = full_scale(color.dtype, float(color.max()), linear=bool(color.max() < 2))
    if white > 1:
        tolerance.ignored.add(f"MTL Kd beyond 1 (taken as 0 to {white:g})")
        color = color / white
    if "map_kd" in maps:
        if "kd" in entry and not np.all(color == 1):
            tolerance.ignored.add("MTL Kd beside map_Kd")
        color = color_texels(maps["map_kd"])
    roughness = np.sqrt(2 / (max(float(entry["ns"]), 0) + 2)) if "ns" in entry else 0.5
    channels: dict[str, float | np.ndarray]
    channels = {"roughness": float(entry.get("pr", roughness)), "metallic": float(entry.get("pm", 0))}
    for channel, key in (("roughness", "map_pr"), ("metallic", "map_pm")):
        if key in maps:
            channels[channel] = value_texels(maps[key][..., 0])
    return tolerance.cut_out(name, make_material(color, **channels, wrap=wrap), _alpha(entry, maps.get("map_d")))


def _options(statement: str) -> tuple[dict[str, list[str]], str]:
    """The options of a map statement with their arguments, and the name of its image."""
    options = {}
    while option := OPTION.match(statement):
        options[option[1]] = option[2].split()
        statement = statement[option.end() :]
    return options, statement.strip().replace("\\", "/")


def _alpha(entry: dict[str, str], map_d: np.ndarray | None) -> Alpha | None:
    """The alpha of an MTL entry, with the texels of its mask."""
    if "map_d" in entry:
        texels = None
        if map_d is not None:  # grey, or the alpha of a picture that has one
            texels = value_texels(map_d[..., 3 if map_d[..., 3].min() < 255 else 0])
        return Alpha("map_d", texels=texels, cutoff=MOSTLY_OPAQUE)
    if "d" in entry and (opacity := float(entry["d"].split()[-1])) < 1:
        return Alpha(f"d {opacity:g}", opacity)
    if "tr" in entry and 0 < (share := float(entry["tr"].split()[-1])) < 1:
        return Alpha(f"Tr {share:g}", 1 - share)
    return None
