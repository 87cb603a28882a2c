"""Image quality where it has no number; the rest is in the tables of laws."""

import jax.numpy as jnp

from spnr_jax.kernels.metrics import opacity_iou


def test_two_empty_pictures_agree():
    assert opacity_iou(jnp.zeros((2, 2)), jnp.zeros((2, 2))) == 1
