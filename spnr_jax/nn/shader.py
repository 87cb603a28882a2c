"""CNN that shades a G-buffer: opacity, a change of the base colour, and how light is passed on, for each pixel.

A U-Net over what the front-most surfels say, at the resolution at which points lie two to four pixels apart, so that it
sees points as it has learnt to whatever their number; then one block that doubles the resolution, as often as the
picture needs.  Its outputs are factors of light maps that are linear in the light (`picture`): the network sees no
light, and a picture is linear in it up to the sRGB curve.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.colors import linear_to_srgb
from spnr_jax.kernels.numerics import clamp, larger, one_minus_exp, smaller
from spnr_jax.kernels.resizing import doubled, mean_of_squares, unfolded
from spnr_jax.nn.convolution import Conv
from spnr_jax.surfels.lighting import SPECULAR

NUM_OUTPUTS = 21
COLOR_STEP, ODDS_STEP = 0.3, 2.0  # what an output of 1 changes the base colour, and the log odds of the opacity by
LEAST_ODDS = 1e-2  # keeps the odds of what is clear or opaque finite
NOTHING = 2e-4  # opacity below which a pixel stays clear, whatever the network says


class Block(nn.Module):
    """Two convolutions beside the identity."""

    @nn.compact
    def __call__(self, x: Float[Array, "batch height width features"]) -> Float[Array, "batch height width features"]:
        """The features, changed."""
        y = nn.LayerNorm(name="norm")(x)
        y = nn.relu(Conv(x.shape[-1], name="a")(y))
        return x + Conv(x.shape[-1], name="b")(y)


class Double(nn.Module):
    """Features at twice the resolution."""

    @nn.compact
    def __call__(self, x: Float[Array, "batch height width features"]) -> Float[Array, "batch h w features"]:
        """Bilinear, plus four new pixels from each, plus two convolutions."""
        features = x.shape[-1]
        x = doubled(x) + unfolded(nn.Dense(4 * features, name="expand")(x), 2)
        y = nn.relu(Conv(features, name="a")(x))
        return x + Conv(features, name="b")(y)


class Shader(nn.Module):
    """Factors of a picture's light maps (`picture`) from a G-buffer (`surfels.features`)."""

    widths: tuple[int, ...]
    top: int

    @nn.compact
    def __call__(
        self, seen: Float[Array, "batch height width features"], doublings: int, margin: int = 0
    ) -> Float[Array, "batch h w 21"]:
        """Outputs at 2^doublings times the resolution, but for a margin of pixels that only tell what is around."""
        height, width = seen.shape[1:3]
        square = 2 ** (len(self.widths) - 1)
        x = jnp.pad(seen, ((0, 0), (0, -height % square), (0, -width % square), (0, 0)))
        skips = []
        for level, features in enumerate(self.widths):
            x = Conv(features, name=f"in{level}")(mean_of_squares(x, 2) if level else x)
            x = Block(name=f"down{level}")(x)
            skips.append(x)
        for level in reversed(range(len(self.widths) - 1)):
            x = skips[level] + doubled(nn.Dense(self.widths[level], name=f"up{level}")(x))
            x = Block(name=f"dec{level}")(x)
        x = nn.Dense(self.top, name="top")(x[:, margin : height - margin, margin : width - margin])
        double = Double(name="double")
        for _ in range(doublings):
            x = double(x)
        return nn.Dense(NUM_OUTPUTS, kernel_init=nn.initializers.zeros, name="out")(nn.LayerNorm(name="norm")(x))


def log_odds(opacity: Float[Array, "*pixels"]) -> Float[Array, "*pixels"]:
    """Finite ones, also of 0 and 1."""
    return jnp.log(opacity + LEAST_ODDS) - jnp.log(1 + LEAST_ODDS - opacity)


def picture(
    outputs: Float[Array, "batch h w 21"],
    maps: Float[Array, "batch height width 17"],
    ambient: Float[Array, "batch 9 3"],
    doublings: int,
) -> tuple[Float[Array, "batch h w 3"], Float[Array, "batch h w"]]:
    """sRGB colour and opacity: light that the network lets through falls on the surfels' materials.

    `maps` are those of `surfels.features`, `ambient` the light's spherical harmonics in camera axes.
    """
    for _ in range(doublings):
        maps = doubled(maps)
    color, metallic, opacity, factor, summand, arriving, unshadowed, mirrored, reflected = jnp.split(
        maps, (3, 4, 5, 6, 7, 10, 13, 16), axis=-1
    )
    step, odds_step, shade, open_sky, shine, glow, bounce, bounces, metal_step, rougher = jnp.split(
        outputs, (3, 4, 5, 6, 7, 8, 11, 19, 20), axis=-1
    )
    base = clamp(color + COLOR_STEP * step, 0, 1)
    alpha = nn.sigmoid(log_odds(opacity) + ODDS_STEP * odds_step) * one_minus_exp(opacity / NOTHING)
    bounced = bounce * ambient[:, None, None, 0]
    bounced += jnp.einsum("bhwk,bkc->bhwc", bounces, ambient[:, 1:], precision="highest")
    metallic = clamp(metallic + COLOR_STEP * metal_step, 0, 1)
    mirrored += clamp(rougher, 0, 1) * (unshadowed - mirrored)  # rougher than it is said to be
    diffuse = (1 + shade) * arriving + open_sky * unshadowed + bounced
    specular = (1 + shine) * reflected + glow
    normal_incidence = SPECULAR * (1 - metallic) + base * metallic
    linear = base * (1 - metallic) * diffuse + (normal_incidence * factor + summand) * mirrored * specular
    return smaller(linear_to_srgb(larger(linear, 0)), 1), alpha[..., 0]
