"""Where along a ray the volume is evaluated: stratified samples, and samples drawn from a step function.

Vocabulary: `edges` (*batch, n+1) are the sorted ends of n bins along a ray, `distances` (*batch, m) are samples,
`weights` (*batch, n) are the masses of the bins.  One key draws a number per sample of every ray; an array of keys
(*batch) has one key per ray; key=None takes the middle of each stratum.  Everything is float32: a bf16 spacing is wider
than a coarse bin.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

from spnr_jax.errors import UserError
from spnr_jax.kernels.numerics import clamp, per_feature, safe_divide
from spnr_jax.kernels.records import Key


def strata(key: Key | None, shape: tuple[int, ...], num_samples: int) -> Float[Array, "*batch samples"]:
    """One number in each of `num_samples` equal parts of [0, 1]: uniform in its part, or its middle without a key."""
    shape = (*shape, num_samples)
    jitter = jnp.full(shape, 0.5) if key is None else _uniform(key, shape)
    return (per_feature(jnp.arange(num_samples, dtype=float), jitter) + jitter) / num_samples


def split(key: Key) -> tuple[Key, Key]:
    """Two new keys for each key."""
    key = as_typed_key(key)
    if key.ndim:
        return jax.vmap(split)(key)
    first, second = jax.random.split(key)
    return first, second


def as_typed_key(key: Key) -> Key:
    """Typed keys (`jax.random.key`); raw ones of `jax.random.PRNGKey`, pairs of numbers, are wrapped."""
    return key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)


def _uniform(key, shape):
    key = as_typed_key(key)
    return jax.random.uniform(key, shape) if key.ndim == 0 else jax.vmap(_uniform, (0, None))(key, shape[1:])


def stratified(
    key: Key | None, near: Float[Array, "*batch"], far: Float[Array, "*batch"], num_samples: int
) -> tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples+1"]]:
    """Sorted distances, one in each equal part of [near, far], and the edges of the parts (NeRF, eq. 2)."""
    near, far = near[..., None], far[..., None]
    steps = jnp.arange(num_samples + 1, dtype=jnp.promote_types(near.dtype, jnp.float32))
    fractions = per_feature(steps / num_samples, near)
    edges = near + (far - near) * fractions  # rises with the fractions under any rounding
    edges = jnp.where((fractions < 1) & (edges < far), edges, far)
    at = strata(key, near.shape[:-1], num_samples)
    return clamp(near + (far - near) * at, edges[..., :-1], edges[..., 1:]), edges


def importance(
    key: Key | None,
    edges: Float[Array, "*batch edges"],
    weights: Float[Array, "*batch edges-1"],
    num_samples: int,
    padding: float = 1e-5,
) -> Float[Array, "*batch {num_samples}"]:
    """Sorted distances inside the edges, distributed as the step function `weights + padding` (NeRF, section 5.2).

    Inverts the cumulative distribution at one number in each of num_samples strata.  With all-zero weights the samples
    are evenly distributed.  No gradient: it would pull the coarse weights towards whatever the fine samples find.
    """
    if weights.shape[-1] + 1 != edges.shape[-1]:
        raise UserError(f"importance: {edges.shape[-1]} edges have one weight less, got {weights.shape[-1]} weights")
    edges, weights = jax.lax.stop_gradient((edges, weights))
    mass = weights + padding
    mass = jnp.where(jnp.any(mass > 0, axis=-1, keepdims=True), mass, 1.0)  # without padding
    cdf = jnp.cumsum(mass / jnp.sum(mass, axis=-1, keepdims=True), axis=-1)
    at = strata(key, weights.shape[:-1], num_samples)
    upper = jnp.minimum(count_at_most(cdf, at), weights.shape[-1] - 1)
    below = jnp.where(upper > 0, _pick(cdf, jnp.maximum(upper - 1, 0)), 0.0)
    fraction = jnp.clip(safe_divide(at - below, _pick(cdf, upper) - below), 0.0, 1.0)
    lo, hi = _pick(edges, upper), _pick(edges, upper + 1)
    return jnp.clip(lo + fraction * (hi - lo), lo, hi)


def merge(
    first: Float[Array, "*batch n"], second: Float[Array, "*batch m"]
) -> tuple[Int[Array, "*batch n+m"], Int[Array, "*batch n+m"]]:
    """(order, rank) of two concatenated sorted lists: `both[order]` is sorted, and `sorted[rank]` is `both` again.

    For equal numbers, the first list comes first.  Counting smaller numbers takes an eighth of a sort's time on a CPU.
    """
    n, m = first.shape[-1], second.shape[-1]
    place_first, place_second, place = (per_feature(jnp.arange(k, dtype=jnp.int32), first) for k in (n, m, n + m))
    # without barriers XLA recomputes the ranks inside each gather that reads them
    barrier = jax.lax.optimization_barrier
    rank_first = barrier(place_first + count_at_most(second, first, strictly=True))
    rank_second = barrier(place_second + count_at_most(first, second))
    place = jnp.broadcast_to(place, (*first.shape[:-1], n + m))
    taken = barrier(count_at_most(rank_first, place, strictly=True))
    from_first = _pick(rank_first, jnp.minimum(taken, n - 1)) == place
    order = jnp.where(from_first, taken, n + place - taken)
    return barrier((order, jnp.concatenate([rank_first, rank_second], axis=-1)))


def count_at_most(
    sorted_values: Shaped[Array, "*batch n"], queries: Shaped[Array, "*batch m"], strictly: bool = False
) -> Int[Array, "*batch m"]:
    """Number of sorted values <= (strictly: <) each query; by comparing all for few values, else by bisection."""
    if sorted_values.shape[-1] > 256:
        bisect = partial(jnp.searchsorted, side="left" if strictly else "right")
        return jnp.vectorize(bisect, signature="(n),(m)->(m)")(sorted_values, queries)
    count = jnp.zeros(queries.shape, jnp.int32)
    for i in range(sorted_values.shape[-1]):
        value = sorted_values[..., i : i + 1]
        count = count + (value < queries if strictly else value <= queries)
    return count


def _pick(values, index):
    return jnp.take_along_axis(values, index, axis=-1)
