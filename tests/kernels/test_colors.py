"""Colours: transfer functions that rise, opacity and its extremes; tests/laws has the twins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spnr_jax.kernels.imaging import linear_to_srgb, over, srgb_to_linear, unpremultiply


@pytest.mark.parametrize("transfer", [linear_to_srgb, srgb_to_linear])
def test_the_transfer_functions_rise_strictly_and_continuously(transfer):
    steps = np.diff(transfer(jnp.linspace(0.0, 0.1, 2001)))
    assert (steps > 0).all()
    assert steps.max() < 1e-3


BACKGROUND = 0.75


def test_an_object_is_encoded_and_then_laid_over_the_background_by_its_opacity():
    opacity, light = np.array([[1.0], [0.5], [0.25]]), np.array([[0.2, 0.0, 1.0]] * 3)
    encoded = linear_to_srgb(jnp.asarray(light))
    expected = opacity * encoded + (1 - opacity) * BACKGROUND
    np.testing.assert_allclose(
        over(jnp.asarray(opacity * light), jnp.asarray(opacity), BACKGROUND), expected, atol=1e-6
    )
    np.testing.assert_allclose(unpremultiply(jnp.asarray(opacity * light), jnp.asarray(opacity)), light, atol=1e-6)


@pytest.mark.parametrize("light", [0.0, 1e-30, 1e-7, 1e10])
@pytest.mark.parametrize("opacity", [0.0, 1e-30, 1e-7, 1.0])
def test_the_picture_and_its_gradients_are_finite_at_any_opacity_and_light(light, opacity):
    def picture(light, opacity):
        return over(light, opacity, BACKGROUND)[0]

    at = jnp.array([light]), jnp.array([opacity])
    assert 0 <= picture(*at) <= 1
    assert np.isfinite(jax.grad(picture, (0, 1))(*at)).all()
