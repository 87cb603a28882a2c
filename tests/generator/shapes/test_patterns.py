"""Laws of the textures made in code and of the finishes that use them: they tile, and stay in range."""

import numpy as np
import pytest

from data_gen.shapes import finishes, patterns

TILES = ("wood", "weave", "stripes", "checks", "dots", "chevrons", "marble", "speckles", "leather", "brushed", "tiles")
FAMILIES = ("wood", "paint", "plastic", "metal", "fabric", "leather", "stone", "print_", "rattan", "car_paint", "glass")
FAMILIES += ("rubber", "glow", "canvas")


@pytest.mark.parametrize("name", TILES)
def test_patterns_stay_in_range_are_not_flat_and_join_their_own_other_edge(name):
    for seed in range(6):
        picture = getattr(patterns, name)(np.random.default_rng(seed)) + np.zeros((patterns.SIZE, patterns.SIZE))
        assert picture.min() >= 0
        assert picture.max() <= 1
        assert np.ptp(picture) > 0.2
        for axis in (0, 1):
            inside = np.abs(np.diff(picture, axis=axis)).mean(axis=1 - axis)
            seam = np.abs(np.take(picture, 0, axis) - np.take(picture, -1, axis)).mean()
            assert seam <= inside.max() * 1.25 + 1e-9, "no worse than neighbouring lines inside"


@pytest.mark.parametrize("name", FAMILIES)
def test_finishes_are_float32_of_real_albedo_and_the_same_for_the_same_seed(name):
    for seed in range(8):
        first, again = (getattr(finishes, name)(np.random.default_rng(seed)).material for _ in range(2))
        for channel in ("base_color", "roughness", "metallic"):
            value = getattr(first, channel)
            assert value.dtype == np.float32
            assert value.tobytes() == getattr(again, channel).tobytes()
        assert 0.015 < first.base_color.min() <= first.base_color.max() < 0.96
        assert 0.045 < first.roughness.min() <= first.roughness.max() <= 1
        assert 0 <= first.metallic.min() <= first.metallic.max() <= 1
        assert first.metallic.max() == 0 or name not in ("wood", "fabric", "stone", "plastic", "glass")
        assert first.metallic.min() == 1 or name != "metal"


def test_colours_cover_every_hue_and_dark_and_light():
    colors = np.array([finishes.color(np.random.default_rng(seed)) for seed in range(600)])
    strongest = colors.argmax(axis=1)[np.ptp(colors, axis=1) > 0.3]
    assert np.bincount(strongest, minlength=3).min() > 30
    luminance = colors @ (0.2126, 0.7152, 0.0722)
    assert (luminance < 0.08).mean() > 0.1
    assert (luminance > 0.5).mean() > 0.1


def test_linear_and_hsv_agree_with_the_srgb_definition():
    np.testing.assert_allclose(finishes.linear([0.0, 0.04, 0.5, 1.0]), [0, 0.04 / 12.92, 0.21404114, 1], rtol=1e-6)
    np.testing.assert_allclose(finishes.hsv(1 / 3, 1, 0.5), [0.02, 0.21404114, 0.02], rtol=1e-6)
    np.testing.assert_allclose(finishes.hsv(0.7, 0, 0.5), 0.21404114, rtol=1e-6)
