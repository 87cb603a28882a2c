"""Wavefront OBJ + MTL as parts; vertex colours are read like those of points (columns.py).

base colour   map_Kd (sRGB), else Kd (linear, as Blender writes it): beside a map, Kd is a placeholder in most files
roughness     Pr; else 1 - sqrt(Ns / 1000) from Blender's exporter (900 from its older one); else sqrt(2 / (Ns + 2)) if
              there is a highlight (not with Ks 0, or illum 0 or 1); else 0.5
metallic      Pm, else 0
transparent   d below 1; map_d, cut out at 0.5; Tr strictly between 0 and 1 (writers disagree which end is opaque)

Of faces with the same three corners, which ShapeNet has for the two sides, the one with the first material is kept.
"""

import contextlib
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats import assets
from spnr_jax.formats.assets import RGB, Loading, Material, Part, Texels, make_material
from spnr_jax.formats.columns import NORMAL, SRGB, Columns, colors_of, full_scale
from spnr_jax.formats.point_tables import decode_text, load_text
from spnr_jax.formats.polygons import colored_part
from spnr_jax.kernels.cloud_arrays import stack_columns
from spnr_jax.kernels.triangles import triangulate

Rests = dict[str, list]
Move = tuple[tuple[float, float], tuple[float, float]]  # scale and offset of texture coordinates
Look = tuple[Material | None, Move]  # None for a material that is invisible everywhere
UNMOVED: Move = (1.0, 1.0), (0.0, 0.0)
POLYPAINT = "#MRGB"  # of ZBrush: mask, red, green and blue of each vertex, in hexadecimal digits
MAPS = ("map_kd", "map_pr", "map_pm", "map_d")
NEARLY_GREY = 16  # of 255: largest difference between the channels of a grey JPEG
READ = {"kd", "pr", "pm", "ns", "d", "tr", "blender", *MAPS}
SILENT = {"ka", "ks", "ni", "illum", "tf", "sharpness"}  # Phong parameters without a principled counterpart
SHININESS = re.compile(r"\s*# Blender( MTL)?")  # Blender: Ns = 1000 (1 - roughness)^2, formerly 900
WORD = r"\s+(?:on|off|[rgbmlz]|sphere|cube_\w+|[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)(?!\S)"
OPTION = re.compile(rf"-(\w+)((?:{WORD})*)\s+")
BEHIND = re.compile(rf"^(.*?)((?:\s{{1,9}}-[a-z]\w*(?:{WORD}){{1,4}}){{1,9}})$")  # a file's name, then its options


def load_obj(path: Path, loading: Loading) -> list[Part]:
    """The file's faces grouped by material."""
    text = _parse(decode_text(path.read_bytes()))
    if text["l"]:
        loading.ignored.add("lines")
    if (text["surf"] or text["curv"]) and not text["f sizes"]:
        raise UserError("holds curved surfaces or curves (NURBS), which are not read: export it as a mesh")
    columns = _columns(text, loading)
    if not text["f sizes"]:
        if len(text["vn"]) == len(text["v"]):
            columns |= dict(zip(NORMAL, _table(text["vn"], 3, "vn").T, strict=True))
        return colored_part(columns, np.zeros(0, np.int64), np.zeros(0, np.int64), {}, loading)
    colors, notes = colors_of(columns) or (None, [])
    loading.say(*notes)
    library: dict[str, dict[str, str]] = {}
    for name in (name for names in text["mtllib"] for name in re.split(r"(?i)(?<=\.mtl)\s+(?!#)", names.strip())):
        library |= parse_mtl(loading.read(name.partition(" #")[0].strip('" ')) or b"")
    looks: dict[str, Look] = {}
    for name in dict.fromkeys(text["usemtl"]):
        look, move = _look(name, library.get(name), loading) if name else (make_material(), UNMOVED)
        if colors is not None and look is not None and np.ptp(look.base_color) == 0:
            loading.ignored |= {"MTL Kd beside colours of the vertices"} if name in library else set()
            look = replace(look, base_color=np.ones(3, np.float32))  # Kd is a placeholder
        elif colors is not None and look is not None and look.base_color.ndim == 1:
            loading.say("colours of the vertices multiply those of the material", about=repr(name))
        looks[name] = look, move
    parts = _parts(text, columns, colors, looks, loading)
    if loose := len(text["v"]) - len({word.split("/")[0] for word in text["f"]}):
        loading.ignored.add(f"{loose:,} vertices of no face")
    if text["vn"] and any(part.normals is None for part in parts):
        loading.ignored.add("normals that only some faces have (flat shading is used)")
    return parts


