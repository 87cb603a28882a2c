"""LPIPS: distance of two pictures in the features of a network that learnt to see (Zhang et al. 2018), 0 the same.

Version 0.1 with AlexNet.  The features after each of the five ReLUs are normalised to unit length at every place; their
squared differences are weighted by channel with heads fitted to human judgement, averaged over places, and summed.
Weights are data: `lpips_weights` reads and converts them.  Images are RGB in [0, 1] like everywhere here,
(*batch, height, width, 3); the network sees them on [-1, 1].
"""

from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from spnr_jax.errors import UserError
from spnr_jax.kernels.records import AnyArray

# of each convolution: channels, window, stride, padding; a 3 x 3 max-pooling of stride 2 stands before some
CHANNELS, WINDOWS, STRIDES, PADDINGS = (64, 192, 384, 256, 256), (11, 5, 3, 3, 3), (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
POOLED = (False, True, True, False, False)
SMALLEST = 31  # pixels of the smallest image that leaves one place after both poolings
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # normalisation of images on [-1, 1]
EPSILON = 1e-10  # added to the length of a feature


@no_type_check
@struct.dataclass
class LpipsWeights:
    """Five convolutions with biases, and how much each of their channels counts (not negative)."""

    kernels: tuple[Float[AnyArray, "window window channels_in channels"], ...]
    biases: tuple[Float[AnyArray, " channels"], ...]
    heads: tuple[Float[AnyArray, " channels"], ...]


def lpips(
    image: Float[Array, "*batch height width 3"],
    reference: Float[Array, "*batch height width 3"],
    weights: LpipsWeights,
) -> Float[Array, "*batch"]:
    """Distance of each pair of images; 0 with gradient 0 for identical ones."""
    *batch, height, width, _ = image.shape
    if min(height, width) < SMALLEST:
        raise UserError(f"lpips needs images of at least {SMALLEST} pixels, got {(height, width)}")
    pair = jnp.stack([image, reference]).reshape(-1, height, width, 3)
    total = jnp.zeros(batch, image.dtype)
    for layer, head in zip(features(pair, weights), weights.heads, strict=True):
        directions = normalised(layer).reshape(2, *batch, *layer.shape[1:])
        difference = (directions[0] - directions[1]) ** 2
        total += jnp.einsum("...hwc,c->...", difference, head, precision="highest") / (layer.shape[1] * layer.shape[2])
    return total


def features(images: Float[Array, "images height width 3"], weights: LpipsWeights) -> list[Array]:
    """Features (images, rows, columns, channels) after each ReLU of images in [0, 1]."""
    shift, scale = (np.asarray(x, np.float32).reshape(1, 1, 1, 3) for x in (SHIFT, SCALE))
    x = ((2 * images - 1) - shift) / scale
    found = []
    layers = zip(weights.kernels, weights.biases, STRIDES, PADDINGS, POOLED, strict=True)
    for kernel, bias, stride, padding, pooled in layers:
        if pooled:
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), "VALID")
        x = jax.lax.conv_general_dilated(
            x, jnp.asarray(kernel), (stride, stride), [(padding, padding)] * 2,
            dimension_numbers=("NHWC", "HWIO", "NHWC"), precision=jax.lax.Precision.HIGHEST,
        )  # fmt: skip
        x = jax.nn.relu(x + bias.reshape(1, 1, 1, -1))
        found.append(x)
    return found


def normalised(x: Float[Array, "*batch channels"]) -> Float[Array, "*batch channels"]:
    """Vectors over their length; 0 with gradient 0 where all channels are 0."""
    squared = jnp.sum(x**2, axis=-1, keepdims=True)
    return jnp.where(squared > 0, x / (jnp.sqrt(jnp.where(squared > 0, squared, 1)) + EPSILON), 0)
