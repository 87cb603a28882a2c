"""Which meshes a glTF scene draws, and where: node transforms from the root, and instances of a node.

EXT_mesh_gpu_instancing draws a node's mesh once for each row of its attributes.
"""

from collections.abc import Iterator

import numpy as np
from trimesh.transformations import quaternion_matrix

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.gltf_container import GltfFile

INSTANCING = "EXT_mesh_gpu_instancing"
PLACED = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}  # attributes of instances, and their widths
MOST_INSTANCES = 2**17  # of a node


def drawn_meshes(file: GltfFile) -> Iterator[tuple[int, list[np.ndarray]]]:
    """(mesh, matrices to world (4, 4)) of every node of the default scene that draws a mesh, depth first."""
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
            yield node["mesh"], _instances(file, node, matrix)
        stack += [(child, matrix) for child in reversed(node.get("children", []))]


def _instances(file: GltfFile, node: dict, matrix: np.ndarray) -> list[np.ndarray]:
    """The matrices to world of a node's instances, of which most nodes have one."""
    attributes = node.get("extensions", {}).get(INSTANCING, {}).get("attributes")
    if not attributes:
        return [matrix]
    columns = {name: file.accessor(index) for name, index in attributes.items() if name in PLACED}
    counts = {len(column) for column in columns.values()}
    if len(counts) != 1 or any(column.shape[1] != PLACED[name] for name, column in columns.items()):
        raise RejectedAsset(f"has instances ({INSTANCING}) whose attributes do not agree: broken file")
    (count,) = counts
    if count > MOST_INSTANCES:
        raise RejectedAsset(f"has {count} instances of a mesh; at most {MOST_INSTANCES} can be read")
    each = [{name.lower(): columns[name][i] for name in columns} for i in range(count)]
    return [matrix @ _node_matrix(values) for values in each]


def _node_matrix(node: dict) -> np.ndarray:
    """Matrix (4, 4) from the node's frame to its parent's."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix = quaternion_matrix([w, x, y, z])
    matrix[:3, :3] *= node.get("scale", (1, 1, 1))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
