"""Radiance field: density and colour at a place from the volume's feature there.

One hidden layer with softplus; density = softplus(raw - 1) (a ReLU can die before it has seen the object); features
see the view direction.  All features but RGB are linear in the hidden layer, and so is compositing: the hidden layer is
composited, and `finish` applies the linear part once per ray instead of once per sample.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.compositing import WHITE
from spnr_jax.kernels.numerics import per_feature, softplus
from spnr_jax.nn.encoding import encode_direction


class RadianceField(nn.Module):
    """Density and colour of samples; `view` and `finish` are the parts that a ray needs once."""

    width: int
    num_features: int
    direction_frequencies: int
    sees_direction: bool = True

    def setup(self) -> None:
        """Layers: hidden -> [density, rgb], direction -> features, hidden -> the features after rgb."""
        self.hidden = nn.Dense(self.width)
        self.head = nn.Dense(4)
        self.direction = nn.Dense(self.num_features, use_bias=False)
        self.features = nn.Dense(self.num_features - 3, use_bias=False)
        self.feature_bias = self.param("feature_bias", nn.initializers.zeros, (self.num_features - 3,))

    def view(self, directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays features"]:
        """What the view direction adds to each feature: nothing if the field does not see it."""
        if not self.sees_direction:
            return jnp.zeros((*directions.shape[:-1], self.num_features), directions.dtype)
        return self.direction(encode_direction(directions, self.direction_frequencies))

    def __call__(
        self, x: Float[Array, "*rays samples channels"], view: Float[Array, "*rays features"]
    ) -> tuple[Float[Array, "*rays samples"], tuple[Array, Array]]:
        """Density, and what is emitted at each sample: RGB in (0, 1) and hidden layer (*rays, samples, ...)."""
        # one long axis of samples: XLA's CPU gradient of a product that sums over several axes takes four times as long
        hidden = softplus(self.hidden(x.reshape(-1, x.shape[-1])))
        out = self.head(hidden).reshape(*x.shape[:-1], 4)
        rgb = nn.sigmoid(out[..., 1:] + view[..., None, :3])
        return softplus(out[..., 0] - 1), (rgb, hidden.reshape(*x.shape[:-1], self.width))

    def finish(
        self, emitted: tuple[Array, Array], acc: Float[Array, "*rays"], view: Float[Array, "*rays features"]
    ) -> Float[Array, "*rays features"]:
        """Features of a ray, RGB on white and the rest on zero, from what is composited and its opacity."""
        rgb, hidden = emitted
        rest = self.features(hidden) + acc[..., None] * (per_feature(self.feature_bias, view) + view[..., 3:])
        return jnp.concatenate([rgb + (1 - acc[..., None]) * WHITE, rest], axis=-1)
