"""Radiance field that sees the surface: density and colour at a place from the volume's feature and the nearest points.

Density fills what lies behind the surface: strength * facing / spacing * sigmoid(shift - SHARPNESS * height),
height and spacing of the points, strength and shift from the network.  A ray that meets the surface at a right angle
and one that grazes it then gather as much optical depth per depth, so that outlines do not grow by the path along them.

With `lit` the network does not invent colours, it predicts light.  Base colour b and metallic m of the points nearby
give the specular colour at normal incidence, F0 = 0.04 (1 - m) + b m, and the radiance b (1 - m) E + F0 L in linear
light, where E (diffuse light) and L (light from the mirrored direction) are positive outputs that see normal, roughness
and view direction.  Without it, RGB is free, and sRGB.

The shading is deferred: what the light depends on is composited, and `finish` asks for the light once per ray, of the
mean of what the ray sees.  Colours are mixed in linear light, divided by the opacity, and encoded as sRGB last.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.colors import LEAST_OPACITY, over
from spnr_jax.kernels.compositing import WHITE
from spnr_jax.kernels.numerics import softplus
from spnr_jax.kernels.records import SurfaceSample
from spnr_jax.nn.encoding import encode_direction

DIELECTRIC = 0.04  # reflectance of plastic, wood, paint at normal incidence
STRENGTH = 4.0  # optical depth per spacing of depth, of one unit of the network's output
SHARPNESS = 4.0  # density rises within about half a spacing
SPACING_SCALE = 10.0  # brings the spacing of a thousand points to the order of 1
NOWHERE = 10.0  # spacings, of what is not there
NUM_TOLD = 13  # inputs of the refiner that `told` makes


def facing_of(surface: SurfaceSample, directions: Float[Array, "samples 3"]) -> Float[Array, " samples"]:
    """How much the surface faces the viewer: cosine of the angle between its normal and the way back along the ray."""
    return -jnp.sum(surface.normal * directions, axis=-1)


def told(surface: SurfaceSample, directions: Float[Array, "samples 3"]) -> tuple[Array, Array]:
    """Inputs of the refiner: 9 numbers of a sample that are composited, and 4 whose minimum along the ray is taken.

    The latter are how near the ray passes points, their planes, their rim and the surface, large where there is none.
    """
    s = surface
    means = (s.height, s.beside, s.nearest, s.miss, s.outside, s.flatness, s.narrowness, SPACING_SCALE * s.spacing)
    least = [jnp.where(s.exists, length, NOWHERE) for length in (s.nearest, s.miss, s.outside, s.height)]
    return jnp.stack([*means, facing_of(s, directions)], axis=-1), jnp.stack(least, axis=-1)


class SurfaceField(nn.Module):
    """Density and colour of samples; `view` and `finish` are the parts that a ray needs once."""

    width: int
    direction_frequencies: int
    sees_direction: bool
    lit: bool

    def setup(self) -> None:
        """Layers: near -> shape -> density, shape + direction -> deep -> light."""
        self.near = nn.Dense(self.width)
        self.shape = nn.Dense(self.width)
        self.density = nn.Dense(2)
        self.deep = nn.Dense(self.width)
        self.light = nn.Dense(6 if self.lit else 3)
        self.direction = nn.Dense(self.width, use_bias=False)

    def view(self, directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays hidden"]:
        """What the view direction adds to the layer before the light: nothing if the field does not see it."""
        if not self.sees_direction:
            return jnp.zeros((*directions.shape[:-1], self.width), directions.dtype)
        return self.direction(encode_direction(directions, self.direction_frequencies))

    def __call__(
        self,
        x: Float[Array, "samples channels"],
        directions: Float[Array, "samples 3"],
        surface: SurfaceSample,
    ) -> tuple[Float[Array, " samples"], tuple[Float[Array, "samples _"], ...]]:
        """Density, 0 where no point is near, and what the light depends on: the layer `shape`, the material's colours.

        With `lit` these are the diffuse colour and the specular colour at normal incidence, else there are none.
        """
        base, metallic = surface.base_color, surface.metallic[:, None]
        facing = facing_of(surface, directions)
        lengths = (surface.height, surface.beside, surface.nearest, surface.ahead, surface.miss, surface.outside)
        shape = (surface.flatness, surface.narrowness, SPACING_SCALE * surface.spacing, facing)
        numbers = jnp.stack([*lengths, *shape, surface.roughness, surface.metallic], axis=-1)
        inputs = [x, numbers, surface.normal, base]
        if self.sees_direction:
            inputs.append(directions + 2 * facing[:, None] * surface.normal)
        seen = softplus(self.shape(softplus(self.near(jnp.concatenate(inputs, axis=-1)))))
        strength, shift = jnp.moveaxis(self.density(seen), -1, 0)
        steep = jnp.maximum(facing, 0) / jnp.where(surface.exists, surface.spacing, 1)
        behind = nn.sigmoid(shift - SHARPNESS * surface.height)
        density = jnp.where(surface.exists, STRENGTH * softplus(strength) * steep * behind, 0)
        colors = (base * (1 - metallic), DIELECTRIC * (1 - metallic) + base * metallic) if self.lit else ()
        return density, (seen, *colors)

    def finish(
        self, emitted: tuple[Array, ...], acc: Float[Array, "*rays"], view: Float[Array, "*rays hidden"]
    ) -> Float[Array, "*rays 3"]:
        """sRGB of a ray on white, from what is composited, its opacity and direction."""
        seen, *colors = emitted
        acc = acc[..., None]
        light = self.light(softplus(self.deep(seen / jnp.maximum(acc, LEAST_OPACITY)) + view))
        if not self.lit:
            return acc * nn.sigmoid(light) + (1 - acc) * WHITE
        diffuse, mirrored = jnp.split(softplus(light), 2, axis=-1)
        return over(colors[0] * diffuse + colors[1] * mirrored, acc, WHITE)
