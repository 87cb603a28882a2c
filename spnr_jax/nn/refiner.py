"""CNN that refines a rendered picture: it sees neighbouring pixels, and continues a straight outline, say.

A small U-Net over what the rays of a picture gave: colour, opacity, depth, and geometry of the surface that they met or
passed (`surface_field.told`). Its output is added to the log odds of the opacity and to the colour of the object. It
works at half the picture's size, and of pictures larger than those of its training on their mean over squares of
pixels: there it sees points as far apart as it has learnt, and its output, which is smooth, is added to the large
picture. Where no point is near, nothing is drawn.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.compositing import WHITE
from spnr_jax.kernels.numerics import per_feature
from spnr_jax.kernels.resizing import bilinear, folded, mean_of_squares, unfolded
from spnr_jax.nn.convolution import conv, kernel_init

LEVELS = 3  # of the U-Net
FOLD = 2  # pixels along each side of what the first level takes as one
LEAST = 1e-2  # opacity below which the colour of a pixel is not told from its weighted one
ODDS = 1e-3  # keeps the odds of what is clear or solid finite


class Refiner(nn.Module):
    """Colour and opacity of a picture of an object on white, with changes that see the pixels around."""

    width: int
    bf16: bool = False

    @nn.compact
    def __call__(
        self, seen: Float[Array, "batch height width features"], shrink: int = 1
    ) -> tuple[Float[Array, "batch height width 3"], Float[Array, "batch height width"]]:
        """Image and opacity; the changes are those of a picture that is smaller by `shrink`.

        Seen of each pixel: RGB on white, what its ray told (only zeros near no point), how far behind the middle of the
        box things are, times their opacity, and that opacity.
        """
        image, told, opacity = seen[..., :3], seen[..., 3:-2], seen[..., -1:]
        drawn = jnp.any(told != 0, axis=-1, keepdims=True).astype(seen.dtype)
        change = self.change(drawn * self.standardised(seen), drawn, shrink)
        odds = jnp.log(opacity + ODDS) - jnp.log1p(ODDS - opacity)
        refined = drawn * nn.sigmoid(odds + change[..., 3:])
        color = (image - (1 - opacity) * WHITE) / jnp.maximum(opacity, LEAST) + change[..., :3]
        return refined * color + (1 - refined) * WHITE, refined[..., 0]

    def standardised(self, seen: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
        """Features less their mean, over their deviation, which training measures before it begins."""
        mean = self.param("mean", nn.initializers.zeros, seen.shape[-1:])
        deviation = self.param("deviation", nn.initializers.ones, seen.shape[-1:])
        mean, deviation = jax.lax.stop_gradient((mean, deviation))
        return (seen - per_feature(mean, seen)) / per_feature(deviation, seen)

    def change(
        self,
        seen: Float[Array, "batch height width features"],
        drawn: Float[Array, "batch height width 1"],
        shrink: int,
    ) -> Float[Array, "batch height width 4"]:
        """Changes of colour and log odds of opacity; pixels beyond the picture are empty."""
        height, width = seen.shape[1:3]
        square = shrink * FOLD * 2 ** (LEVELS - 1)
        padded = jnp.pad(
            jnp.concatenate([seen, drawn], axis=-1), ((0, 0), (0, -height % square), (0, -width % square), (0, 0))
        )
        x = folded(mean_of_squares(padded, shrink), FOLD)
        skips = []
        for level in range(LEVELS):
            x = x if level == 0 else mean_of_squares(x, 2)
            x = nn.gelu(self.convolution(x, self.width * min(2**level, 2), f"down_{level}"))
            x = self.block(x, f"down_block_{level}")
            skips.append(x)
        for level in reversed(range(LEVELS - 1)):
            skip = skips[level]
            x = nn.Dense(skip.shape[-1], name=f"up_{level}")(x)
            x = self.block(skip + bilinear(x, *skip.shape[1:3]), f"up_block_{level}")
        x = nn.LayerNorm(name="norm")(x)
        x = unfolded(nn.Dense(4 * FOLD**2, kernel_init=nn.initializers.zeros, name="out")(x), FOLD)
        return bilinear(x, *padded.shape[1:3])[:, :height, :width]

    def block(self, x: Float[Array, "batch height width features"], name: str):
        """Two convolutions beside the identity."""
        y = nn.LayerNorm(name=f"{name}_norm")(x)
        y = nn.gelu(self.convolution(y, x.shape[-1], f"{name}_0"))
        return x + self.convolution(y, x.shape[-1], f"{name}_1")

    def convolution(self, x: Float[Array, "batch height width in"], features: int, name: str):
        """A convolution of 3 x 3 pixels with its bias."""
        y = conv(x, self.param(f"{name}_kernel", kernel_init, (3, 3, x.shape[-1], features)), bf16=self.bf16)
        return y + per_feature(self.param(f"{name}_bias", nn.initializers.zeros, (features,)), y)
