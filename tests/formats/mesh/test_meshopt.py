"""What meshopt packed is read as meshoptimizer's own decoder reads it; damaged and boasting data is refused."""

import sys

import numpy as np
import pytest
from support.gltf_files import CORNERS, SQUARE, GltfBuilder
from support.packed_meshes import MESHOPT

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.meshopt import unpack

ROUNDED = {"directions in 8 bytes": "<i2"}  # the only one in which the last bit is a matter of rounding


@pytest.mark.parametrize("name", MESHOPT)
def test_every_packed_buffer_is_what_its_encoders_decoder_says(name):
    case = MESHOPT[name]
    found = unpack(memoryview(case["packed"]), case)
    if name in ROUNDED:
        theirs, ours = (np.frombuffer(data, ROUNDED[name]).astype(int) for data in (case["plain"], found))
        np.testing.assert_allclose(ours, theirs, atol=1)
    else:
        assert found == case["plain"]


@pytest.mark.parametrize(
    ("name", "dtype", "scale", "atol"),
    [
        ("directions in 8 bytes", "<i2", 32767, 2e-3),
        ("rotations", "<i2", 32767, 1e-3),
        ("colours in 8 bytes", "<u2", 65535, 1e-3),
        ("exponents", "<f4", 1, 1e-4),
    ],
)
def test_filters_give_the_floats_back_that_went_in(name, dtype, scale, atol):
    case = MESHOPT[name]
    meant = np.frombuffer(case["meant"], "<f4").reshape(-1, 4)
    found = np.frombuffer(unpack(memoryview(case["packed"]), case), dtype).reshape(-1, 4) / scale
    if name == "rotations":  # a quaternion and its negative are the same turn
        meant, found = (
            q * np.sign(q[np.arange(len(q)), np.abs(meant).argmax(axis=1)])[:, None] for q in (meant, found)
        )
    width = 3 if "directions" in name else 4
    np.testing.assert_allclose(found[:, :width], meant[:, :width], atol=atol)


@pytest.mark.parametrize("name", MESHOPT)
def test_data_cut_anywhere_is_refused(name):
    case = MESHOPT[name]
    for length in {*range(0, len(case["packed"]), 7), len(case["packed"]) - 1}:
        with pytest.raises(RejectedAsset):
            unpack(memoryview(case["packed"][:length]), case)


@pytest.mark.parametrize("name", ["colours, format 0", "colours, format 1", "a grid", "a grid as a sequence"])
def test_a_count_that_the_data_does_not_hold_is_refused_before_room_is_made_for_it(name):
    case = MESHOPT[name]
    for count in (case["count"] * 2**6, 3 * 2**28, -3):
        with pytest.raises(RejectedAsset):
            unpack(memoryview(case["packed"]), case | {"count": count})


def test_widths_formats_and_filters_that_there_are_not_are_refused():
    case = MESHOPT["noise, format 0"]
    packed = case["packed"]
    for stride in (0, 3, 6, 260):
        with pytest.raises(RejectedAsset, match="broken"):
            unpack(memoryview(packed), case | {"byteStride": stride})
    with pytest.raises(RejectedAsset, match="broken"):
        unpack(memoryview(b"\xa7" + packed[1:]), case)
    for kind in ("SEPIA", "QUATERNION"):
        with pytest.raises(RejectedAsset, match=f"filter '{kind}'"):
            unpack(memoryview(packed), case | {"filter": kind})


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "meshoptimizer", None)
    case = MESHOPT["a grid"]
    with pytest.raises(RejectedAsset, match=r"needs the package meshoptimizer .* 'spnr-jax\[meshes\]'"):
        unpack(memoryview(case["packed"]), case)


def plain_vertices(elements: np.ndarray) -> bytes:
    """Elements (n, stride) uint8 as meshopt packs what cannot be packed: every group of 16 in whole bytes."""
    count, stride = elements.shape
    assert count <= 16, "one group"
    difference = np.diff(elements.astype(np.int8), axis=0, prepend=elements[:1].astype(np.int8))
    zigzag = (difference << 1 ^ difference >> 7).astype(np.uint8)
    columns = np.zeros((stride, 16), np.uint8)
    columns[:, :count] = zigzag.T
    body = b"".join(b"\x03" + column.tobytes() for column in columns)
    return b"\xa0" + body + bytes(max(0, 32 - stride)) + elements[0].tobytes()


@pytest.mark.parametrize("extension", ["EXT_meshopt_compression", "KHR_meshopt_compression"])
def test_a_gltf_file_whose_buffers_are_packed_is_the_file_without(tmp_path, extension):
    builder = GltfBuilder(extensionsRequired=[extension])
    builder.mesh(builder.primitive())
    expected = load_mesh(builder.write(tmp_path / "plain.glb"))
    packed = builder.view(plain_vertices(CORNERS.view(np.uint8).reshape(4, 12)))
    views, position = builder.document["bufferViews"], builder.document["accessors"][0]["bufferView"]
    described = views[packed] | {"byteStride": 12, "count": 4, "mode": "ATTRIBUTES"}
    # the buffer that it stands for is not there, as gltfpack writes it
    views[position] = {"buffer": 1, "byteOffset": 0, "byteLength": 48, "extensions": {extension: described}}
    text = builder.write(tmp_path / "packed.gltf").read_text()
    fallback = f'"buffers": [{{"byteLength": 48, "extensions": {{"{extension}": {{"fallback": true}}}}}}, '
    text = text.replace('"buffers": [', fallback).replace('"buffer": 1', '"buffer": 9')
    text = text.replace('"buffer": 0', '"buffer": 1').replace('"buffer": 9', '"buffer": 0')
    (tmp_path / "packed.gltf").write_text(text)
    (part,) = load_mesh(tmp_path / "packed.gltf").parts
    np.testing.assert_array_equal(part.positions, expected.parts[0].positions)
    np.testing.assert_array_equal(part.faces, SQUARE.reshape(2, 3))
