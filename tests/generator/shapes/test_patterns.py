"""Laws of the textures made in code and of the finishes that use them: they tile, and stay in range."""

import numpy as np
import pytest

from data_gen.shapes import finishes, patterns

TILES = ("wood", "weave", "stripes", "checks", "dots", "chevrons", "marble", "speckles", "leather", "brushed", "tiles")


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


def test_colours_cover_every_hue_and_dark_and_light():
    colors = np.array([finishes.color(np.random.default_rng(seed)) for seed in range(600)])
    strongest = colors.argmax(axis=1)[np.ptp(colors, axis=1) > 0.3]
    assert np.bincount(strongest, minlength=3).min() > 30
    luminance = colors @ (0.2126, 0.7152, 0.0722)
    assert (luminance < 0.08).mean() > 0.1
    assert (luminance > 0.5).mean() > 0.1


def test_hsv_agrees_with_the_srgb_definition():
    np.testing.assert_allclose(finishes.hsv(1 / 3, 1, 0.5), [0.02, 0.21404114, 0.02], rtol=1e-6)
    np.testing.assert_allclose(finishes.hsv(0.7, 0, 0.5), 0.21404114, rtol=1e-6)
