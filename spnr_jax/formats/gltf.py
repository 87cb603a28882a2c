"""glTF 2.0 scenes as raw assets: one part per primitive of a node, node transforms applied from the root.

Normals go through the inverse transpose; a transform that mirrors flips the winding. The rest pose is read.
What is not modelled is named in `ignored`; an extension that the file requires and that is not known here rejects the
object.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from trimesh.transformations import quaternion_matrix

from spnr_jax.formats.assets import Asset, Material, Part, RejectedAsset, Tolerance, TransparentParts
from spnr_jax.formats.columns import LINEAR, Columns
from spnr_jax.formats.gltf_file import (
    BASIS,
    DRACO,
    MESHOPT,
    MOVED,
    WEBP,
    GltfFile,
    GltfMaterial,
    decode_accessor,
    decode_mesh,
    read_material,
)
from spnr_jax.formats.polygons import strip_faces

MODES = dict(enumerate(("POINTS", "LINES", "LINE_LOOP", "LINE_STRIP", "TRIANGLES", "TRIANGLE_STRIP", "TRIANGLE_FAN")))
READABLE = {MOVED, WEBP, BASIS, DRACO, *MESHOPT, "KHR_mesh_quantization", "KHR_lights_punctual"}
DROPPED = {"KHR_lights_punctual", "EXT_mesh_gpu_instancing"}  # of what a scene may use
SPLATS = "KHR_gaussian_splatting"
NO_COLORS = np.ones((1, 3))
OTHERS = ("POSITION", "NORMAL", "COLOR_0")  # columns, beside texture coordinates, that are read
# Faces that are drawn again, beside each mesh's first: a small file could ask for any number.  To draw a mesh again
# costs as much as PLACING faces.
MOST_REPEATED, PLACING = 2**23, 64


def list_primitives(file: GltfFile) -> Iterator[tuple[dict, np.ndarray]]:
    """(primitive, matrix to world (4, 4)) of every node of the default scene that draws a mesh, depth first."""
    document = file.document
    nodes = document.get("nodes", [])
    if scenes := document.get("scenes"):
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        roots = sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})
    seen = set()
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        if index in seen:
            raise RejectedAsset(f"its node {index} is reached twice: the scene is not a tree")
        seen.add(index)
        node = nodes[index]
        matrix = parent @ _node_matrix(node)
        if "mesh" in node:
            for primitive in document["meshes"][node["mesh"]]["primitives"]:
                if (number := primitive["attributes"].get("COLOR_0")) is not None:
                    document["accessors"][number]["normalized"] = True  # whole numbers always are; some writers forget
                yield primitive, matrix
        stack += [(child, matrix) for child in reversed(node.get("children", []))]


def _node_matrix(node: dict) -> np.ndarray:
    """Matrix (4, 4) from the node's frame to its parent's."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix = quaternion_matrix([w, x, y, z])
    matrix[:3, :3] *= node.get("scale", (1, 1, 1))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


class Shape(NamedTuple):
    """A primitive in its own frame: columns by name (v, width), and faces (f, 3)."""

    columns: dict[str, np.ndarray]
    faces: np.ndarray


def load_gltf(path: Path, transparent_parts: TransparentParts = "refuse") -> Asset:
    """The scene's triangles with their materials, as they lie in the file; RejectedAsset if it cannot be used."""
    file, tolerance = GltfFile(path), Tolerance(transparent_parts)
    document, drawn = file.document, list(list_primitives(file))
    if not tolerance.strict and (points := _points(file, drawn)):
        return Asset(parts=(), points=points)
    for extension in document.get("extensionsRequired", []):
        if extension not in READABLE and not extension.startswith("KHR_materials_"):
            raise RejectedAsset(f"needs {extension}, which cannot be read: export it without that extension")
    ignored = tolerance.ignored
    ignored |= {key for key in ("animations", "skins") if document.get(key)}
    ignored |= DROPPED.intersection(document.get("extensionsUsed", []))
    materials: dict[int | None, GltfMaterial] = {}
    shapes: dict[int, Shape] = {}  # by id: the document keeps every primitive alive
    parts, repeated = [], 0
    for primitive, matrix in drawn:
        mode = MODES[primitive.get("mode", 4)]
        if not mode.startswith("TRIANGLE"):
            ignored.add(f"{mode} primitives")
            continue
        index = primitive.get("material")
        if index not in materials:
            materials[index] = read_material(file, index, tolerance)
        look, again = materials[index], id(primitive) in shapes
        ignored |= {"KHR_materials_variants"}.intersection(primitive.get("extensions", {}))
        if primitive.get("targets"):
            ignored.add("morph targets")
        if look.material is None:
            continue
        shape = shapes[id(primitive)] if again else _shape(file, primitive, mode, look)
        shapes[id(primitive)] = shape
        if look.has_alpha and shape.columns.get("COLOR_0", NO_COLORS)[:, 3:].min(initial=1) < 1:
            ignored.add("alpha of vertex colours")
        repeated += again * (len(shape.faces) + PLACING)
        if repeated > MOST_REPEATED:
            raise RejectedAsset(f"repeats its meshes more than can be read ({MOST_REPEATED} faces)")
        parts.append(_place(shape, look, look.material, matrix))
    return tolerance.asset(parts)


