"""Image quality where it has no number; the rest is in the tables of laws."""

import jax.numpy as jnp
import numpy as np
from support.laws import numbers

from spnr_jax.kernels.metrics import high_frequency_ratio, opacity_iou


def test_two_empty_pictures_agree():
    assert opacity_iou(jnp.zeros((2, 2)), jnp.zeros((2, 2))) == 1


class TestHighFrequencyRatio:
    def test_a_smaller_share_of_nyquist_lets_slower_waves_count(self):
        wave = jnp.broadcast_to(jnp.cos(2 * jnp.pi * 5 * jnp.arange(32) / 32).reshape(32, 1, 1), (32, 32, 3))
        sharp = numbers(4, 32, 32, 3)
        low, high = (high_frequency_ratio(wave, sharp, share) for share in (0.25, 0.5))
        assert low > 100 * high

    def test_a_flat_reference_has_no_ratio(self):
        assert np.isnan(high_frequency_ratio(numbers(0, 16, 13, 3), jnp.full((16, 13, 3), 0.3)))
