"""The surface of a density grid as a .glb file, with the materials of the nearest points.

Marching cubes finds where the density crosses a level.  glTF has colours for each vertex but roughness and metallic
for whole primitives only: faces are grouped by the two, rounded, and each group is a primitive with its own material.
Coordinates are those of the file that the points came from, whatever its upward axis.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError
from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.formats.glb import packed
from spnr_jax.tools.density_grid import DensityGrid

NEAREST = 4  # points whose materials a vertex takes the mean of
LEVELS = 8  # steps that roughness and metallic are rounded to
FLOAT, UNSIGNED, ARRAY_BUFFER, INDEX_BUFFER = 5126, 5125, 34962, 34963  # numbers of the glTF specification
KINDS = {1: "SCALAR", 3: "VEC3"}


def mesh_of(grid: DensityGrid, placed: PlacedCloud, level: float) -> tuple[bytes, int]:
    """(.glb file, number of faces) of the surface at a density; ValueError if there is none."""
    from skimage.measure import marching_cubes  # here, so that rendering alone stays quick

    if not grid.density.max() > level:
        raise UserError(f"no surface to write as a mesh: the density is at most {grid.density.max():g}, not {level:g}")
    closed = np.pad(grid.density, 1)  # the surface is closed also where it meets the box
    spacing = (grid.spacing,) * 3
    vertices, faces, normals, _ = marching_cubes(closed, level, spacing=spacing, gradient_direction="ascent")
    vertices = vertices - grid.spacing + grid.lowest
    points = placed.cloud.positions @ placed.rotation.astype(np.float32)  # in the file's frame, from its origin
    _, nearest = cKDTree(points).query(vertices, min(NEAREST, len(points)))
    nearest = nearest.reshape(len(vertices), -1)
    cloud = placed.cloud
    color, roughness, metallic = (m[nearest].mean(axis=1) for m in (cloud.base_color, cloud.roughness, cloud.metallic))
    primitives = list(_primitives(vertices, faces, normals, color, np.stack([roughness, metallic], axis=-1)))
    return glb(primitives, grid.origin), len(faces)


def _primitives(vertices, faces, normals, color, shine) -> Iterator[tuple[dict[str, np.ndarray], tuple[float, float]]]:
    """Arrays of each group of faces that share their (roughness, metallic), and these."""
    rounded = np.round(shine[faces].mean(axis=1) * LEVELS) / LEVELS
    groups, group = np.unique(rounded, axis=0, return_inverse=True)
    for i, (roughness, metallic) in enumerate(groups):
        used, index = np.unique(faces[group.ravel() == i], return_inverse=True)
        arrays = {
            "POSITION": vertices[used].astype(np.float32),
            "NORMAL": normals[used].astype(np.float32),
            "COLOR_0": color[used].astype(np.float32),
            "indices": index.astype(np.uint32).ravel(),
        }
        yield arrays, (float(roughness), float(metallic))


def glb(primitives: list[tuple[dict[str, np.ndarray], tuple[float, float]]], translation: np.ndarray) -> bytes:
    """A binary glTF 2.0 file of one mesh; vertex colours are linear, as glTF has them."""
    views: list[dict] = []
    accessors: list[dict] = []
    materials: list[dict] = []
    entries: list[dict] = []
    chunks: list[bytes] = []
    size = 0
    for arrays, (roughness, metallic) in primitives:
        places = {}
        for name, array in arrays.items():
            is_index = name == "indices"
            data = np.ascontiguousarray(array).tobytes()
            target = INDEX_BUFFER if is_index else ARRAY_BUFFER
            views.append({"buffer": 0, "byteOffset": size, "byteLength": len(data), "target": target})
            accessor = {
                "bufferView": len(views) - 1,
                "componentType": UNSIGNED if is_index else FLOAT,
                "count": len(array),
                "type": KINDS[array.size // len(array)],
            }
            if name == "POSITION":
                accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
            places[name] = len(accessors)
            accessors.append(accessor)
            chunks.append(data)
            size += len(data)
        factors = {"baseColorFactor": [1, 1, 1, 1], "roughnessFactor": roughness, "metallicFactor": metallic}
        entries.append({"indices": places.pop("indices"), "attributes": places, "material": len(materials)})
        materials.append({"pbrMetallicRoughness": factors})
    node = {"mesh": 0} | ({"translation": translation.tolist()} if translation.any() else {})
    document = {
        "asset": {"version": "2.0", "generator": "spnr_jax"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": entries}],
        "materials": materials,
        "accessors": accessors,
        "bufferViews": views,
    }
    return packed(document, b"".join(chunks))
