"""Wavefront OBJ + MTL as raw assets: geometry through trimesh, materials from the MTL text.

Vertex colours are sRGB, as those of points (file_colors.py). Kd is linear (as Blender writes it) and counts only
without map_Kd (sRGB), for most exporters leave a placeholder beside a map; roughness is Pr, else sqrt(2 / (Ns + 2)),
else 0.5; metallic is Pm, else 0. Transparent: d below 1, map_d, or Tr strictly between 0 and 1 (writers disagree
which end of Tr is the opaque one); where a picture is wanted (tolerance.py) map_d is a cut-out at a half, and a
library or an image that is missing leaves grey. Of faces with the same three corners, in either order, one is kept,
that of the material used first: ShapeNet has many, one for each side, and a ray could not tell which it hits.
"""

import io
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from trimesh.exchange.obj import load_obj as read_obj_text
from trimesh.geometry import triangulate_quads

from spnr_jax.formats.mesh.assets import (
    Asset,
    Material,
    MissingFile,
    Part,
    RejectedAsset,
    TransparentParts,
    Wrap,
    make_material,
)
from spnr_jax.formats.mesh.file_colors import linear_colors
from spnr_jax.formats.mesh.polygons import MOST_CORNERS, ears, is_concave
from spnr_jax.formats.mesh.texels import color_texels, read_image, value_texels
from spnr_jax.formats.mesh.tolerance import MOSTLY_OPAQUE, Alpha, Opacity, Tolerance, read_companion

PLACE = "material-{}"  # name that trimesh sees for the n-th material, so that any name in the file is safe
READ = {"newmtl", "kd", "map_kd", "pr", "map_pr", "pm", "map_pm", "ns", "d", "tr", "map_d"}
SILENT = {"ka", "ks", "ni", "illum", "tf", "sharpness"}  # the older lighting model: has no principled counterpart
Read = Callable[[str], bytes]  # the bytes of a companion file, by its name in the text
MAPS = ("map_kd", "map_pr", "map_pm", "map_d")
DEFAULTS = ("s", (1.0, 1.0)), ("o", (0.0, 0.0))  # of options of maps: scale and offset of u and v
OPTION = re.compile(r"-(\w+)((?:\s+(?:on|off|[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?=\s))*)\s+")


class Placement(NamedTuple):
    """How a material's maps lie on the surface: texture coordinates (u, v from the lower edge) * scale + offset."""

    wrap: Wrap = "repeat"
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


class Look(NamedTuple):
    """A material, how its maps lie, and whether it is nowhere to be seen."""

    material: Material
    placement: Placement = Placement()
    nowhere: bool = False


def load_obj(path: Path, root: Path | None = None, transparent_parts: TransparentParts = "refuse") -> Asset:
    """The file's faces grouped by material, as they lie in the file; RejectedAsset if it cannot be used.

    `root` is the folder that libraries and images must not lead out of (default: the file's own).
    """
    read, tolerance = partial(read_companion, path.parent, root=root), Tolerance(transparent_parts)
    text = _text(path)
    if not re.search(r"(?m)^f ", text):
        raise RejectedAsset("has no faces")
    text = _without_notches(_absolute(text))
    library: dict[str, dict[str, str]] = {}
    for names in re.findall(r"(?m)^mtllib +(.+?) *$", text):
        library |= parse_mtl(_read_library(read, path.parent, names, tolerance))
    names = list(dict.fromkeys(re.findall(r"(?m)^usemtl +(.+?) *$", text)))
    ignored: set[str] = set()
    looks = {PLACE.format(i): _look(read, name, library, ignored, tolerance) for i, name in enumerate(names)}
    # an MTL text of names only makes trimesh keep the material of each face
    numbers = dict(zip(names, looks, strict=True))
    text = "mtllib names\n" + re.sub(r"(?m)^mtllib.*$", "", text)
    text = re.sub(r"(?m)^usemtl +(.+?) *$", lambda match: f"usemtl {numbers[match[1]]}", text)
    loaded = read_obj_text(io.StringIO(text), resolver={"names": "\n".join(f"newmtl {name}" for name in looks)})
    order = {name: number for number, name in enumerate(looks)}
    meshes = sorted(loaded["geometry"].values(), key=lambda mesh: order.get(_material_name(mesh), -1))
    notes = _color(meshes)
    # what has colours of its own and no material is not multiplied with grey
    plain = {name for name, number in order.items() if names[number] not in library} | {""}
    dressed = []
    for mesh in meshes:
        name = _material_name(mesh)
        white = mesh.get("vertex_colors") is not None and (name in plain or name not in looks)
        dressed.append((mesh, Look(make_material(1.0)) if white else looks.get(name, Look(make_material()))))
    parts = [_part(mesh, look.material, look.placement) for mesh, look in dressed if not look.nowhere]
    if not parts and meshes:
        raise RejectedAsset(f"has nothing to draw: {'; '.join(tolerance.notes())}")
    if re.search(r"(?m)^vn ", text) and any(part.normals is None for part in parts):
        ignored.add("normals that only some faces have (flat shading is used)")
    parts = _without_doubles(parts, ignored)
    return Asset(parts=tuple(parts), ignored=tuple(sorted(ignored)), notes=(*tolerance.notes(), *notes))


