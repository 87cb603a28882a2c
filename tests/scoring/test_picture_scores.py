"""FLIP is a number a picture, of any batch; LPIPS is asked for as its package wants it; colours without outlines."""

import contextlib
import sys
import types

import numpy as np
import pytest
from support.laws import close, numbers

from spnr_jax.scoring import picture_scores
from spnr_jax.scoring.picture_scores import flip, lpips, under_true_opacity

IMAGE = np.asarray(numbers(0, 2, 3, 40, 36, 3, low=0.0))
REFERENCE = np.clip(IMAGE + 0.3 * np.asarray(numbers(1, 2, 3, 40, 36, 3)), 0, 1)


@pytest.fixture
def package(monkeypatch):
    """Packages that stand in for `lpips` and `torch`: the distance is the mean of the absolute differences."""

    class Network:
        def eval(self):
            return self

        def __call__(self, shown, wanted):
            assert shown.shape == wanted.shape == (6, 3, 40, 36)
            assert shown.dtype == np.float32
            assert shown.min() < -0.9
            assert shown.max() > 0.9
            distance = np.abs(shown - wanted).mean(axis=(1, 2, 3), keepdims=True)
            return types.SimpleNamespace(numpy=lambda: distance)

    torch = types.SimpleNamespace(from_numpy=lambda values: values, no_grad=contextlib.nullcontext)
    found = types.SimpleNamespace(LPIPS=lambda net, verbose: Network())
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setitem(sys.modules, "lpips", found)
    picture_scores.lpips_network.cache_clear()
    yield found
    picture_scores.lpips_network.cache_clear()


def test_flip_is_a_number_a_picture_whatever_the_batch():
    found = flip(IMAGE, REFERENCE)
    assert found.shape == (2, 3)
    assert flip(IMAGE[1, 2], REFERENCE[1, 2]) == found[1, 2]
    assert ((found > 0.01) & (found < 1)).all()
    close(flip(REFERENCE, IMAGE), found, atol=1e-6)


def test_flip_of_equal_pictures_is_0_and_greys_differ_by_their_lightness_alone():
    black, white = np.zeros((20, 20, 3)), np.ones((20, 20, 3))
    assert flip(IMAGE[0, 0], IMAGE[0, 0]) == 0
    lab_green, lab_blue = (87.735, -86.183, 83.180), (32.297, 79.188, -107.860)  # published L*a*b* of sRGB, D65
    chroma = np.hypot(*(lab_green[0] * lab_green[i] - lab_blue[0] * lab_blue[i] for i in (1, 2))) / 100
    largest = (lab_green[0] - lab_blue[0] + chroma) ** 0.7
    assert flip(black, white) == pytest.approx(0.95 + 0.05 * (100**0.7 / largest - 0.4) / 0.6, abs=1e-4)


def test_lpips_sees_views_of_channels_first_from_minus_1_to_1_and_is_missing_without_its_package(package, monkeypatch):
    close(lpips(IMAGE, REFERENCE), 2 * np.abs(IMAGE - REFERENCE).mean(axis=(2, 3, 4)), atol=1e-6)
    assert lpips(IMAGE[..., :31, :, :], REFERENCE[..., :31, :, :]) is None, "too few pixels"

    def offline(net, verbose):
        raise OSError("no way to the weights")

    monkeypatch.setattr(package, "LPIPS", offline)
    for _ in ("without its weights", "without the package"):
        picture_scores.lpips_network.cache_clear()
        assert lpips(IMAGE, REFERENCE) is None
        monkeypatch.setitem(sys.modules, "lpips", None)


def test_colours_under_the_true_opacity_are_those_of_the_nearest_pixel_that_is_covered():
    reference = np.zeros((32, 32, 4), np.float32)
    reference[8:24, 8:24] = 0.2, 0.4, 0.6, 1
    white = reference[..., :3] * reference[..., 3:] + 1 - reference[..., 3:]
    found = under_true_opacity(white, reference[..., 3], reference)
    np.testing.assert_allclose(found, white, atol=1e-6)
    opacity = reference[..., 3].copy()
    opacity[12:16, 8:16] = 0.05  # a hole, and half of an outline that is missing
    torn = reference[..., :3] * opacity[..., None] + 1 - opacity[..., None]
    np.testing.assert_allclose(under_true_opacity(torn, opacity, reference), white, atol=1e-6)
    nothing = under_true_opacity(np.ones_like(white), np.zeros((32, 32), np.float32), reference)
    assert np.isfinite(nothing).all()
