"""Wavefront OBJ + MTL as raw assets: geometry through trimesh, materials from the MTL text.

Kd is linear (as Blender writes it) and counts only without map_Kd (sRGB), for most exporters leave a placeholder beside
a map; roughness is Pr, else sqrt(2 / (Ns + 2)), else 0.5; metallic is Pm, else 0. Transparent: d below 1, map_d, or Tr
strictly between 0 and 1 (writers disagree which end of Tr is the opaque one).
"""

import io
import re
from pathlib import Path

import numpy as np
from trimesh.exchange.obj import load_obj as read_obj_text
from trimesh.geometry import triangulate_quads

from data_gen.assets import Asset, Material, Part, RejectedAsset, Wrap
from data_gen.companions import read_companion
from data_gen.texels import color_texels, read_image, value_texels

PLACE = "material-{}"  # name that trimesh sees for the n-th material, so that any name in the file is safe
READ = {"newmtl", "kd", "map_kd", "pr", "map_pr", "pm", "map_pm", "ns", "d", "tr", "map_d"}
SILENT = {"ka", "ks", "ni", "illum", "tf", "sharpness"}  # the older lighting model: has no principled counterpart
OPTION = re.compile(r"-(\w+)((?:\s+(?:on|off|[-+.\d]\S*))*)\s+")


def load_obj(path: Path) -> Asset:
    """The file's faces grouped by material, as they lie in the file; RejectedAsset if it cannot be used."""
    text = path.read_text("utf-8", errors="replace")
    text = re.sub(r"(?m)^ +", "", text.replace("\t", " "))  # trimesh looks for keywords at the line's start
    if not re.search(r"(?m)^f ", text):
        raise RejectedAsset("has no faces")
    library: dict[str, dict[str, str]] = {}
    for names in re.findall(r"(?m)^mtllib +(.+?) *$", text):
        library |= parse_mtl(_read_library(path.parent, names))
    names = list(dict.fromkeys(re.findall(r"(?m)^usemtl +(.+?) *$", text)))
    ignored: set[str] = set()
    materials = {PLACE.format(i): _material(path.parent, name, library, ignored) for i, name in enumerate(names)}
    loaded = read_obj_text(io.StringIO(_renamed(text, names)), resolver={"names": _name_list(materials)})
    default = principled()
    parts = []
    for mesh in loaded["geometry"].values():
        name = getattr(getattr(mesh["visual"], "material", None), "name", "")
        parts.append(_part(mesh, materials.get(name, default)))
    if re.search(r"(?m)^vn ", text) and any(part.normals is None for part in parts):
        ignored.add("normals that only some faces have (flat shading is used)")
    return Asset(parts=tuple(parts), ignored=tuple(sorted(ignored)))


def principled(
    base_color: float | np.ndarray = 0.5,
    roughness: float | np.ndarray = 0.5,
    metallic: float | np.ndarray = 0.0,
    wrap: Wrap = "repeat",
) -> Material:
    """A material of float32 channels; grey of roughness 0.5 where nothing is given."""
    color = np.asarray(base_color, np.float32)
    return Material(
        base_color=np.clip(np.full(3, color, np.float32) if color.ndim == 0 else color, 0, 1),
        roughness=np.clip(np.asarray(roughness, np.float32), 0, 1),
        metallic=np.clip(np.asarray(metallic, np.float32), 0, 1),
        wrap=wrap,
    )


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


def _read_library(folder: Path, names: str) -> str:
    """Text of the material libraries of one `mtllib` line: one name with spaces, or several without."""
    single = (folder / names).is_file() or len(names.split()) == 1
    found = [read_companion(folder, name.replace("\\", "/")) for name in ([names] if single else names.split())]
    return "\n".join(data.decode("utf-8", errors="replace") for data in found)


def _material(folder: Path, name: str, library: dict[str, dict[str, str]], ignored: set[str]) -> Material:
    """The principled material of an MTL entry."""
    if name not in library:
        raise RejectedAsset(f"uses material {name!r}, which no material library defines")
    entry = library[name]
    _reject_transparent(entry, name)
    ignored |= {f"MTL {key}" for key in entry if key not in READ | SILENT and entry[key].strip("0. ")}
    options = " ".join(entry.get(key, "") for key in ("map_kd", "map_pr", "map_pm"))
    wrap: Wrap = "clamp" if re.search(r"-clamp\s+on", options) else "repeat"
    color = np.array([float(x) for x in entry.get("kd", "0.5 0.5 0.5").split()[:3]])
    if "map_kd" in entry:
        if "kd" in entry and not np.all(color == 1):
            ignored.add("MTL Kd beside map_Kd")
        color = color_texels(_image(folder, entry["map_kd"], ignored))
    roughness = np.sqrt(2 / (max(float(entry["ns"]), 0) + 2)) if "ns" in entry else 0.5
    channels: dict[str, float | np.ndarray]
    channels = {"roughness": float(entry.get("pr", roughness)), "metallic": float(entry.get("pm", 0))}
    for channel, key in (("roughness", "map_pr"), ("metallic", "map_pm")):
        if key in entry:
            channels[channel] = value_texels(_image(folder, entry[key], ignored)[..., 0])
    return principled(color, **channels, wrap=wrap)


def _image(folder: Path, statement: str, ignored: set[str]) -> np.ndarray:
    """Texels of a map statement, whose options are named as ignored (all but -clamp)."""
    while option := OPTION.match(statement):
        if option[1] != "clamp":
            ignored.add(f"MTL map option -{option[1]}")
        statement = statement[option.end() :]
    name = statement.strip().replace("\\", "/")
    return read_image(read_companion(folder, name), name)


def _reject_transparent(entry: dict[str, str], name: str) -> None:
    if "map_d" in entry:
        raise RejectedAsset(f"is transparent: material {name!r} has map_d")
    if "d" in entry and (opacity := float(entry["d"].split()[-1])) < 1:
        raise RejectedAsset(f"is transparent: material {name!r} has d {opacity:g}")
    if "tr" in entry and 0 < (share := float(entry["tr"].split()[-1])) < 1:
        raise RejectedAsset(f"is transparent: material {name!r} has Tr {share:g}")


def _renamed(text: str, names: list[str]) -> str:
    """The OBJ text with numbered material names and absolute vertex numbers, its library replaced by ours."""
    numbers = {name: PLACE.format(number) for number, name in enumerate(names)}
    text = re.sub(r"(?m)^mtllib.*$", "", text)
    text = re.sub(r"(?m)^usemtl +(.+?) *$", lambda match: f"usemtl {numbers[match[1]]}", text)
    if re.search(r"(?m)^f .*-", text):
        text = _absolute(text)
    return f"mtllib names\n{text}"


def _absolute(text: str) -> str:
    """The OBJ text with relative (negative) vertex numbers made absolute; trimesh counts them from the file's end."""
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


def _name_list(materials: dict[str, Material]) -> str:
    """An MTL text of names only, which makes trimesh keep the material of each face."""
    return "\n".join(f"newmtl {name}" for name in materials)


def _part(mesh: dict, material: Material) -> Part:
    """One group of faces that trimesh read."""
    texcoords = getattr(mesh["visual"], "uv", None)
    if texcoords is not None:
        texcoords = np.stack([texcoords[:, 0], 1 - texcoords[:, 1]], axis=-1)  # OBJ counts v from the lower edge
    return Part(
        positions=np.asarray(mesh["vertices"], np.float64),
        faces=triangulate_quads(mesh["faces"]),
        material=material,
        normals=mesh.get("vertex_normals"),
        texcoords=texcoords,
        colors=mesh.get("vertex_colors"),
    )
