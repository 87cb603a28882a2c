"""What Draco, meshopt and Basis Universal packed is read as it was before; damaged and boasting data is refused."""

import sys

import numpy as np
import pytest
from support.gltf_files import CORNERS, SQUARE, UV, GltfBuilder
from support.packed_meshes import ETC1S_ALPHA, MESHOPT, UASTC

from spnr_jax.formats.columns import srgb_to_linear
from spnr_jax.formats.mesh import gltf_materials
from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.gltf_container import DRACO, unpack
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.texels import KTX2_PACKAGE, read_image

ROUNDED = {"directions in 8 bytes": "<i2"}  # the only one in which the last bit is a matter of rounding
COLORS = np.array([[255, 0, 51], [255, 0, 51], [0, 255, 0], [0, 0, 255]], np.uint8)
BASIS = "KHR_texture_basisu"
READ = {name: case for name, case in MESHOPT.items() if case["filter"] != "COLOR"}


@pytest.mark.parametrize("name", READ)
def test_meshopt_data_is_what_its_encoders_decoder_says_and_cut_anywhere_it_is_refused(name):
    case = MESHOPT[name]
    found = unpack(memoryview(case["packed"]), case)
    if name in ROUNDED:
        theirs, ours = (np.frombuffer(data, ROUNDED[name]).astype(int) for data in (case["plain"], found))
        np.testing.assert_allclose(ours, theirs, atol=1)
    else:
        assert found == case["plain"]
    for length in {*range(0, len(case["packed"]), 7), len(case["packed"]) - 1}:
        with pytest.raises(RejectedAsset):
            unpack(memoryview(case["packed"][:length]), case)


def test_meshopt_counts_widths_formats_and_filters_that_cannot_be_are_refused():
    for name in ("colours, format 0", "colours, format 1", "a grid", "a grid as a sequence"):
        for count in (MESHOPT[name]["count"] * 2**6, 3 * 2**28, -3):  # before room is made for them
            with pytest.raises(RejectedAsset):
                unpack(memoryview(MESHOPT[name]["packed"]), MESHOPT[name] | {"count": count})
    case = MESHOPT["noise, format 0"]
    changes = [{"byteStride": stride} for stride in (0, 3, 6, 260)] + [{"packed": b"\xa7" + case["packed"][1:]}]
    for change in (*changes, *({"filter": kind} for kind in ("SEPIA", "QUATERNION", "COLOR"))):
        with pytest.raises(RejectedAsset, match="broken|cannot be read"):
            unpack(memoryview((case | change)["packed"]), case | change)


def test_a_file_whose_buffers_meshopt_packed_is_read(tmp_path):
    case, builder = MESHOPT["two blocks of steps, format 1"], GltfBuilder()
    builder.document["extensionsRequired"] = ["KHR_meshopt_compression"]
    described = {key: case[key] for key in ("count", "byteStride", "mode", "filter")}
    views = builder.document["bufferViews"]
    extension = {"KHR_meshopt_compression": views[builder.view(case["packed"])] | described}
    views[-1] = {"buffer": 1, "byteLength": 2400, "byteStride": 8, "extensions": extension}
    builder.document["accessors"] = [{"bufferView": 0, "count": 300, "type": "VEC3", "componentType": 5123}]
    builder.mesh({"attributes": {"POSITION": 0}})
    fallback = {"byteLength": 2400, "extensions": {"KHR_meshopt_compression": {"fallback": True}}}
    for name, content in builder.files("a.gltf", fallback).items():
        (tmp_path / name).write_bytes(content)
    positions = np.frombuffer(case["plain"], "<u2").reshape(300, 4)[:, :3]
    (part,) = load_mesh(tmp_path / "a.gltf").parts
    assert {tuple(point) for point in part.positions} <= {tuple(map(float, point)) for point in positions}


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


