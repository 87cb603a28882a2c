"""3D U-Net from scattered point features to a feature volume.

Each encoder stage halves the resolution and doubles the channels; skip connections are additions [paper].  A stage is a
stride-2 convolution and one at stride 1, a decoder stage nearest x2 and a convolution; each convolution is followed by
GroupNorm and ReLU.  No transposed convolution.  With bf16 the convolutions after the stem run in bfloat16; the stem's
scattered sums, normalisation and parameters stay float32.
"""

from typing import Literal

import flax.linen as nn
import jax
from jaxtyping import Array, Float, Int

from spnr_jax.kernels.voxels import scatter_conv
from spnr_jax.nn.convolution import conv, kernel_init, upsample_conv
from spnr_jax.nn.normalization import GroupNorm


class Stem(nn.Module):
    """First convolution, from the occupied voxels alone: the scattered grid is never built."""

    features: int
    resolution: int
    num_groups: int

    @nn.compact
    def __call__(
        self, rows: Int[Array, "objects points"], values: Float[Array, "objects points channels"]
    ) -> Float[Array, "objects d d d features"]:
        """Convolution of the volumes that `values` sum to at the flattened voxels `rows`."""
        kernel = self.param("kernel", kernel_init, (3, 3, 3, values.shape[-1], self.features))
        x = jax.vmap(lambda r, v: scatter_conv(r, v, kernel, self.resolution))(rows, values)
        return nn.relu(GroupNorm(self.num_groups, name="norm")(x))


class Block(nn.Module):
    """3^3 convolution, GroupNorm, ReLU; at half the resolution (down), the same, or twice (up)."""

    features: int
    kind: Literal["down", "same", "up"]
    num_groups: int
    bf16: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "objects *space channels"]) -> Float[Array, "objects *out_space features"]:
        """The block's output."""
        kernel = self.param("kernel", kernel_init, (3, 3, 3, x.shape[-1], self.features))
        if self.kind == "up":
            x = upsample_conv(x, kernel, self.bf16)
        else:
            x = conv(x, kernel, stride=2 if self.kind == "down" else 1, bf16=self.bf16)
        return nn.relu(GroupNorm(self.num_groups, name="norm")(x))


class UNet3D(nn.Module):
    """Encoder and decoder; the output has the resolution and width of the stem."""

    resolution: int
    base_width: int
    num_stages: int
    num_groups: int
    bf16: bool = False

    @nn.compact
    def __call__(
        self, rows: Int[Array, "objects points"], values: Float[Array, "objects points channels"]
    ) -> Float[Array, "objects d d d features"]:
        """Feature volume of each object from its scattered points (`voxels.scatter_conv` says in which form)."""
        x = Stem(self.base_width, self.resolution, self.num_groups, name="stem")(rows, values)
        skips, width = [], self.base_width
        for i in range(self.num_stages):
            skips.append(x)
            width *= 2
            x = Block(width, "down", self.num_groups, self.bf16, name=f"down_{i}")(x)
            x = Block(width, "same", self.num_groups, self.bf16, name=f"same_{i}")(x)
        for i in range(self.num_stages):
            width //= 2
            x = Block(width, "up", self.num_groups, self.bf16, name=f"up_{i}")(x) + skips.pop()
        return x
