"""Emission-absorption along a ray: from densities at samples to a pixel.

Vocabulary (NeRF, eq. 3): `density` >= 0 per unit length; `delta`, the length of a sample's interval; optical depth
`tau = density * delta`; `transmittance`, the share of light that reaches a point; `weights`, the share that stops in
each interval; `acc`, their sum (opacity); residual transmittance 1 - acc.  Intervals are finite: light that passes the
last one meets the background.  Everything is float32.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.numerics import one_minus_exp


def interval_lengths(
    distances: Float[Array, "*batch samples"], far: Float[Array, "*batch"]
) -> Float[Array, "*batch samples"]:
    """Length of each sorted sample's interval: up to the next sample, the last one up to `far`."""
    return jnp.diff(distances, axis=-1, append=far[..., None])


def volume_weights(
    density: Float[Array, "*batch samples"], delta: Float[Array, "*batch samples"]
) -> tuple[Float[Array, "*batch samples"], Float[Array, "*batch"]]:
    """Weights exp(-sum of tau before) * (1 - exp(-tau)), and the residual transmittance exp(-sum of all tau).

    `one_minus_exp` keeps thin intervals, and the gradient of opaque ones.  Optical depths are summed before one exp,
    instead of multiplying transmittances.  An infinite optical depth is opaque, with zero gradient.
    """
    tau = density * delta
    through = jnp.cumsum(tau, axis=-1)
    before = jnp.concatenate([jnp.zeros_like(tau[..., :1]), through[..., :-1]], axis=-1)
    return jnp.exp(-before) * one_minus_exp(tau), jnp.exp(-through[..., -1])


def composite(
    weights: Float[Array, "*batch samples"],
    values: Float[Array, "*batch samples features"],
    background: Float[Array, "*#batch features"] | float = 0.0,
) -> Float[Array, "*batch features"]:
    """Sum of weights * values, plus the background times the residual transmittance."""
    acc = jnp.sum(weights, axis=-1, keepdims=True)
    return jnp.einsum("...s,...sf->...f", weights, values, precision="highest") + (1 - acc) * background


def expected_distance(
    weights: Float[Array, "*batch samples"], distances: Float[Array, "*batch samples"], far: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Weighted sum of the sample distances [paper]; the residual transmittance counts at `far`."""
    return jnp.sum(weights * distances, axis=-1) + (1 - jnp.sum(weights, axis=-1)) * far
