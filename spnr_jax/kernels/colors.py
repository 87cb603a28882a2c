"""The sRGB transfer function (IEC 61966-2-1) and its inverse, for values of any shape.

Materials and light are linear, images are sRGB, and so is the mixture of object and background in a pixel.  Both
functions are a line near 0 and a power above; the power sees a harmless input where the line is taken, so values and
gradients are finite at 0 and below.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.numerics import clamp

LINEAR_LIMIT, ENCODED_LIMIT = 0.0031308, 0.04045  # where line and power meet
SLOPE, SCALE, OFFSET, EXPONENT = 12.92, 1.055, 0.055, 2.4
LEAST_OPACITY = 1e-6  # below it a pixel shows the background, whatever its colour


def linear_to_srgb(linear: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """sRGB values of linear ones: [0, 1] onto [0, 1]; nothing is clipped."""
    power = linear > LINEAR_LIMIT
    encoded = SCALE * jnp.where(power, linear, 1.0) ** (1 / EXPONENT) - OFFSET
    return jnp.where(power, encoded, SLOPE * linear)


def srgb_to_linear(encoded: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Linear values of sRGB ones: [0, 1] onto [0, 1]; nothing is clipped."""
    power = encoded > ENCODED_LIMIT
    linear = ((jnp.where(power, encoded, 1.0) + OFFSET) / SCALE) ** EXPONENT
    return jnp.where(power, linear, encoded / SLOPE)


def over(
    light: Float[Array, "*batch channels"], opacity: Float[Array, "*batch 1"], background: float
) -> Float[Array, "*batch channels"]:
    """sRGB of an object on a background (sRGB), from its opacity and its linear light, weighted by that opacity."""
    return opacity * linear_to_srgb(unweighted(light, opacity)) + (1 - opacity) * background


def unweighted(
    color: Float[Array, "*batch channels"], opacity: Float[Array, "*batch 1"]
) -> Float[Array, "*batch channels"]:
    """The colour in [0, 1] of what has this opacity, from the colour weighted by it."""
    return clamp(color / jnp.maximum(opacity, LEAST_OPACITY), 0.0, 1.0)