def _parse(content: str) -> Rests:
    """Lines by keyword, without it; faces as all corners (words like 1/2/3, from 1), sizes and materials."""
    keywords = ("v", "vt", "vn", "f", "f sizes", "l", "usemtl", "mtllib", "surf", "curv", POLYPAINT)
    found: Rests = {keyword: [] for keyword in keywords}
    counted, material = (found["v"], found["vt"], found["vn"]), ""
    content = content.replace("\r\n", "\n").replace("\r", "\n")
    if "\\" in content:  # lines that go on in the next one
        content = re.sub(r"(?m)^([^#\n][^\n]*)\\[ \t]*\n", r"\1 ", content)
    for line in content.splitlines():
        keyword, rest = (*line.split(None, 1), "", "")[:2]
        if keyword == "f":
            words = rest.partition("#")[0].split()
            if "-" in rest:  # relative indices
                pairs = [zip(word.split("/"), counted, strict=False) for word in words]
                words = ["/".join(str(int(n) + len(x) + 1) if n[:1] == "-" else n for n, x in pair) for pair in pairs]
            found["f"].extend(words)
            found["f sizes"].append(len(words))
            found["usemtl"].append(material)
        elif keyword == "usemtl":
            material = rest.strip()
        elif keyword in found:
            found[keyword].append(rest)
    return found


def _table(rows: list[str], width: int, keyword: str) -> np.ndarray:
    """The first `width` numbers of each row (rows, width)."""
    numbered = [(number, row.partition("#")[0]) for number, row in enumerate(rows, 1)]
    return load_text(numbered, keyword, width, ndmin=2, usecols=range(width)) if rows else np.zeros((0, width))


def _columns(text: Rests, loading: Loading) -> Columns:
    """Columns of the vertices: positions and, if present, colours; white where only some have one (Blender)."""
    rows = [row.partition("#")[0] for row in text["v"]]
    bare, table = np.zeros(len(rows), bool), np.zeros((0, 3))
    with contextlib.suppress(ValueError):  # of words, or rows of several lengths
        table = np.loadtxt(rows, ndmin=2) if all(rows) and rows else table
    if len(table) != len(rows):
        lengths = np.array([len(row.split()) for row in rows])
        bare = lengths == (3 if {*lengths} == {3, 6} else 0)
        whole = [row + " nan nan nan" * int(none) for row, none in zip(rows, bare, strict=True)]
        table = _table(whole, int(lengths.max()), "v")
    if bare.any():
        loading.say(f"{bare.sum():,} of {len(rows):,} vertices have no colour: white taken")
        table[bare, 3:] = full_scale(table.dtype, float(table[~bare, 3:].max()))
    ones = (table[:, 3:] == 1).all(axis=0).tolist()
    if len(ones) == 4 and ones[0] and not (ones[3] or all(ones[:3])):  # weights of the vertices, not white and alpha
        table = np.delete(table, 3, axis=1)
    width = table.shape[1]
    used = 3 if width < 6 else 6 if width > 7 else width  # behind colours: alpha alone, but no normal
    if (table[:, used:] != 1).any():
        loading.ignored.add("numbers behind the coordinates of vertices")
    columns = dict(zip((*"xyz", *SRGB, "alpha"), table.T[:used], strict=False))
    digits = "".join(text[POLYPAINT])[: 8 * len(table)]
    if len(digits) == 8 * len(table) and re.fullmatch("[0-9a-fA-F]*", digits):
        columns |= dict(zip(SRGB, np.frombuffer(bytes.fromhex(digits), np.uint8).reshape(-1, 4).T[1:], strict=True))
    elif digits:
        loading.say(f"{POLYPAINT} (colours of ZBrush) is broken or cut off, and not used")
    return columns