def _points(file: GltfFile, drawn: list[tuple[dict, np.ndarray]]) -> Columns | None:
    """The columns of the points of a scene without triangles; None if it has some, or no points either."""
    modes = {MODES[primitive.get("mode", 4)] for primitive, _ in drawn}
    if "POINTS" not in modes or any(mode.startswith("TRIANGLE") for mode in modes):
        return None
    pieces: list[Columns] = []
    for primitive, matrix in drawn:
        if primitive.get("mode") != 0:
            continue
        if SPLATS in primitive.get("extensions", {}):
            raise RejectedAsset(f"holds Gaussian splats ({SPLATS}), which are not read: convert it to .ply or .spz")
        attributes = primitive["attributes"]
        positions = file.accessor(attributes["POSITION"]) @ matrix[:3, :3].T + matrix[:3, 3]
        pieces.append(dict(zip("xyz", positions.T, strict=True)))
        if "COLOR_0" in attributes:
            pieces[-1] |= dict(zip((*LINEAR, "alpha"), file.accessor(attributes["COLOR_0"]).T, strict=False))
    shared = set(pieces[0]).intersection(*pieces[1:])
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0] if name in shared}


def _shape(file: GltfFile, primitive: dict, mode: str, look: GltfMaterial) -> Shape:
    """The columns that a material needs, and the faces, of a primitive."""
    names = *OTHERS, f"TEXCOORD_{look.placement.texcoord_set}"
    wanted = {name: index for name, index in primitive["attributes"].items() if name in names}
    packed = primitive.get("extensions", {}).get(DRACO)
    if packed is None:
        columns = {name: file.accessor(index) for name, index in wanted.items()}
        given = file.accessor(primitive["indices"])[:, 0] if "indices" in primitive else None
        order = np.arange(len(columns["POSITION"])) if given is None else given
        return Shape(columns, _triangles(order, mode))
    ids = {name: number for name, number in packed["attributes"].items() if name in wanted}
    if "POSITION" not in ids:
        raise RejectedAsset("has no POSITION in its Draco mesh: broken file")
    unpacked, order = decode_mesh(file.view(packed["bufferView"]), ids)
    accessors = file.document["accessors"]
    columns = {name: decode_accessor(values, accessors[wanted[name]]) for name, values in unpacked.items()}
    columns |= {name: file.accessor(wanted[name]) for name in wanted if name not in ids}
    return Shape(columns, _triangles(order, "TRIANGLES"))  # whatever the mode: Draco keeps triangles


def _place(shape: Shape, look: GltfMaterial, material: Material, matrix: np.ndarray) -> Part:
    """One primitive in world space."""
    linear = matrix[:3, :3]
    mirrored = np.linalg.det(linear) < 0
    normals, colors = shape.columns.get("NORMAL"), shape.columns.get("COLOR_0")
    texcoords = shape.columns.get(f"TEXCOORD_{look.placement.texcoord_set}")
    return Part(
        positions=shape.columns["POSITION"] @ linear.T + matrix[:3, 3],
        faces=shape.faces[:, ::-1] if mirrored else shape.faces,
        material=material,
        # the adjugate's transpose: a multiple of the inverse transpose, defined for a singular matrix too
        normals=None if normals is None else normals @ _cofactors(linear).T * (-1 if mirrored else 1),
        texcoords=None if texcoords is None else look.placement.transform(texcoords),
        colors=None if colors is None else colors[:, :3],
    )


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
    return strip_faces(order)
