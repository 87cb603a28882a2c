"""Texels: the lookup is the renderer's, large images are averaged, not picked."""

import io

import numpy as np
import pytest
from PIL import Image
from support.gltf_files import png

from data_gen.render.variant import mitsuba_module
from spnr_jax.formats.mesh import texels
from spnr_jax.formats.mesh.texels import lookup, read_image, shrink, value_texels

MODES = ("repeat", "mirror", "clamp")


@pytest.fixture
def mi():
    """Mitsuba in its scalar variant, which other tests do not depend on."""
    mitsuba = pytest.importorskip("mitsuba")
    before = mitsuba.variant()
    yield mitsuba_module("scalar_rgb")  # on one thread, which whoever renders next relies on
    if before:
        mitsuba_module(before)


@pytest.mark.parametrize("wrap", MODES)
@pytest.mark.parametrize("shape", [(5, 3, 3), (4, 7), (1, 1, 3), (1, 6)])
def test_lookup_is_what_mitsuba_evaluates(mi, wrap, shape):
    rng = np.random.default_rng(3)
    texels = rng.random(shape, dtype=np.float32)
    texcoords = rng.uniform(-2.5, 3.5, (200, 2)).astype(np.float32)
    bitmap = mi.Bitmap(texels if len(shape) == 3 else texels[..., None])
    texture = mi.load_dict(
        {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": wrap}
    )
    hit = mi.SurfaceInteraction3f()
    expected = []
    for u, v in texcoords.tolist():
        hit.uv = mi.Point2f(u, v)
        expected.append(np.array(texture.eval(hit)) if len(shape) == 3 else texture.eval_1(hit))
    np.testing.assert_allclose(lookup(texels, texcoords, wrap), expected, atol=2e-5)


def test_shrinking_by_a_whole_factor_takes_the_mean_of_each_block():
    texels = np.random.default_rng(0).random((2048, 6, 3), dtype=np.float32)
    expected = texels.reshape(1024, 2, 3, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(shrink(texels), expected, atol=1e-6)


def test_sixteen_bit_grey_images_are_scaled_not_clipped():
    stream = png(np.zeros((1, 1, 3)))
    assert read_image(stream, "black").tolist() == [[[0, 0, 0, 255]]]
    stream = io.BytesIO()
    Image.fromarray(np.array([[0, 32896, 65535]], np.uint16)).save(stream, "png")
    assert value_texels(read_image(stream.getvalue(), "grey")[..., 1]).tolist() == [[0, np.float32(128 / 255), 1]]


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "LA", "1"])
def test_an_image_read_in_strips_is_the_whole_converted(mode, monkeypatch):
    monkeypatch.setattr(texels, "STRIP", 4)
    pixels = np.random.default_rng(0).integers(0, 256, (9, 7, 4), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(stream, "png", **({"transparency": 3} if mode == "P" else {}))
    whole = np.asarray(Image.open(io.BytesIO(stream.getvalue())).convert("RGBA"))
    np.testing.assert_array_equal(read_image(stream.getvalue(), "a.png"), whole)
