"""glTF 2.0 scenes as raw assets: one part per primitive of a node, node transforms applied.

Normals go through the inverse transpose; a transform that mirrors flips the winding. The rest pose is read. What is
not modelled is named in `ignored`; an extension that the file requires and that is not known here rejects the object.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from spnr_jax.formats.mesh.assets import Asset, Part, RejectedAsset, TransparentParts
from spnr_jax.formats.mesh.draco import DRACO, decode_mesh
from spnr_jax.formats.mesh.file_colors import LINEAR, SRGB
from spnr_jax.formats.mesh.gltf_container import MESHOPT, GltfFile, scaled
from spnr_jax.formats.mesh.gltf_materials import GltfMaterial, read_material
from spnr_jax.formats.mesh.gltf_nodes import INSTANCING, drawn_meshes
from spnr_jax.formats.mesh.gltf_textures import BASIS, MOVED, WEBP
from spnr_jax.formats.mesh.tolerance import Tolerance
from spnr_jax.surfels.gaussians import C0

MODES = {
    0: "POINTS",
    1: "LINES",
    2: "LINE_LOOP",
    3: "LINE_STRIP",
    4: "TRIANGLES",
    5: "TRIANGLE_STRIP",
    6: "TRIANGLE_FAN",
}
READABLE = {MOVED, WEBP, BASIS, DRACO, *MESHOPT, INSTANCING, "KHR_mesh_quantization", "KHR_lights_punctual"}
SPLATS = "KHR_gaussian_splatting"
NO_COLORS = np.ones((1, 3))
OTHERS = ("POSITION", "NORMAL", "COLOR_0")  # columns, beside texture coordinates, that are read
# Faces that are drawn again, beside each mesh's first: a small file could ask for any number.  To draw a mesh again
# costs as much as PLACING faces.
MOST_REPEATED, PLACING = 2**23, 64


class Shape(NamedTuple):
    """A primitive in its own frame: columns by name (v, width), and faces (f, 3)."""

    columns: dict[str, np.ndarray]
    faces: np.ndarray


def load_gltf(path: Path, transparent_parts: TransparentParts = "refuse") -> Asset:
    """The scene's triangles with their materials, as they lie in the file; RejectedAsset if it cannot be used."""
    file, tolerance = GltfFile(path), Tolerance(transparent_parts)
    document = file.document
    for extension in document.get("extensionsRequired", []):
        if extension not in READABLE and not extension.startswith("KHR_materials_"):
            raise RejectedAsset(f"needs {extension}, which cannot be read: export it without that extension")
    ignored = {key for key in ("animations", "skins") if document.get(key)}
    if "KHR_lights_punctual" in document.get("extensions", {}):
        ignored.add("KHR_lights_punctual")
    materials: dict[int | None, GltfMaterial] = {}
    shapes: dict[tuple[int, int], Shape] = {}
    parts, repeated = [], 0
    for mesh, matrices in drawn_meshes(file):
        for number, primitive in enumerate(document["meshes"][mesh]["primitives"]):
            mode = MODES[primitive.get("mode", 4)]
            if not mode.startswith("TRIANGLE"):
                ignored.add(f"{mode} primitives")
                continue
            index = primitive.get("material")
            if index not in materials:
                materials[index] = read_material(file, index, tolerance)
            look = materials[index]
            ignored |= _left_out(primitive) | look.ignored
            if look.nowhere:
                continue
            again = (mesh, number) in shapes
            shape = shapes[mesh, number] if again else _shape(file, primitive, mode, look)
            shapes[mesh, number] = shape
            if look.has_alpha and shape.columns.get("COLOR_0", NO_COLORS)[:, 3:].min(initial=1) < 1:
                ignored.add("alpha of vertex colours")
            repeated += (len(shape.faces) + PLACING) * max(0, len(matrices) - 1 + again)
            if repeated > MOST_REPEATED:
                raise RejectedAsset(
                    f"repeats its meshes more than can be read ({MOST_REPEATED} faces): fewer instances can"
                )
            parts += [_placed(shape, look, matrix) for matrix in matrices]
    if not parts and any(look.nowhere for look in materials.values()):
        raise RejectedAsset(f"has nothing to draw: {'; '.join(tolerance.notes())}")
    return Asset(parts=tuple(parts), ignored=tuple(sorted(ignored)), notes=tuple(tolerance.notes()))


def gltf_points(path: Path) -> dict[str, np.ndarray] | None:
    """The columns of the points of a scene without triangles; None if it has some, or no points either.

    Colours are linear, as the specification has them, or display-referred sRGB where a splat says so.
    """
    file = GltfFile(path)
    meshes = file.document.get("meshes", [])
    drawn = [(primitive, matrices) for mesh, matrices in drawn_meshes(file) for primitive in meshes[mesh]["primitives"]]
    modes = {MODES[primitive.get("mode", 4)] for primitive, _ in drawn}
    if "POINTS" not in modes or any(mode.startswith("TRIANGLE") for mode in modes):
        return None
    pieces = []
    for primitive, matrices in drawn:
        if primitive.get("mode") != 0:
            continue
        columns = _point_columns(file, primitive)
        positions = np.stack([columns[axis] for axis in "xyz"], axis=-1)
        for matrix in matrices[: max(1, MOST_REPEATED // max(1, len(positions)))]:
            placed = positions @ matrix[:3, :3].T + matrix[:3, 3]
            pieces.append(columns | dict(zip("xyz", placed.T, strict=True)))
    shared = set(pieces[0]).intersection(*pieces[1:])
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0] if name in shared}


