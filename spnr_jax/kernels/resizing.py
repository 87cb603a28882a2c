"""Pictures in other sizes: bilinear, and means over squares of pixels."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def bilinear(
    x: Float[Array, "batch height width features"], height: int, width: int
) -> Float[Array, "batch h w features"]:
    """Image resized with half-pixel centres (not aligned at the corners)."""
    return jax.image.resize(x, (x.shape[0], height, width, x.shape[-1]), "bilinear", antialias=False)


def mean_of_squares(x: Float[Array, "*batch height width features"], side: int) -> Float[Array, "*batch h w features"]:
    """The mean of each square of side x side pixels."""
    return jnp.mean(squares(x, side), axis=(-4, -2))


def folded(x: Float[Array, "*batch height width features"], side: int) -> Float[Array, "*batch h w folded"]:
    """The pixels of each square of side x side as features of one pixel."""
    x = jnp.swapaxes(squares(x, side), -4, -3)
    return x.reshape(*x.shape[:-3], -1)


def unfolded(x: Float[Array, "*batch h w folded"], side: int) -> Float[Array, "*batch height width features"]:
    """The inverse of `folded`."""
    *batch, height, width, features = x.shape
    x = jnp.swapaxes(x.reshape(*batch, height, width, side, side, features // side**2), -4, -3)
    return x.reshape(*batch, side * height, side * width, features // side**2)


def squares(x: Float[Array, "*batch height width features"], side: int) -> Array:
    """The picture cut into squares of side x side pixels, (*batch, h, side, w, side, features)."""
    *batch, height, width, features = x.shape
    return x.reshape(*batch, height // side, side, width // side, side, features)