def obj_points(path: Path) -> dict[str, np.ndarray] | None:
    """The columns of the vertices of a file without faces; None if it has some."""
    text = _text(path)
    if re.search(r"(?m)^f ", text):
        return None
    rows = _vertices(text)
    if not rows.size:
        raise RejectedAsset("has no faces, and no vertices")
    names = {3: "x y z", 4: "x y z w", 6: "x y z red green blue", 7: "x y z red green blue alpha"}.get(rows.shape[1])
    if names is None:
        raise RejectedAsset(f"has vertices of {rows.shape[1]} numbers; expected x y z, or x y z red green blue")
    columns = dict(zip(names.split(), rows.T, strict=True))
    normals = re.findall(r"(?m)^vn +(.+)$", text)
    if len(normals) == len(rows):
        columns |= dict(zip(("nx", "ny", "nz"), np.loadtxt(normals, ndmin=2).T, strict=True))
    return columns


def _text(path: Path) -> str:
    """The text of a file, without blanks before keywords, which trimesh looks for at the line's start."""
    text = path.read_text("utf-8", errors="replace").replace("\t", " ").replace("\\\n", " ")
    return re.sub(r"(?m)^ +", "", text)


def _vertices(text: str) -> np.ndarray:
    """What stands behind the `v` of each line (n, columns)."""
    found = re.findall(r"(?m)^v +(.+)$", text)
    return np.loadtxt(found, ndmin=2, comments="#") if found else np.zeros((0, 3))


def _without_notches(text: str) -> str:
    """The text with triangles instead of polygons that are not convex; trimesh makes fans of all."""
    polygon = re.compile(r"(?m)^f((?: +\S+){4,}) *$")
    if not polygon.search(text):
        return text
    positions = _vertices(text)[:, :3]

    def cut(match: re.Match) -> str:
        words = match[1].split()
        rows = np.array([int(word.partition("/")[0]) - 1 for word in words])
        if (
            rows.min() < 0
            or rows.max() >= len(positions)
            or len(rows) > MOST_CORNERS
            or not is_concave(positions[rows])
        ):
            return match[0]
        return "\n".join(" ".join(["f", *(words[i] for i in face)]) for face in ears(positions[rows]))

    return polygon.sub(cut, text)


def _color(meshes: list[dict]) -> list[str]:
    """Makes the vertex colours of groups of faces linear; lines about how they were read."""
    own = [mesh for mesh in meshes if mesh.get("vertex_colors") is not None]
    if not own:
        return []
    channels = np.concatenate([np.asarray(mesh["vertex_colors"])[:, :3] for mesh in own])
    colors, lines = linear_colors(channels, "vertex colours")
    ends = np.cumsum([len(mesh["vertex_colors"]) for mesh in own])[:-1]
    for mesh, part in zip(own, np.split(colors, ends), strict=True):
        mesh["vertex_colors"] = part
    return lines


def _without_doubles(parts: list[Part], ignored: set[str]) -> list[Part]:
    """The parts without the faces whose three corners an earlier face, of any part, has in some order."""
    corners = np.concatenate([part.positions[part.faces] for part in parts])
    if corners.shape[1:] != (3, 3):
        return parts  # broken: assemble says what is wrong
    order = np.lexsort(np.moveaxis(corners, -1, 0)[::-1], axis=-1)
    sorted_corners = np.take_along_axis(corners, order[..., None], axis=1)
    first = np.unique(sorted_corners.reshape(-1, 9), axis=0, return_index=True)[1]
    kept = np.zeros(len(corners), bool)
    kept[first] = True
    if kept.all():
        return parts
    ignored.add(f"{int((~kept).sum())} doubled faces (one of each is kept)")
    ends = np.cumsum([len(part.faces) for part in parts])[:-1]
    return [replace(part, faces=part.faces[here]) for part, here in zip(parts, np.split(kept, ends), strict=True)]


def parse_mtl(text: str) -> dict[str, dict[str, str]]:
    """Statements of an MTL file: {material name: {keyword in lower case: rest of the line}}."""
    library: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for line in text.splitlines():
        keyword, _, rest = line.strip().partition(" ")
        if keyword.lower() == "newmtl":
            current = library.setdefault(rest.strip(), {})
        elif keyword and not keyword.startswith("#"):
            current[keyword.lower()] = rest.strip()
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
    return "\n".join(data.decode("utf-8", errors="replace") for data in found)


