"""Laws that every kernel obeys, as checks that the tests call with their own kernels and numbers.

A kernel takes float arrays and returns an array or a tuple of arrays; `arguments` lead with batch axes (2, 3).
"""

import jax
import jax.numpy as jnp
import numpy as np


def numbers(seed: int, *shape: int, low: float = -1.0, high: float = 1.0) -> jax.Array:
    """Uniform float32 numbers from a literal seed."""
    return jnp.asarray(np.random.default_rng(seed).uniform(low, high, shape), jnp.float32)


def close(actual, expected, rtol=1e-5, atol=1e-6):
    """Both trees hold the same numbers within rounding, and none of them is NaN."""
    actual, expected = jax.tree.leaves(actual), jax.tree.leaves(expected)
    assert len(actual) == len(expected)
    for a, e in zip(actual, expected, strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(e), rtol=rtol, atol=atol, equal_nan=False)


def same_bits(actual, expected):
    """Both trees are equal bit by bit; keys are compared by their data."""

    def bits(leaf):
        return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)

    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, e in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(bits(a), bits(e))


def batch_law(kernel, *arguments, rtol=1e-5, atol=1e-6):
    """Eager = jit, and batch ranks () and (3,), vmap and the loop all agree with rank (2, 3)."""
    whole = jax.tree.map(np.asarray, kernel(*arguments))
    one = jax.jit(kernel)

    @jax.jit
    def every_way(*arguments):
        return kernel(*arguments), jax.vmap(jax.vmap(kernel))(*arguments), kernel(*(x[1] for x in arguments))

    jitted, mapped, row = every_way(*arguments)
    close(jitted, whole, rtol, atol)
    close(mapped, whole, rtol, atol)
    close(row, jax.tree.map(lambda x: x[1], whole), rtol, atol)
    for place in np.ndindex(2, 3):
        single = one(*(jnp.asarray(np.asarray(x)[place]) for x in arguments))
        close(single, jax.tree.map(lambda x, place=place: x[place], whole), rtol, atol)


def gradient_law(kernel, *arguments, rtol=1e-3):
    """The float32 gradient of a random projection is finite and equals float64's, which equals finite differences."""
    rng = np.random.default_rng(0)
    weights = [rng.normal(size=leaf.shape) for leaf in jax.tree.leaves(jax.eval_shape(kernel, *arguments))]
    step = [rng.normal(size=x.shape) for x in arguments]

    def projection(*arguments):
        leaves = jax.tree.leaves(kernel(*arguments))
        return sum(jnp.sum(jnp.asarray(w, leaf.dtype) * leaf) for w, leaf in zip(weights, leaves, strict=True))

    def along(t, *arguments):
        return projection(*(x + t * jnp.asarray(s) for x, s in zip(arguments, step, strict=True)))

    gradient = jax.grad(projection, tuple(range(len(arguments))))
    single = jax.jit(gradient)(*arguments)
    with jax.enable_x64(True):
        double, ahead, behind = jax.tree.map(
            np.asarray,
            jax.jit(lambda *x: (gradient(*x), along(1e-6, *x), along(-1e-6, *x)))(
                *(jnp.asarray(np.float64(x)) for x in arguments)
            ),
        )
    slope = sum(np.vdot(g, s) for g, s in zip(double, step, strict=True))
    scale = max(np.linalg.norm(g) for g in double)
    np.testing.assert_allclose((ahead - behind) / 2e-6, slope, rtol=1e-4, atol=1e-6 * scale)
    for s, d in zip(single, double, strict=True):
        close(s, d, rtol=rtol, atol=rtol * np.abs(d).max() + 1e-12)
