"""KTX2 textures are read where the package for them is there; else their fallback, or a line that names the extra."""

import importlib.util
import sys

import numpy as np
import pytest
from support.gltf_files import UV, GltfBuilder
from support.packed_meshes import ETC1S_ALPHA, UASTC

from spnr_jax.formats.mesh import ktx2
from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.texels import read_image, srgb_to_linear

BASIS = "KHR_texture_basisu"
QUARTERS = [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [200, 200, 200]]]
needs_package = pytest.mark.skipif(importlib.util.find_spec(ktx2.PACKAGE) is None, reason="the extra is not there")


def textured(tmp_path, fallback):
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


@needs_package
@pytest.mark.parametrize(("data", "corner"), [(UASTC, 255), (ETC1S_ALPHA, 0)])
def test_both_codecs_give_the_texels_back_the_right_way_up(data, corner):
    texels = read_image(data, "a.ktx2")
    assert texels.shape == (8, 8, 4)
    for row in (0, 1):
        for column in (0, 1):
            middle = texels[4 * row + 1, 4 * column + 1].astype(int)
            np.testing.assert_allclose(middle[:3], QUARTERS[row][column], atol=3)
            assert middle[3] == (corner if row and column else 255)


@needs_package
def test_a_gltf_file_takes_the_ktx2_image_before_its_fallback(tmp_path):
    (part,) = load_mesh(textured(tmp_path, fallback=True)).parts
    np.testing.assert_allclose(part.material.base_color[6, 6], srgb_to_linear(np.full(3, 200 / 255)), atol=0.02)


@needs_package
def test_damaged_images_are_refused_with_one_line():
    for length in (12, 40, 100, len(UASTC) - 1):
        with pytest.raises(RejectedAsset, match="cannot be read: a.ktx2"):
            read_image(UASTC[:length], "a.ktx2")


def test_without_the_package_the_fallback_is_taken_or_the_extra_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, ktx2.PACKAGE, None)
    monkeypatch.setattr(ktx2, "available", lambda: False)
    (part,) = load_mesh(textured(tmp_path, fallback=True)).parts
    np.testing.assert_allclose(part.material.base_color, srgb_to_linear(np.full((2, 2, 3), 128 / 255)), atol=1e-6)
    with pytest.raises(RejectedAsset, match=r"needs the package opengl_basisu .* 'spnr-jax\[meshes\]'"):
        load_mesh(textured(tmp_path, fallback=False))