def _point_columns(file: GltfFile, primitive: dict) -> dict[str, np.ndarray]:
    """The columns of a primitive of points in its own frame, without normals, which nodes turn."""
    attributes = primitive["attributes"]
    columns = dict(zip("xyz", file.accessor(attributes["POSITION"]).T, strict=True))
    shown = primitive.get("extensions", {}).get(SPLATS, {}).get("colorSpace") == "srgb_rec709_display"
    names = (*(SRGB if shown else LINEAR), "alpha")
    if "COLOR_0" in attributes:
        columns |= dict(zip(names, file.accessor(attributes["COLOR_0"]).T, strict=False))
    elif f"{SPLATS}:SH_DEGREE_0_COEF_0" in attributes:
        colors = 0.5 + C0 * file.accessor(attributes[f"{SPLATS}:SH_DEGREE_0_COEF_0"])
        columns |= dict(zip(names, np.clip(colors, 0, 1).T, strict=False))
    if f"{SPLATS}:OPACITY" in attributes:
        columns.pop("alpha", None)
        columns["splat_opacity"] = file.accessor(attributes[f"{SPLATS}:OPACITY"])[:, 0]
    return columns


def _left_out(primitive: dict) -> set[str]:
    """What of a primitive is not modelled."""
    found = {name for name in primitive.get("extensions", {}) if name == "KHR_materials_variants"}
    return found | {"morph targets"} if primitive.get("targets") else found


def _shape(file: GltfFile, primitive: dict, mode: str, look: GltfMaterial) -> Shape:
    """The columns that a material needs, and the faces, of a primitive."""
    sets = [f"TEXCOORD_{place.texcoord_set}" for place in look.placements]
    wanted = {name: index for name, index in primitive["attributes"].items() if name in (*OTHERS, *sets)}
    packed = primitive.get("extensions", {}).get(DRACO)
    if packed is None:
        columns = {name: file.accessor(index) for name, index in wanted.items()}
        given = file.accessor(primitive["indices"])[:, 0] if "indices" in primitive else None
        order = np.arange(len(columns["POSITION"])) if given is None else given
        return Shape(columns, _triangles(order, mode))
    ids = {name: number for name, number in packed["attributes"].items() if name in wanted}
    if "POSITION" not in ids:
        raise RejectedAsset("has no POSITION in its Draco mesh: broken file")
    unpacked, order = decode_mesh(file.view_bytes(packed["bufferView"]), ids)
    accessors = file.document["accessors"]
    columns = {name: scaled(values, accessors[wanted[name]]) for name, values in unpacked.items()}
    columns |= {name: file.accessor(wanted[name]) for name in wanted if name not in ids}
    return Shape(columns, _triangles(order, "TRIANGLES"))  # whatever the mode: Draco keeps triangles


def _placed(shape: Shape, look: GltfMaterial, matrix: np.ndarray) -> Part:
    """One primitive in world space."""
    linear = matrix[:3, :3]
    mirrored = np.linalg.det(linear) < 0
    normals, colors = shape.columns.get("NORMAL"), shape.columns.get("COLOR_0")
    return Part(
        positions=shape.columns["POSITION"] @ linear.T + matrix[:3, 3],
        faces=shape.faces[:, ::-1] if mirrored else shape.faces,
        material=look.material,
        # the adjugate's transpose: a multiple of the inverse transpose, defined for a singular matrix too
        normals=None if normals is None else normals @ _cofactors(linear).T * (-1 if mirrored else 1),
        texcoords=_texcoords(shape, look),
        colors=None if colors is None else colors[:, :3],
    )


def _texcoords(shape: Shape, look: GltfMaterial) -> np.ndarray | None:
    """Texture coordinates (v, 2 n), pair after pair as the material counts them; None without the first pair."""
    found: list[np.ndarray] = []
    for place in look.placements:
        texcoords = shape.columns.get(f"TEXCOORD_{place.texcoord_set}")
        if texcoords is None and not found:
            return None
        found.append(np.zeros_like(found[0]) if texcoords is None else place.transform(texcoords))
    return found[0] if len(found) == 1 else np.concatenate(found, axis=1)


def _cofactors(matrix: np.ndarray) -> np.ndarray:
    """Cofactor matrix (3, 3): determinant times the inverse transpose."""
    a, b, c = matrix
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])


def _triangles(order: np.ndarray, mode: str) -> np.ndarray:
    """Faces (f, 3) of a sequence of vertex indices (n,)."""
    if mode == "TRIANGLES":
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == "TRIANGLE_FAN":
        return np.stack([order[1:-1], order[2:], np.full(len(order) - 2, order[0])], axis=-1)
    faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=-1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces
