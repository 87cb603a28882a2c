"""Losses and metrics of any images, against their float64 twins; gradients are finite and float64's."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import structural_similarity
from support import reference
from support.laws import TINY, close, extremes, float64_law, hypotheses

from spnr_jax.kernels import losses, metrics

SEEDS = st.integers(0, 999)
FINITE = 1e30, 1e30  # floors under which gradients only have to be finite


class TestLosses:
    @hypotheses
    @given(extremes(2, 4, 3), extremes(2, 4, 3))
    def test_l1_of_any_images(self, image, other):
        expected = np.abs(np.float64(image) - np.float64(other)).mean()
        close(float64_law(losses.l1, image, other), expected, rtol=1e-6, atol=TINY)

    @hypotheses
    @given(extremes(2, 5), extremes(2, 5))
    def test_adversarial_losses_of_any_logits(self, real, fake):
        generator, discriminator = float64_law(adversarial, real, fake)
        expected = reference.softplus(-fake).mean(), (reference.softplus(-real) + reference.softplus(fake)).mean()
        close((generator, discriminator), expected, rtol=1e-6, atol=TINY)

    @hypotheses
    @given(extremes(2, 4, 4, 3, low=-15, high=17))
    def test_the_penalty_of_any_image(self, image):
        expected = 2 * (np.float64(image) ** 2).sum((1, 2, 3)).mean()
        close(float64_law(penalty, image), expected, rtol=1e-5, atol=TINY)

    @hypotheses
    @given(extremes(5, 7, 3))
    def test_cells_of_any_image(self, image):
        small = float64_law(cells, image)
        close(small, reference.area_downsample(image, 3), rtol=1e-5, atol=1e-6 * np.abs(image).max() + TINY)


def adversarial(real, fake):
    return losses.generator_adversarial(fake), losses.discriminator_adversarial(real, fake)


def penalty(image):
    return losses.r1(lambda x: jnp.sum(x**2, axis=(1, 2, 3)), image)


def cells(image):
    return losses.area_downsample(image, 3)


class TestMetrics:
    @hypotheses
    @given(
        extremes(12, 12, 3, high=0, signed=False),
        extremes(12, 12, 3, high=0),
        st.integers(0, 999),
        st.sampled_from([0, 0.1, 1]),
    )
    def test_quality_of_any_image(self, other, difference, seed, share):
        image = np.clip(other + difference, 0, 1)
        mask = np.random.default_rng(seed).random((12, 12)) < share
        whole, visible, structure = float64_law(quality, image, other, np.float32(mask), floors=FINITE)
        squared = (np.float64(image) - other) ** 2
        assert whole == pytest.approx(decibel(squared.mean()), abs=1e-3)
        if mask.any():
            assert visible == pytest.approx(decibel(squared[mask].mean()), abs=1e-3)
        # where both images are bright and flat, float32 leaves three digits of their variances
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        expected = structural_similarity(np.float64(other), np.float64(image), data_range=1, channel_axis=-1, **options)
        assert structure == pytest.approx(expected, abs=1e-3)


def quality(image, other, mask):
    visible = metrics.conditional_psnr(image, other, mask > 0.5)
    return metrics.psnr(image, other), jnp.where(jnp.isnan(visible), 0, visible), metrics.ssim(image, other)


def decibel(mean_squared_error):
    return min(metrics.PSNR_CAP, -10 * np.log10(max(mean_squared_error, 1e-30)))
