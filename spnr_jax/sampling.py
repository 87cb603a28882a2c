"""Where along a ray the volume is evaluated: stratified samples, and samples drawn from a step function.

Vocabulary: `edges` (*batch, n+1) are the sorted ends of n bins along a ray, `distances` (*batch, m) are samples,
`weights` (*batch, n) is the mass of each bin.  A key draws one number per sample of every ray; key=None takes the middle
of each stratum.  All of it is float32: one bf16 spacing is wider than a coarse bin.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.numerics import per_feature, safe_divide
from spnr_jax.types import Key


def strata(key: Key | None, shape: tuple[int, ...], num_samples: int) -> Float[Array, "*batch samples"]:
    """One number in each of `num_samples` equal parts of [0, 1]: uniform in its part, or its middle without a key."""
    shape = (*shape, num_samples)
    jitter = jnp.full(shape, 0.5) if key is None else jax.random.uniform(key, shape)
    return (per_feature(jnp.arange(num_samples, dtype=jnp.float32), jitter) + jitter) / num_samples


def stratified(
    key: Key | None, near: Float[Array, "*batch"], far: Float[Array, "*batch"], num_samples: int
) -> tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples+1"]]:
    """Sorted distances, one in each equal part of [near, far], and the edges of the parts (NeRF, eq. 2)."""
    near, far = near[..., None], far[..., None]
    fractions = per_feature(jnp.arange(num_samples + 1, dtype=jnp.float32) / num_samples, near)
    edges = near * (1 - fractions) + far * fractions
    at = strata(key, near.shape[:-1], num_samples)
    return jnp.clip(near + (far - near) * at, edges[..., :-1], edges[..., 1:]), edges


def importance(
    key: Key | None,
    edges: Float[Array, "*batch bins+1"],
    weights: Float[Array, "*batch bins"],
    num_samples: int,
    padding: float = 1e-5,
) -> Float[Array, "*batch {num_samples}"]:
    """Sorted distances inside the edges, distributed as the step function `weights + padding` (NeRF, section 5.2).

    Inverts the cumulative distribution at one number of each of num_samples strata.  All-zero weights give an even
    spread.  No gradient: the samples are where to look, not what is seen; through them the coarse weights would be
    pulled towards whatever the fine samples happen to find.
    """
    edges, weights = jax.lax.stop_gradient((edges, weights))
    mass = weights + padding
    cdf = jnp.cumsum(mass / jnp.sum(mass, axis=-1, keepdims=True), axis=-1)
    at = strata(key, weights.shape[:-1], num_samples)
    upper = _count_at_most(cdf, at)
    upper = jnp.minimum(upper, weights.shape[-1] - 1)

    def pick(x, index):
        return jnp.take_along_axis(x, index, axis=-1)

    below = jnp.where(upper > 0, pick(cdf, jnp.maximum(upper - 1, 0)), 0.0)
    fraction = jnp.clip(safe_divide(at - below, pick(cdf, upper) - below), 0.0, 1.0)
    lo, hi = pick(edges, upper), pick(edges, upper + 1)
    return jnp.clip(lo + fraction * (hi - lo), lo, hi)


def _count_at_most(sorted_values, queries):
    """For each query, how many of the sorted values are at most as large: all pairs for few, a search for many."""
    if sorted_values.shape[-1] <= 256:
        return jnp.sum(sorted_values[..., None, :] <= queries[..., :, None], axis=-1, dtype=jnp.int32)
    search = jnp.vectorize(lambda a, v: jnp.searchsorted(a, v, side="right"), signature="(n),(m)->(m)")
    return search(sorted_values, queries).astype(jnp.int32)