def _look(read: Read, name: str, library: dict[str, dict[str, str]], ignored: set[str], tolerance: Tolerance) -> Look:
    """The principled material of an MTL entry, how its maps lie, and where it has surface."""
    if name not in library:
        tolerance.goes_on_without(MissingFile(f"uses a material that no library defines: {name!r}"))
        return Look(make_material())
    entry = library[name]
    maps = _read_maps(read, entry, name, tolerance)
    opacity = _opacity(entry, maps.get("map_d"), name, tolerance)
    ignored |= {f"MTL {key}" for key in entry if key not in READ | SILENT and entry[key].strip("0. ")}
    placement = _placement([entry[key] for key in MAPS if key in maps], ignored)
    color = np.array([float(x) for x in entry.get("kd", "0.5 0.5 0.5").split()[:3]])
    if "map_kd" in maps:
        if "kd" in entry and not np.all(color == 1):
            ignored.add("MTL Kd beside map_Kd")
        color = color_texels(maps["map_kd"])
    roughness = np.sqrt(2 / (max(float(entry["ns"]), 0) + 2)) if "ns" in entry else 0.5
    channels: dict[str, float | np.ndarray]
    channels = {"roughness": float(entry.get("pr", roughness)), "metallic": float(entry.get("pm", 0))}
    for channel, key in (("roughness", "map_pr"), ("metallic", "map_pm")):
        if key in maps:
            channels[channel] = value_texels(maps[key][..., 0])
    material = make_material(color, **channels, wrap=placement.wrap)
    return Look(replace(material, opacity=opacity.texels, cutoff=opacity.cutoff), placement, opacity.nowhere)


def _read_maps(read: Read, entry: dict[str, str], name: str, tolerance: Tolerance) -> dict[str, np.ndarray]:
    """Texels of the images that an entry names; without those that may be missing and are."""
    if tolerance.strict:
        _opacity(entry, None, name, tolerance)  # a transparent material is the plainer reason
    maps = {}
    for key in MAPS:
        if key in entry:
            try:
                _, file = _options(entry[key])
                maps[key] = read_image(read(file), file)
            except MissingFile as missing:
                tolerance.goes_on_without(missing)
    return maps


def _placement(statements: list[str], ignored: set[str]) -> Placement:
    """How the maps of a material's statements lie: as the first says; others that disagree are named as ignored."""
    places = []
    for options, _ in map(_options, statements):
        ignored |= {f"MTL map option -{name}" for name in options if name not in ("clamp", "s", "o")}
        wrap: Wrap = "clamp" if options.get("clamp") == ["on"] else "repeat"
        (u, v, *_), (x, y, *_) = ([*map(float, options.get(name, [])), *default] for name, default in DEFAULTS)
        places.append(Placement(wrap, (u, v), (x, y)))
    if len(set(places)) > 1:
        ignored.add("MTL maps of one material that lie differently (the first one's options are used)")
    return places[0] if places else Placement()


def _options(statement: str) -> tuple[dict[str, list[str]], str]:
    """The options of a map statement with their arguments, and the name of its image."""
    options = {}
    while option := OPTION.match(statement):
        options[option[1]] = option[2].split()
        statement = statement[option.end() :]
    return options, statement.strip().replace("\\", "/")


def _opacity(entry: dict[str, str], map_d: np.ndarray | None, name: str, tolerance: Tolerance) -> Opacity:
    """Where a material has surface."""
    if "map_d" in entry:
        texels = None
        if map_d is not None:  # grey, or the alpha of a picture that has one
            texels = value_texels(map_d[..., 3 if map_d[..., 3].min() < 255 else 0])
        return tolerance.opacity(name, Alpha("map_d", texels=texels, cutoff=MOSTLY_OPAQUE))
    if "d" in entry and (opacity := float(entry["d"].split()[-1])) < 1:
        return tolerance.opacity(name, Alpha(f"d {opacity:g}", opacity))
    if "tr" in entry and 0 < (share := float(entry["tr"].split()[-1])) < 1:
        return tolerance.opacity(name, Alpha(f"Tr {share:g}", 1 - share))
    return Opacity()


def _absolute(text: str) -> str:
    """The OBJ text with relative (negative) vertex numbers made absolute; trimesh counts them from the file's end."""
    if not re.search(r"(?m)^f .*-", text):
        return text
    counts = {"v": 0, "vt": 0, "vn": 0}
    lines = []
    for line in text.splitlines():
        keyword, *words = line.split() or [""]
        if keyword in counts:
            counts[keyword] += 1
        elif keyword == "f":
            corners = [zip(word.split("/"), counts.values(), strict=False) for word in words]
            absolute = [
                "/".join(str(int(n) + c + 1) if n.startswith("-") else n for n, c in corner) for corner in corners
            ]
            line = " ".join(["f", *absolute])
        lines.append(line)
    return "\n".join(lines)


def _material_name(mesh: dict) -> str:
    """The material name of one group of faces that trimesh read, or an empty one."""
    return getattr(getattr(mesh["visual"], "material", None), "name", "")


def _part(mesh: dict, material: Material, placement: Placement) -> Part:
    """One group of faces that trimesh read."""
    texcoords = getattr(mesh["visual"], "uv", None)
    if texcoords is not None:
        u, v = (texcoords[:, :2] * placement.scale + placement.offset).T
        texcoords = np.stack([u, 1 - v], axis=-1)  # OBJ counts v from the lower edge
    return Part(
        positions=np.asarray(mesh["vertices"], np.float64),
        faces=triangulate_quads(mesh["faces"]),
        material=material,
        normals=mesh.get("vertex_normals"),
        texcoords=texcoords,
        colors=mesh.get("vertex_colors"),
    )
