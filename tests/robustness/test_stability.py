"""The error budget: how far each kernel in float32 is from float64, value and gradient, over a wide range of inputs.

    make stability     every decade of every axis, with a table

A kernel runs, jitted, on the same numbers in float32 and in float64.  An error is relative to the largest entry of its
array, so 1.2e-7 is one unit in the last place of that entry.  In its domain every error stays below 1e-5 and nothing is
NaN or infinite, gradients included; the float64 run agrees with the twin.
"""

import functools
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surfel_sweeps import SURFEL_SWEEPS
from sweeps import SWEEPS, Sweep

BUDGET = 1e-5
AGREEMENT = 1e-9  # between the float64 run and the twin
FULL = "STABILITY" in os.environ


def values_of(sweep: Sweep) -> list[float]:
    """The ends of the domain and the usual value; every few decades between them where all is asked for."""
    ends = {sweep.low, sweep.usual, sweep.high}
    if FULL and sweep.low > 0:
        ends |= set(np.geomspace(sweep.low, sweep.high, 9).round(6 if sweep.high < 10 else 0 if sweep.low >= 1 else 50))
    return sorted(ends)


@functools.cache
def compiled(function):
    """Jitted (outputs, gradients of the outputs weighted by cotangents) of a kernel."""

    def outputs(*arguments):
        result = function(*arguments)
        return result if isinstance(result, tuple) else (result,)

    def run(arguments, cotangents):
        found, pull_back = jax.vjp(outputs, *arguments)
        return found, pull_back(tuple(jnp.asarray(c, o.dtype) for c, o in zip(cotangents, found, strict=True)))

    return outputs, jax.jit(run)


def error(ours, true, floors=()) -> float:
    """Largest error of the worst array, relative to its largest entry (at least its floor); infinite for NaN."""
    worst = 0.0
    for number, (a, b) in enumerate(zip(ours, true, strict=True)):
        a, b = np.float64(a), np.float64(b)
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            return np.inf
        scale = max(float(np.abs(b).max()), floors[number] if floors else 0.0)
        worst = max(worst, float(np.abs(a - b).max()) / (scale or 1.0))
    return worst


def measured(sweep: Sweep, value: float) -> tuple[float, float]:
    """Errors of value and gradient at one place of an axis, after a look at the twin."""
    rng = np.random.default_rng(0)
    single = tuple(np.asarray(x, np.float32) for x in sweep.inputs(rng, value))
    double = tuple(np.float64(x) for x in single)
    outputs, run = compiled(sweep.function)
    cotangents = tuple(rng.normal(size=shape.shape) for shape in jax.eval_shape(outputs, *single))
    ours, our_gradient = jax.device_get(run(single, cotangents))
    with jax.enable_x64(True):
        true, true_gradient = jax.device_get(run(double, cotangents))
    if sweep.twin is not None:
        assert error(true, sweep.twin(*double), sweep.floors) <= AGREEMENT
    return error(ours, true, sweep.floors), error(our_gradient, true_gradient)


@pytest.mark.ci
@pytest.mark.parametrize("sweep", SWEEPS + SURFEL_SWEEPS, ids=str)
def test_a_kernel_keeps_its_budget_in_its_domain(sweep):
    found = {value: measured(sweep, value) for value in values_of(sweep)}
    worst = {value: max(pair) for value, pair in found.items() if max(pair) > BUDGET}
    assert not worst, worst
    value, gradient = np.max(list(found.values()), axis=0) / 2.0**-23
    print(f"\n{sweep}: {sweep.low:g} to {sweep.high:g}: value {value:.2g}, gradient {gradient:.2g} ulp", end="")


def test_an_error_is_relative_to_the_largest_entry_or_to_the_floor_and_nan_is_infinite():
    true, ours = (np.array([4.0, 1.0]), np.array([0.0])), (np.array([4.0, 1.4]), np.array([0.0]))
    np.testing.assert_allclose([error(ours, true), error(ours, true, (40.0, 0.0))], [0.1, 0.01])
    assert error((np.array([np.nan]),), (np.array([1.0]),)) == np.inf


def test_the_measured_error_is_that_of_float32_and_a_wrong_twin_is_seen():
    def rounded(x):
        return x if x.dtype == jnp.float64 else x * (1 + 2.0**-12)

    sweep = Sweep(
        kernel="a", axis="b", low=1, usual=1, high=1, function=rounded, inputs=lambda rng, v: (rng.uniform(0.5, 1, 8),)
    )
    np.testing.assert_allclose(measured(sweep, 1), 2.0**-12, rtol=1e-3)
    with pytest.raises(AssertionError):
        measured(Sweep(**vars(sweep) | {"twin": lambda x: (x * (1 + 1e-8),)}), 1)
