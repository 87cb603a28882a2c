"""CNN that looks over a rendered picture: what no ray can know alone, such as that an outline goes on straight.

A small U-Net over what the rays of a picture gave: colour, opacity, depth, and what the hidden layer of the field told
of each.  It says by how much the log odds of the opacity and the colour of the object change at each pixel.  It works
at half the picture's size, and of pictures larger than those of its training on their mean over squares of pixels:
there it sees points as far apart as it has learnt, and its changes, which are smooth, are laid on the large picture.
Where no point is near, nothing is drawn.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.compositing import WHITE
from spnr_jax.nn.convolution import conv, kernel_init
from spnr_jax.numerics import per_feature
from spnr_jax.resizing import bilinear, folded, mean_of_squares, unfolded

LEVELS = 3  # of the U-Net
FOLD = 2  # pixels along each side of what the first level takes as one
LEAST = 1e-2  # opacity below which the colour of a pixel is not told from its weighted one
ODDS = 1e-3  # keeps the odds of what is clear or solid finite


class Refiner(nn.Module):
    """A picture of an object on white, its depth and opacity, with changes that see the pixels around."""

    width: int
    num_told: int = 8
    bf16: bool = False

    @nn.compact
    def __call__(
        self,
        image: Float[Array, "batch height width 3"],
        hidden: Float[Array, "batch height width hidden"],
        depth: Float[Array, "batch height width"],
        acc: Float[Array, "batch height width"],
        far: Float[Array, "batch height width"],
        eye: Float[Array, " batch"],
        shrink: int = 1,
    ) -> tuple[
        Float[Array, "batch height width 3"], Float[Array, "batch height width"], Float[Array, "batch height width"]
    ]:
        """Image, depth and opacity; `far` is where rays end, `eye` the distance of the camera from the box's centre.

        The changes are those of a picture that is smaller by `shrink`.
        """
        told = nn.Dense(self.num_told, name="told")(hidden)
        opacity, drawn = acc[..., None], (acc > 0).astype(acc.dtype)[..., None]
        weighted = image - (1 - opacity) * WHITE
        distance = far + (depth - far) / jnp.maximum(acc, ODDS)  # of the object alone
        depth = opacity * (distance - eye[:, None, None])[..., None]
        seen = jnp.concatenate([weighted, opacity, depth, drawn, drawn * told], axis=-1)
        change = self.change(seen, shrink)
        odds = jnp.log(opacity + ODDS) - jnp.log1p(ODDS - opacity)
        opacity = drawn * nn.sigmoid(odds + change[..., 3:])
        color = weighted / jnp.maximum(acc, LEAST)[..., None] + change[..., :3]
        image, acc = opacity * color + (1 - opacity) * WHITE, opacity[..., 0]
        return image, far + acc * (distance - far), acc

    def change(
        self, seen: Float[Array, "batch height width features"], shrink: int
    ) -> Float[Array, "batch height width 4"]:
        """Changes of colour and log odds of opacity; pixels beyond the picture are empty."""
        height, width = seen.shape[1:3]
        square = shrink * FOLD * 2 ** (LEVELS - 1)
        padded = jnp.pad(seen, ((0, 0), (0, -height % square), (0, -width % square), (0, 0)))
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
