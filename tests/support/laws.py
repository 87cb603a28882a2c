"""Laws that every kernel obeys, as checks that the tests call with their own kernels and numbers.

A kernel takes float arrays and returns an array or a tuple of arrays; `arguments` lead with batch axes (2, 3).
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import Phase, settings
from hypothesis import strategies as st


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


def adjoint_law(linear, x):
    """<A x, y> = <x, A^T y> to 1e-6 for a random y, summed in float64: a linear kernel and its gradient are adjoint."""
    out, transpose = jax.vjp(linear, x)
    y = numbers(1, *out.shape)
    (back,) = transpose(y)
    out, x, y, back = map(np.float64, (out, x, y, back))
    assert abs(np.vdot(out, y) - np.vdot(x, back)) <= 1e-6 * np.linalg.norm(out) * np.linalg.norm(y)


KINDS = ("spread", "mixed", "equal", "ties", "one-hot", "zeros")
TINY = 1e-37  # a float32 has all its digits above it
hypotheses = settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate, Phase.shrink],
)


@st.composite
def extremes(draw, *shape, low=-30, high=30, signed=True):
    """Float32 array: sizes between 10^low and 10^high, equal ones, ties, a single one, or zeros alone."""
    kind, exponent = draw(st.sampled_from(KINDS)), draw(st.integers(low, high))
    rng = np.random.default_rng(draw(st.integers(0, 999)))
    x = rng.uniform(-1 if signed else 0, 1, shape)
    if kind == "mixed":
        return np.float32(x * 10.0 ** rng.integers(low, high + 1, shape))
    if kind == "equal":
        x = np.full(shape, x.flat[0])
    elif kind == "ties":
        x = np.round(2 * x) / 2
    elif kind == "one-hot":
        x = x * (np.arange(shape[-1]) == rng.integers(shape[-1]))
    elif kind == "zeros":
        x = 0 * x
    return np.float32(x * 10.0**exponent)


@functools.cache
def _with_gradients(kernel):
    """Jitted outputs of a kernel and the gradients of a fixed projection of them."""

    def projected(*arguments):
        out = kernel(*arguments)
        leaves = jax.tree.leaves(out)
        rng = np.random.default_rng(2)
        return sum(jnp.vdot(jnp.asarray(rng.normal(size=x.shape), x.dtype), x) for x in leaves), out

    def both(*arguments):
        gradients, out = jax.grad(projected, tuple(range(len(arguments))), has_aux=True)(*arguments)
        return out, gradients

    return jax.jit(both)


def float64_law(kernel, *arguments, rtol=1e-3, floors=(0.0,) * 4):
    """Outputs of a kernel in float32, after a check of its gradients: finite, and float64's.

    They may be off by rtol times the largest gradient by that argument, or times its floor where rounding makes more
    noise than that.  Where float32 cannot hold a gradient nothing is asked.
    Zeros may as well be subnormal numbers.  One kernel is one function object, or it is compiled anew.
    """
    both = _with_gradients(kernel)
    out, gradients = jax.tree.map(np.asarray, both(*map(jnp.asarray, arguments)))
    with jax.enable_x64(True):
        _, doubles = jax.tree.map(np.asarray, both(*(jnp.asarray(np.float64(x)) for x in arguments)))
    nearly = both(*(jnp.asarray(np.where(np.asarray(x) == 0, np.float32(1e-40), x)) for x in arguments))
    close(nearly[0], out, atol=TINY)
    for single, double, subnormal, floor in zip(gradients, doubles, nearly[1], floors, strict=False):
        largest = np.abs(double).max()
        if largest < 1e37:
            assert np.isfinite(subnormal).all()
            close(single, double, rtol=rtol, atol=rtol * max(largest, floor) + TINY)
    return out
