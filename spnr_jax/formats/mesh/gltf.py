"""glTF 2.0 scenes as raw assets: one part per drawn primitive, node transforms applied.

Normals go through the inverse transpose; a transform that mirrors flips the winding. The rest pose is read. What is
not modelled is named in `ignored`; an extension that the file requires and that is not known here rejects the object.
"""

from pathlib import Path

import numpy as np
from trimesh.transformations import quaternion_matrix

from spnr_jax.formats.mesh.assets import Asset, Part, RejectedAsset
from spnr_jax.formats.mesh.gltf_container import GltfFile
from spnr_jax.formats.mesh.gltf_materials import GltfMaterial, read_material

MODES = {
    0: "POINTS",
    1: "LINES",
    2: "LINE_LOOP",
    3: "LINE_STRIP",
    4: "TRIANGLES",
    5: "TRIANGLE_STRIP",
    6: "TRIANGLE_FAN",
}
READABLE = {"KHR_texture_transform", "KHR_mesh_quantization", "EXT_texture_webp", "KHR_lights_punctual"}
INSTANCING = "EXT_mesh_gpu_instancing"


def load_gltf(path: Path) -> Asset:
    """The scene's triangles with their materials, as they lie in the file; RejectedAsset if it cannot be used."""
    file = GltfFile(path)
    document = file.document
    for extension in document.get("extensionsRequired", []):
        if extension not in READABLE and not extension.startswith("KHR_materials_"):
            raise RejectedAsset(f"needs {extension}, which cannot be read: export it without that extension")
    ignored = {key for key in ("animations", "skins") if document.get(key)}
    if "KHR_lights_punctual" in document.get("extensions", {}):
        ignored.add("KHR_lights_punctual")
    materials: dict[int | None, GltfMaterial] = {}
    parts = []
    for mesh, matrix in _drawn_meshes(document):
        for primitive in mesh["primitives"]:
            mode = MODES[primitive.get("mode", 4)]
            if not mode.startswith("TRIANGLE"):
                ignored.add(f"{mode} primitives")
                continue
            index = primitive.get("material")
            if index not in materials:
                materials[index] = read_material(file, index)
            parts.append(_part(file, primitive, mode, materials[index], matrix, ignored))
            ignored |= materials[index].ignored
    return Asset(parts=tuple(parts), ignored=tuple(sorted(ignored)))


def _drawn_meshes(document: dict) -> list[tuple[dict, np.ndarray]]:
    """(mesh, matrix to world (4, 4)) of every node of the default scene that draws a mesh, depth first."""
    nodes = document.get("nodes", [])
    if scenes := document.get("scenes"):
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        roots = sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})
    drawn, seen = [], set()
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        if index in seen:
            raise RejectedAsset(f"its node {index} is reached twice: the scene is not a tree")
        seen.add(index)
        node = nodes[index]
        if INSTANCING in node.get("extensions", {}):
            raise RejectedAsset(f"needs {INSTANCING}, which cannot be read: export it without that extension")
        matrix = parent @ _node_matrix(node)
        if "mesh" in node:
            drawn.append((document["meshes"][node["mesh"]], matrix))
        stack += [(child, matrix) for child in reversed(node.get("children", []))]
    return drawn


def _node_matrix(node: dict) -> np.ndarray:
    """Matrix (4, 4) from the node's frame to its parent's."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix = quaternion_matrix([w, x, y, z])
    matrix[:3, :3] *= node.get("scale", (1, 1, 1))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _part(
    file: GltfFile, primitive: dict, mode: str, look: GltfMaterial, matrix: np.ndarray, ignored: set[str]
) -> Part:
    """One primitive in world space."""
    attributes = {name: file.accessor(index) for name, index in primitive["attributes"].items() if _wanted(name, look)}
    if primitive.get("targets"):
        ignored.add("morph targets")
    ignored.update(name for name in primitive.get("extensions", {}) if name == "KHR_materials_variants")
    local = attributes["POSITION"]
    order = file.accessor(primitive["indices"])[:, 0] if "indices" in primitive else np.arange(len(local))
    faces = _triangles(order, mode)
    linear = matrix[:3, :3]
    mirrored = np.linalg.det(linear) < 0
    normals, texcoords, colors = (attributes.get(name) for name in ("NORMAL", _texcoord(look), "COLOR_0"))
    return Part(
        positions=local @ linear.T + matrix[:3, 3],
        faces=faces[:, ::-1] if mirrored else faces,
        material=look.material,
        # the adjugate's transpose: a multiple of the inverse transpose, defined for a singular matrix too
        normals=None if normals is None else normals @ _cofactors(linear).T * (-1 if mirrored else 1),
        texcoords=None if texcoords is None else look.transform(texcoords),
        colors=None if colors is None else colors[:, :3],
    )


def _wanted(attribute: str, look: GltfMaterial) -> bool:
    return attribute in ("POSITION", "NORMAL", "COLOR_0", _texcoord(look))


def _texcoord(look: GltfMaterial) -> str:
    return f"TEXCOORD_{look.texcoord_set}"


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
