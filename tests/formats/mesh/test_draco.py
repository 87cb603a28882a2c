"""glTF files whose meshes Draco packed are the files without; broken ones are refused with one line."""

import sys

import numpy as np
import pytest
from support.gltf_files import CORNERS, SQUARE, GltfBuilder

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.draco import DRACO
from spnr_jax.formats.mesh.meshes import load_mesh

COLORS = np.array([[255, 0, 51], [255, 0, 51], [0, 255, 0], [0, 0, 255]], np.uint8)


def packed_square(**extension) -> GltfBuilder:
    """A square with colours whose columns and faces lie in a Draco mesh alone."""
    draco = pytest.importorskip("DracoPy")
    data = draco.encode(CORNERS, SQUARE.reshape(2, 3), quantization_bits=14, preserve_order=True, colors=COLORS)
    ids = {entry["attribute_type"]: entry["unique_id"] for entry in draco.decode(data).attributes}
    builder = GltfBuilder(extensionsRequired=[DRACO])
    view, accessors = builder.view(data), builder.document["accessors"]
    accessors += [
        {"componentType": 5126, "count": 4, "type": "VEC3"},
        {"componentType": 5121, "count": 4, "type": "VEC3", "normalized": True},
        {"componentType": 5123, "count": 6, "type": "SCALAR"},
    ]
    packed = {"bufferView": view, "attributes": {"POSITION": ids[0], "COLOR_0": ids[2]}} | extension
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "extensions": {DRACO: packed}}
    builder.mesh(primitive, translation=[1, 0, 0])
    return builder


def test_positions_faces_and_normalised_colours_come_out_of_the_packed_mesh(tmp_path):
    (part,) = load_mesh(packed_square().write(tmp_path / "packed.glb")).parts
    order = np.lexsort(part.positions.T)
    expected = CORNERS + [1, 0, 0]
    at = np.lexsort(expected.T)
    np.testing.assert_allclose(part.positions[order], expected[at], atol=1e-4)
    np.testing.assert_allclose(part.colors[order], COLORS[at] / 255)
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a), [[0, 0, 1]] * 2, atol=1e-3)


@pytest.mark.parametrize(
    ("extension", "words"),
    [
        ({"attributes": {"POSITION": 77}}, "has no POSITION in its Draco mesh"),
        ({"attributes": {}}, "has no POSITION in its Draco mesh"),
        ({"bufferView": 99}, "broken or truncated"),
    ],
)
def test_packed_meshes_that_lack_something_are_refused(tmp_path, extension, words):
    with pytest.raises(RejectedAsset, match=words):
        load_mesh(packed_square(**extension).write(tmp_path / "bad.glb"))


def test_a_packed_mesh_cut_anywhere_is_refused_with_one_line(tmp_path):
    builder = packed_square()
    view = builder.document["bufferViews"][0]
    whole = view["byteLength"]
    for length in range(0, whole, 5):
        view["byteLength"] = length
        with pytest.raises(RejectedAsset, match="Draco mesh that is broken or cut off") as caught:
            load_mesh(builder.write(tmp_path / "cut.glb"))
        assert "\n" not in str(caught.value)


def test_without_the_package_the_line_names_the_extra(tmp_path, monkeypatch):
    path = packed_square().write(tmp_path / "packed.glb")
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(RejectedAsset, match=r"needs the package DracoPy .* 'spnr-jax\[meshes\]'"):
        load_mesh(path)
