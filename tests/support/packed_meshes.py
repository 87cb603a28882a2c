"""Meshes that other encoders packed: meshoptimizer 1.3 (npm), and Draco.

MESHOPT    name -> packed, mode, count, byteStride, filter as in the glTF extension; `plain` is what meshoptimizer's own
           decoder makes of it
"""

import base64
import json
from pathlib import Path

import numpy as np
import pytest

from support.gltf_files import CORNERS, SQUARE, GltfBuilder

MESHOPT = {
    name: case | {key: base64.b64decode(case[key]) for key in ("packed", "plain")}
    for name, case in json.loads(Path(__file__).with_name("meshopt_packed.json").read_text()).items()
}
COLORS = np.array([[255, 0, 51], [255, 0, 51], [0, 255, 0], [0, 0, 255]], np.uint8)


def draco_square(**extension) -> GltfBuilder:
    """A square with colours whose columns and faces lie in a Draco mesh alone."""
    draco = pytest.importorskip("DracoPy")
    data = draco.encode(CORNERS, SQUARE.reshape(2, 3), quantization_bits=14, preserve_order=True, colors=COLORS)
    ids = {entry["attribute_type"]: entry["unique_id"] for entry in draco.decode(data).attributes}
    name = "KHR_draco_mesh_compression"
    builder = GltfBuilder(extensionsRequired=[name])
    view, accessors = builder.view(data), builder.document["accessors"]
    accessors += [
        {"componentType": 5126, "count": 4, "type": "VEC3"},
        {"componentType": 5121, "count": 4, "type": "VEC3", "normalized": True},
        {"componentType": 5123, "count": 6, "type": "SCALAR"},
    ]
    packed = {"bufferView": view, "attributes": {"POSITION": ids[0], "COLOR_0": ids[2]}} | extension
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "extensions": {name: packed}}
    builder.mesh(primitive, translation=[1, 0, 0])
    return builder


def meshopt_files() -> dict[str, bytes]:
    """A .gltf of 40 triangles between 300 places, both packed, and its buffer."""
    name = "KHR_meshopt_compression"
    builder = GltfBuilder(extensionsRequired=[name])
    views = builder.document["bufferViews"]
    for case in (MESHOPT["two blocks of steps, format 1"], MESHOPT["a grid"]):
        described = {key: case[key] for key in ("count", "byteStride", "mode", "filter")}
        extensions = {name: views[builder.view(case["packed"])] | described}
        views[-1] = {"buffer": 1, "byteLength": case["count"] * case["byteStride"], "extensions": extensions}
    views[0]["byteStride"] = 8
    builder.document["accessors"] = [
        {"bufferView": 0, "count": 300, "type": "VEC3", "componentType": 5123},
        {"bufferView": 1, "count": 120, "type": "SCALAR", "componentType": 5125},
    ]
    builder.mesh({"attributes": {"POSITION": 0}, "indices": 1})
    return builder.files("mesh.gltf", {"byteLength": 4000, "extensions": {name: {"fallback": True}}})
