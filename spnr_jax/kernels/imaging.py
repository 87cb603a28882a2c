"""Images as arrays: the sRGB curve (IEC 61966-2-1), and resizing, bilinear or by averaging squares of pixels.

Materials and light are linear.  Images are sRGB, and object and background are mixed in sRGB.  The curve and its
inverse are a line near 0 and a power above.  Where the line is used, the power gets a harmless input, so values and
gradients are finite at 0 and below.
"""

import dataclasses
from functools import partial, reduce
from operator import add
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.kernels.numerics import array_namespace
from spnr_jax.kernels.records import Rendering

WHITE = 1.0  # background of every picture

# --- colours ----------------------------------------------------------------------------------------------------------


Values = TypeVar("Values", jax.Array, np.ndarray)  # floats of any shape
LINEAR_LIMIT, ENCODED_LIMIT = 0.0031308, 0.04045  # where line and power meet
SLOPE, SCALE, OFFSET, EXPONENT = 12.92, 1.055, 0.055, 2.4


def linear_to_srgb(linear: Values) -> Values:
    """sRGB values of linear ones (IEC 61966-2-1): [0, 1] onto [0, 1]; nothing is clipped."""
    xp, power = array_namespace(linear), linear > LINEAR_LIMIT
    encoded = SCALE * xp.where(power, linear, 1) ** (1 / EXPONENT) - OFFSET
    return xp.where(power, encoded, SLOPE * linear)


def srgb_to_linear(encoded: Values) -> Values:
    """Linear values of sRGB ones (IEC 61966-2-1): [0, 1] onto [0, 1]; nothing is clipped."""
    xp, power = array_namespace(encoded), encoded > ENCODED_LIMIT
    linear = ((xp.where(power, encoded, 1) + OFFSET) / SCALE) ** EXPONENT
    return xp.where(power, linear, encoded / SLOPE)


# --- sizes ------------------------------------------------------------------------------------------------------------


def resize_bilinear(
    x: Float[Array, "batch height width features"], height: int, width: int
) -> Float[Array, "batch h w features"]:
    """Image resized with half-pixel centres (not aligned at the corners)."""
    return jax.image.resize(x, (x.shape[0], height, width, x.shape[-1]), "bilinear", antialias=False)


def double_size(x: Float[Array, "batch height width features"]) -> Float[Array, "batch h w features"]:
    """Twice the size, bilinear; the border repeats."""
    for axis in (1, 2):
        size, part = x.shape[axis], partial(jax.lax.slice_in_dim, x, axis=axis)
        before = jnp.concatenate([part(0, 1), part(0, size - 1)], axis)
        after = jnp.concatenate([part(1, size), part(size - 1, size)], axis)
        pair = jnp.stack([0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after], axis + 1)
        x = pair.reshape(*x.shape[:axis], 2 * size, *x.shape[axis + 1 :])
    return x


NOTCH = np.array([-1, 8, -28, 56, 186, 56, -28, 8, -1]) / 256  # weights; 1 - sin(w / 2)^8 of a frequency w is kept


def remove_checkerboard(x: Float[Array, "batch height width features"]) -> Float[Array, "batch height width features"]:
    """Without what alternates from pixel to pixel along either axis (Odena et al. 2016); the border repeats."""
    rows = x.reshape(*x.shape[:2], -1)  # a CPU adds long rows faster
    for axis, step in (1, 1), (2, x.shape[-1]):
        size, part = rows.shape[axis], partial(jax.lax.slice_in_dim, axis=axis)
        first, last = ([part(rows, *border)] * (len(NOTCH) // 2) for border in ((0, step), (size - step, size)))
        wide = jax.lax.optimization_barrier(jnp.concatenate([*first, rows, *last], axis))
        shifted = (part(wide, i * step, i * step + size) for i in range(len(NOTCH)))
        rows = reduce(add, (float(weight) * one for weight, one in zip(NOTCH, shifted, strict=True)))
    return rows.reshape(x.shape)


def average_pool(x: Float[Array, "*batch height width features"], side: int) -> Float[Array, "*batch h w features"]:
    """The mean over each square of side x side pixels."""
    *batch, height, width, features = x.shape
    return jnp.mean(x.reshape(*batch, height // side, side, width // side, side, features), axis=(-4, -2))


def depth_to_space(x: Float[Array, "*batch h w folded"], side: int) -> Float[Array, "*batch height width features"]:
    """Rearranges the features of each pixel to a square of side x side pixels (depth to space)."""
    *batch, height, width, features = x.shape
    x = jnp.swapaxes(x.reshape(*batch, height, width, side, side, features // side**2), -4, -3)
    return x.reshape(*batch, side * height, side * width, features // side**2)


def enlarge(rendering: Rendering, height: int, width: int) -> Rendering:
    """The rendering at a larger size: colours by cubic interpolation, depth and opacity by linear interpolation."""
    color = jnp.clip(jax.image.resize(rendering.image, (height, width, 3), "cubic"), 0, 1)
    depth, acc = (jax.image.resize(x, (height, width), "linear") for x in (rendering.depth, rendering.acc))
    return dataclasses.replace(rendering, image=color, depth=depth, acc=acc)
