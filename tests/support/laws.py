"""Laws that every function obeys, and the rows of the table from which tests/laws makes their tests.

A function takes float arrays and returns an array or a tree of arrays.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import Phase, settings, strategies as st


def numbers(seed: int, *shape: int, low: float = -1.0) -> jax.Array:
    """Uniform float32 numbers below 1 from a literal seed."""
    return jnp.asarray(np.random.default_rng(seed).uniform(low, 1.0, shape), jnp.float32)


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


@dataclass(frozen=True)
class Axis:
    """One way through a function's domain: where it begins and ends, and arguments (float64) at a value."""

    name: str
    low: float
    usual: float
    high: float
    inputs: Callable  # (generator of random numbers, value) -> arguments


@dataclass(frozen=True)
class Extremes:
    """Arguments that nobody meant to give, and how near the float32 outputs stay to the twin."""

    arguments: tuple[st.SearchStrategy, ...]
    floors: tuple[float, ...] | Callable = ()  # smallest scales that errors of the gradients are relative to
    rtol: float = 1e-6
    atol: Callable = lambda *arguments: TINY
    check: Callable | None = None  # (arguments, outputs): what else holds, or instead of a twin
    twin: bool = True


@dataclass(frozen=True)
class Law:
    """A row of the table: a function, its plain twin, its domain, and which axes of its arguments are a batch."""

    name: str
    function: Callable
    twin: Callable | None  # float64 NumPy of the same arguments
    axes: tuple[Axis, ...]
    core: tuple[int | None, ...] = ()  # axes of one item of each argument, those before are a batch; None: shared
    extremes: Extremes | None = None
    shared: int | None = None  # so many arguments belong to all points, the others have points as their last axis
    floors: tuple[float, ...] = ()  # smallest scale that each output's error is relative to
    smooth: bool = True  # its gradient is that of central differences
    budget: float = 1e-5  # largest error of float32
    agreement: float = 1e-9  # of float64 with the twin


@functools.cache
def compiled(function):
    """Outputs of a function as a tuple of arrays, and (outputs, gradients for cotangents), jitted."""

    def outputs(*arguments):
        return tuple(jax.tree.leaves(function(*arguments)))

    @jax.jit
    def run(arguments, cotangents):
        found, pull_back = jax.vjp(outputs, *arguments)
        return found, pull_back(tuple(jnp.asarray(c, o.dtype) for c, o in zip(cotangents, found, strict=True)))

    return outputs, run


def in_both_precisions(function, arguments, seed=1, differences=False):
    """(outputs, gradients) of a random projection in float32 and in float64, after a look at central differences."""
    outputs, run = compiled(function)
    single = tuple(np.asarray(x, np.float32) for x in arguments)
    double, rng = tuple(np.float64(x) for x in single), np.random.default_rng(seed)
    cotangents = tuple(rng.normal(size=x.shape) for x in jax.eval_shape(outputs, *single))
    ours = jax.device_get(run(single, cotangents))
    with jax.enable_x64(True):
        true = jax.device_get(run(double, cotangents))
        if differences:
            way = [1e-6 * (np.abs(x).max() or 1) * rng.normal(size=x.shape) for x in double]
            ends = (run(tuple(x + s * w for x, w in zip(double, way, strict=True)), cotangents)[0] for s in (1, -1))
            ahead, behind = (sum(np.vdot(c, x) for c, x in zip(cotangents, end, strict=True)) for end in ends)
            slope = sum(np.vdot(g, w) for g, w in zip(true[1], way, strict=True))
            scale = max(np.linalg.norm(g) * np.linalg.norm(w) for g, w in zip(true[1], way, strict=True))
            np.testing.assert_allclose((ahead - behind) / 2, slope, rtol=1e-4, atol=1e-5 * scale)
    return ours, true


def batch_law(function, *arguments, core):
    """Eager = jit, and batch ranks () and (3,), vmap and the loop all agree with rank (2, 3) of the arguments.

    Arguments whose entry of `core` is None are shared by the whole batch.
    """

    def each(pick):
        return [x if c is None else pick(x) for x, c in zip(arguments, core, strict=True)]

    whole = jax.tree.map(np.asarray, function(*arguments))
    one, axes = jax.jit(function), tuple(None if c is None else 0 for c in core)

    @jax.jit
    def every_way(arguments, row):
        return function(*arguments), jax.vmap(jax.vmap(function, axes), axes)(*arguments), function(*row)

    jitted, mapped, row = every_way(arguments, each(lambda x: x[1]))
    close((jitted, mapped), (whole, whole))
    close(row, jax.tree.map(lambda x: x[1], whole))
    for place in np.ndindex(2, 3):
        single = one(*each(lambda x, place=place: jnp.asarray(np.asarray(x)[place])))
        close(single, jax.tree.map(lambda x, place=place: x[place], whole))


def points_law(function, *arguments, shared):
    """Points (the last axis) do not see each other: not their order, nor padding; and vmap is the loop."""
    fixed, columns = arguments[:shared], arguments[shared:]
    order = np.random.default_rng(1).permutation(columns[0].shape[-1])
    turned = [x[..., order] for x in columns]
    mapped = jax.vmap(function, (None,) * shared + (0,) * len(columns))

    @jax.jit
    def every_way(fixed, columns, pairs):
        return function(*fixed, *columns), mapped(*fixed, *pairs), function(*fixed, *(x[..., :5] for x in columns))

    whole, both, few = every_way(fixed, columns, [jnp.stack(pair) for pair in zip(columns, turned, strict=True)])
    close(jax.tree.map(lambda x: x[0], both), whole)
    close(jax.tree.map(lambda x: x[1], both), jax.tree.map(lambda x: x[..., order], whole))
    close(few, jax.tree.map(lambda x: x[..., :5], whole))


KINDS = ("spread", "mixed", "equal", "ties", "one-hot", "zeros")
TINY = 1e-37  # a float32 has all its digits above it
hypotheses = settings(
    max_examples=30,
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


@st.composite
def sorted_distances(draw, *shape):
    """Of one size, which is any; some have ties, some are all equal."""
    parts = draw(st.sampled_from([1, 4, 1000]))
    x = np.round(parts * np.random.default_rng(draw(st.integers(0, 999))).random(shape)) / parts
    return np.float32(np.sort(x, axis=-1) * 10.0 ** draw(st.integers(-30, 30)))


def extremes_law(function, arguments, floors=()):
    """Outputs of a function in float32 (a tuple), after a check of its gradients: finite, and float64's to 1e-3.

    They may be off by that share of the largest gradient by that argument, or of its floor where rounding makes more
    noise.  Where float32 cannot hold a gradient nothing is asked.  Zeros may as well be subnormal numbers.
    """
    (out, gradients), (_, doubles) = in_both_precisions(function, arguments, seed=2)
    subnormal = [np.where(np.asarray(x) == 0, np.float32(1e-40), x) for x in arguments]
    _, run = compiled(function)
    rng = np.random.default_rng(2)
    nearly = jax.device_get(run(tuple(subnormal), tuple(rng.normal(size=x.shape) for x in out)))
    close(nearly[0], out, atol=TINY)
    floors = floors or (0.0,) * len(gradients)
    for single, double, other, floor in zip(gradients, doubles, nearly[1], floors, strict=True):
        largest = np.abs(double).max()
        if not largest >= 1e37:
            assert np.isfinite(other).all()
            close(single, double, rtol=1e-3, atol=1e-3 * max(largest, floor) + TINY)
    return out