def _parts(
    text: Rests, columns: Columns, colors: np.ndarray | None, looks: dict[str, Look], loading: Loading
) -> list[Part]:
    """The faces of each visible material, split by whether they have texture coordinates and normals."""
    numbers = {word: i for i, word in enumerate(dict.fromkeys(text["f"]))}
    corners = np.array([[int(n or 0) for n in f"{word}//".split("/")[:3]] for word in numbers])  # of vertices
    if corners.min() < 0 or corners[:, 0].min() < 1:
        raise UserError("has faces that name vertices before the first: broken file")
    for last, keyword in zip(corners.max(axis=0), ("v", "vt", "vn"), strict=True):
        if last > (count := len(text[keyword])):
            raise UserError(f"has faces that name {keyword} {last} of {count}: broken file")
    of_v, of_vt, of_vn = corners.T - 1
    positions, colors = stack_columns(columns)[of_v], None if colors is None else colors[of_v]
    alpha = columns["alpha"][of_v] if "alpha" in columns else None
    texcoords = _table([f"{row} 0" for row in (*text["vt"], "0")], 2, "vt")[of_vt]  # a 1-D coordinate gets v = 0
    normals = _table([*text["vn"], "0 0 0"], 3, "vn")[of_vn]
    faces, owner = triangulate(positions, np.array([numbers[word] for word in text["f"]]), text["f sizes"])
    number = {name: i for i, name in enumerate(looks)}
    has = (corners[faces] > 0).all(axis=1)  # (f, 3): positions, texture coordinates, normals
    kind = 4 * np.array([number[name] for name in text["usemtl"]])[owner] + 2 * has[:, 1] + has[:, 2]
    shown = np.array([look is not None for look, _ in looks.values()])
    order = np.argsort(kind, kind="stable")
    order = order[shown[kind[order] // 4]]
    first = _first_of_doubles(positions[faces[order]])
    if not first.all():
        loading.ignored.add(f"{int((~first).sum())} doubled faces (one of each is kept)")

    @cache
    def moved(move: Move) -> np.ndarray:
        return (texcoords * move[0] + move[1]) * [1, -1] + [0, 1]  # OBJ's v is from the lower edge

    parts, faces, kind = [], faces[order[first]], kind[order[first]]
    for code in np.unique(kind):
        material, move = list(looks.values())[code // 4]
        assert material is not None
        own, placed = colors, moved(move) if code & 2 else None
        if colors is not None and material.base_color.ndim > 1:
            if placed is None:
                material = replace(material, base_color=np.ones(3, np.float32))
            else:
                loading.say("colours of the vertices not used beside those of a texture")  # often the same (Metashape)
                own = None
        part = Part(positions=positions, faces=faces[kind == code], material=material, colors=own, alpha=alpha)
        parts.append(replace(part, normals=normals if code & 1 else None, texcoords=placed))
    return parts


def _first_of_doubles(corners: np.ndarray) -> np.ndarray:
    """Mask (f,) of the triangles (f, 3, 3) whose corners are not, in any order, those of an earlier one."""
    order = np.lexsort(np.moveaxis(corners, -1, 0)[::-1], axis=-1)
    rows = np.take_along_axis(corners, order[..., None], axis=1).reshape(-1, 9)
    mask = np.zeros(len(corners), bool)
    mask[np.unique(rows, axis=0, return_index=True)[1]] = True
    return mask


# --- materials --------------------------------------------------------------------------------------------------------


def parse_mtl(data: bytes) -> dict[str, dict[str, str]]:
    """Statements of an MTL file: material name -> keyword in lower case -> rest of the line.

    Files of Blender also get `blender`: the Ns of roughness 0.
    """
    library: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    text = decode_text(data)
    blender = SHININESS.match(text)
    shiniest = blender and (900 if blender[1] else 1000)
    for line in text.splitlines():
        keyword, rest = (*line.split(None, 1), "", "")[:2]
        if keyword.lower() == "newmtl":
            current = library.setdefault(rest.strip(), {})
        elif keyword and not keyword.startswith("#"):
            current[keyword.lower()] = re.sub(r"\s#.*", "", rest).strip()
    for entry in library.values() if shiniest else ():
        entry["blender"] = str(shiniest)
    return library


def _look(name: str, entry: dict[str, str] | None, loading: Loading) -> Look:
    """The look of an MTL entry; texture coordinates are transformed as for its first map."""
    ignored = loading.ignored
    if entry is None:
        loading.go_on_without("uses a material that no library defines", repr(name))
        return make_material(), UNMOVED
    if loading.strict:  # transparency is a clearer error than a missing file
        loading.cut_out(name, make_material(), *_alpha(entry, None, loading))
    maps: dict[str, Texels] = {}
    move = UNMOVED
    wrap: assets.Wrap = "repeat"
    for key in MAPS:
        statement, options, place = BEHIND.sub(r"\2 \1", entry.get(key, "")).strip(), {}, 0
        while option := OPTION.match(statement, place):
            options[option[1]], place = option[2].split(), option.end()
        ignored |= {f"MTL map option -{option}" for option in options if option not in ("clamp", "s", "o")}
        file = statement[place:].strip("\"' \t").replace("\\", "/")
        if key in entry and (texels := loading.read_image(file)) is not None:
            own = _pair(options.get("s", ()), 1.0), _pair(options.get("o", ()), 0.0)
            if maps and own != move:
                ignored.add("second texture with its own coordinates")
            move = move if maps else own
            maps[key] = texels
            wrap = "clamp" if options.get("clamp") == ["on"] else wrap
    ignored |= {f"MTL {key}" for key in entry if key not in READ | SILENT and entry[key].strip("0. ")}
    levels = _numbers(entry, "kd", loading) or [0.5]
    color = np.array(levels[:3] if len(levels) > 2 else levels[:1])  # one number is grey
    white = full_scale(color.dtype, float(color.max()), linear=bool(color.max() < 2))
    if white > 1:
        ignored.add(f"MTL Kd beyond 1 (taken as 0 to {white:g})")
    color = color / white
    if "map_kd" in maps:
        if "kd" in entry and not np.all(color == 1):
            ignored.add("MTL Kd beside map_Kd")
        color = maps["map_kd"].values(RGB, "sRGB")
    shiny, highlight = 0.5, _number(entry, "ns", -1.0, loading)
    if highlight >= 0 and "blender" in entry:
        shiny = 1 - min(highlight / float(entry["blender"]), 1) ** 0.5
    elif highlight >= 0 and entry.get("illum") not in ("0", "1") and entry.get("ks", "1").strip("0. "):
        shiny = (2 / (highlight + 2)) ** 0.5
    roughness, metallic = (
        maps[f"map_{key}"].values(0, "linear") if f"map_{key}" in maps else _number(entry, key, plain, loading)
        for key, plain in (("pr", shiny), ("pm", 0.0))
    )
    material = make_material(color, roughness, metallic, wrap)
    return loading.cut_out(name, material, *_alpha(entry, maps.get("map_d"), loading)), move


def _numbers(entry: dict[str, str], key: str, loading: Loading) -> list[float]:
    """The numbers of a statement behind its options, up to the first word; decimal commas are read, too."""
    numbers: list[float] = []
    for word in re.sub(r"-[A-Za-z]+", "", entry.get(key, "")).split():
        try:
            numbers.append(float(word.rstrip(",;").replace(",", ".")))
        except ValueError:
            break
    if not numbers and entry.get(key):
        loading.go_on_without("has no number in its MTL", repr(f"{key} {entry[key]}"))
    return numbers


def _pair(words: Sequence[str], default: float) -> tuple[float, float]:
    """The first two numbers of a map's option, or the default."""
    one, two, *_ = (*(float(word) for word in words if not word.isalpha()), default, default)
    return one, two


def _number(entry: dict[str, str], key: str, default: float, loading: Loading) -> float:
    """The first number of a statement, or the default."""
    return next(iter(_numbers(entry, key, loading)), default)


def _alpha(entry: dict[str, str], map_d: Texels | None, loading: Loading) -> tuple[str, np.ndarray, float | int | None]:
    """The statement that makes an entry transparent ("": opaque), its alpha () or (h, w), and a mask's cut-off."""
    if "map_d" in entry:
        if map_d is None:
            return "map_d", np.ones(()), assets.MOSTLY_OPAQUE
        # a grey picture is the alpha itself; of a coloured one its alpha channel
        encoded = map_d.encoded
        own = entry["map_d"] != entry.get("map_kd") and np.ptp(encoded[..., :3], axis=-1).max() <= NEARLY_GREY
        alpha = map_d.values(0 if own and encoded[..., 3].min() == 255 else 3, "linear")
        return "map_d", alpha, assets.MOSTLY_OPAQUE
    if (opacity := _number(entry, "d", 1.0, loading)) < 1:
        return f"d {opacity:g}", np.asarray(opacity), None
    if 0 < (share := _number(entry, "tr", 0.0, loading)) < 1:
        return f"Tr {share:g}", np.asarray(1 - share), None
    return "", np.ones(()), None
