"""2D upsampler: feature image to an image of twice the size; it learns what to add to the bilinear RGB."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.numerics import per_feature
from spnr_jax.kernels.resizing import bilinear
from spnr_jax.nn.convolution import conv, kernel_init, upsample_conv

SLOPE = 0.2


class Upsampler(nn.Module):
    """Two convolutions at the low resolution, nearest x2, two at the high one; the last starts at zero."""

    width: int
    bf16: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "batch height width features"]) -> Float[Array, "batch 2*height 2*width 3"]:
        """Image of twice the size; the first three features are RGB."""
        y = x
        for i, features in enumerate((self.width, self.width, self.width // 2, 3)):
            init = nn.initializers.zeros if i == 3 else kernel_init
            kernel = self.param(f"kernel_{i}", init, (3, 3, y.shape[-1], features))
            y = upsample_conv(y, kernel, self.bf16) if i == 2 else conv(y, kernel, bf16=self.bf16)
            y = y + per_feature(self.param(f"bias_{i}", nn.initializers.zeros, (features,)), y)
            y = y if i == 3 else nn.leaky_relu(y, SLOPE)
        return y + bilinear(jnp.asarray(x[..., :3]), 2 * x.shape[1], 2 * x.shape[2])
