"""Scores of pictures at the size that people look at, of pictures that are known."""

import numpy as np

from spnr_jax.scoring.picture_scores import under_true_opacity


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