def test_positions_faces_and_normalised_colours_come_out_of_a_draco_mesh(tmp_path):
    (part,) = load_mesh(packed_square().write(tmp_path / "packed.glb")).parts
    expected = CORNERS + [1, 0, 0]
    order, at = np.lexsort(part.positions.T), np.lexsort(expected.T)
    np.testing.assert_allclose(part.positions[order], expected[at], atol=1e-4)
    np.testing.assert_allclose(part.colors[order], COLORS[at] / 255)
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a), [[0, 0, 1]] * 2, atol=1e-3)


def test_a_draco_mesh_that_lacks_something_or_is_cut_anywhere_is_refused_in_one_line(tmp_path):
    lacking = [{"attributes": {"POSITION": 77}}, {"attributes": {}}, {"bufferView": 99}]
    builders = [packed_square(**extension) for extension in lacking]
    for length in range(0, builders[0].document["bufferViews"][0]["byteLength"], 5):
        builders.append(packed_square())
        builders[-1].document["bufferViews"][0]["byteLength"] = length
    words = "has no POSITION in its Draco mesh|broken or truncated|Draco mesh that is broken or cut off"
    for builder in builders:
        with pytest.raises(RejectedAsset, match=words) as caught:
            load_mesh(builder.write(tmp_path / "bad.glb"))
        assert "\n" not in str(caught.value)


def basis_textured(tmp_path, fallback):
    builder = GltfBuilder(extensionsUsed=[BASIS])
    texture = builder.texture(np.full((2, 2, 3), 128)) if fallback else builder.texture(uri="gone.png")
    if not fallback:
        del builder.document["textures"][texture]["source"]
    builder.document["images"].append({"bufferView": builder.view(UASTC), "mimeType": "image/ktx2"})
    source = len(builder.document["images"]) - 1
    builder.document["textures"][texture]["extensions"] = {BASIS: {"source": source}}
    material = builder.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
    builder.mesh(builder.primitive(material=material, TEXCOORD_0=UV))
    return builder.write(tmp_path / "basis.glb")


@pytest.mark.parametrize(("data", "corner"), [(UASTC, 255), (ETC1S_ALPHA, 0)])
def test_both_codecs_of_ktx2_give_the_texels_back_the_right_way_up_and_damaged_ones_are_refused(data, corner):
    pytest.importorskip(KTX2_PACKAGE)
    quarters = read_image(data, "a.ktx2")[1::4, 1::4].astype(int)
    expected = [[[255, 0, 0, 255], [0, 255, 0, 255]], [[0, 0, 255, 255], [200, 200, 200, corner]]]
    np.testing.assert_allclose(quarters, expected, atol=3)
    for length in (12, 40, 100, len(data) - 1):
        with pytest.raises(RejectedAsset, match="cannot be read: a.ktx2"):
            read_image(data[:length], "a.ktx2")


def test_a_ktx2_image_goes_before_its_fallback_which_is_taken_without_the_package(tmp_path, monkeypatch):
    pytest.importorskip(KTX2_PACKAGE)
    path = basis_textured(tmp_path, fallback=True)
    color = load_mesh(path).parts[0].material.base_color
    np.testing.assert_allclose(color[6, 6], srgb_to_linear(np.full(3, 200 / 255)), atol=0.02)
    monkeypatch.setattr(gltf_materials, "find_spec", lambda name: None)
    color = load_mesh(path).parts[0].material.base_color
    np.testing.assert_allclose(color, srgb_to_linear(np.full((2, 2, 3), 128 / 255)), atol=1e-6)


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    draco, basis = packed_square().write(tmp_path / "a.glb"), basis_textured(tmp_path, fallback=False)
    reads = {"DracoPy": lambda: load_mesh(draco), KTX2_PACKAGE: lambda: load_mesh(basis)}
    reads["meshoptimizer"] = lambda: unpack(memoryview(b""), MESHOPT["a grid"])
    for package, read in reads.items():
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(RejectedAsset, match=rf"needs the package {package} .* 'spnr-jax\[meshes\]'"):
            read()
