"""Conditional PatchGAN: judges patches of an image beside the true colours at the visible input points [paper]."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from spnr_jax.kernels.numerics import per_feature
from spnr_jax.nn.convolution import conv, kernel_init
from spnr_jax.nn.normalization import GroupNorm

SLOPE = 0.2


class Discriminator(nn.Module):
    """4x4 convolutions, three of stride 2 and two of stride 1; GroupNorm on all but the first and the last."""

    width: int
    num_groups: int
    bf16: bool = False

    @nn.compact
    def __call__(
        self,
        image: Float[Array, "batch height width 3"],
        condition: Float[Array, "batch height width 3"],
        condition_mask: Bool[Array, "batch height width"],
    ) -> Float[Array, "batch rows columns 1"]:
        """Logit of each patch: positive for what looks like a reference image."""
        x = jnp.concatenate([image, condition, condition_mask[..., None].astype(image.dtype)], axis=-1)
        widths = [self.width * 2**i for i in range(4)]
        for i, features in enumerate([*widths, 1]):
            kernel = self.param(f"kernel_{i}", kernel_init, (4, 4, x.shape[-1], features))
            x = conv(x, kernel, stride=2 if i < 3 else 1, bf16=self.bf16)
            if i in (0, 4):
                x = x + per_feature(self.param(f"bias_{i}", nn.initializers.zeros, (features,)), x)
            else:
                x = GroupNorm(self.num_groups, name=f"norm_{i}")(x)
            if i < 4:
                x = nn.leaky_relu(x, SLOPE)
        return x
