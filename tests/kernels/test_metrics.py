"""Image quality against scikit-image and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
from support.laws import close, numbers

from spnr_jax.kernels.metrics import PSNR_CAP, conditional_psnr, high_frequency_ratio, opacity_iou, psnr, ssim

IMAGE = numbers(0, 2, 3, 16, 13, 3, low=0.0)
REFERENCE = jnp.clip(IMAGE + 0.2 * numbers(1, 2, 3, 16, 13, 3), 0, 1)
MASK = numbers(2, 2, 3, 16, 13)


class TestPsnr:
    def test_identical_images_have_the_cap_with_a_finite_gradient(self):
        value, gradient = jax.value_and_grad(psnr)(IMAGE[0, 0], IMAGE[0, 0])
        assert value == PSNR_CAP
        assert jnp.isfinite(gradient).all()


class TestConditionalPsnr:
    def test_no_visible_pixel_is_nan_so_that_nobody_averages_it(self):
        mask = jnp.stack([jnp.zeros((16, 13), bool), jnp.ones((16, 13), bool)])
        measured = conditional_psnr(IMAGE[0, :2], REFERENCE[0, :2], mask)
        assert np.isnan(measured[0])
        assert np.isfinite(measured[1])


class TestSsim:
    def test_is_one_for_identical_and_flat_images_and_symmetric(self):
        measured = jax.jit(ssim)
        close(measured(IMAGE, IMAGE), np.ones((2, 3)))
        close(measured(jnp.ones_like(IMAGE), jnp.ones_like(IMAGE)), np.ones((2, 3)))
        close(measured(IMAGE, REFERENCE), measured(REFERENCE, IMAGE))


class TestOpacityIou:
    def test_two_empty_pictures_agree(self):
        assert opacity_iou(jnp.zeros((2, 2)), jnp.zeros((2, 2))) == 1


class TestHighFrequencyRatio:
    def test_a_smaller_share_of_nyquist_lets_slower_waves_count(self):
        wave = jnp.broadcast_to(jnp.cos(2 * jnp.pi * 5 * jnp.arange(32) / 32).reshape(32, 1, 1), (32, 32, 3))
        sharp = numbers(4, 32, 32, 3)
        low, high = (high_frequency_ratio(wave, sharp, share) for share in (0.25, 0.5))
        assert low > 100 * high

    def test_a_flat_reference_has_no_ratio(self):
        assert np.isnan(high_frequency_ratio(IMAGE[0, 0], jnp.full((16, 13, 3), 0.3)))
