"""Positional encoding of directions and places (NeRF, eq. 4), with the plain number first."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def encode_direction(directions: Float[Array, "*batch 3"], num_frequencies: int) -> Float[Array, "*batch encoding"]:
    """[d, sin(d), cos(d), sin(2 d), cos(2 d), ...] of unit directions, 3 + 6 num_frequencies numbers."""
    parts = [directions]
    for k in range(num_frequencies):
        parts += [jnp.sin(directions * 2**k), jnp.cos(directions * 2**k)]
    return jnp.concatenate(parts, axis=-1)
