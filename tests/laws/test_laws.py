"""Every function of the table obeys the laws: float64, twin, central differences, batches, extremes.

    make stability     every decade of every axis, with a table

A function runs, jitted, on the same numbers in float32 and in float64.  An error is relative to the largest entry of
its array, so 1.2e-7 is one unit in the last place of that entry.  In its domain every error stays below 1e-5 and
nothing is NaN or infinite, gradients included; the float64 run agrees with the twin.
"""

import os

import jax
import jax.numpy as jnp
import kernel_laws
import numpy as np
import paper_laws
import pytest
import surfel_laws
from hypothesis import given, strategies as st
from support.laws import Axis, Law, batch_law, close, extremes_law, hypotheses, in_both_precisions, points_law

TABLE = (*surfel_laws.LAWS, *kernel_laws.LAWS, *paper_laws.LAWS)
SWEEPS = [(law, axis) for law in TABLE for axis in law.axes if axis.low < axis.high]
FULL = "STABILITY" in os.environ


def table(*fields):
    """The rows that have a field, under their names."""
    rows = [law for law in TABLE if not fields or any(getattr(law, field) not in ((), None) for field in fields)]
    return pytest.mark.parametrize("law", rows, ids=lambda law: law.name)


def inputs(law, axis=0):
    """A function's arguments at the usual value of an axis, in float32."""
    axis = law.axes[axis]
    return tuple(jnp.asarray(np.asarray(x), jnp.float32) for x in axis.inputs(np.random.default_rng(0), axis.usual))


def values_of(axis: Axis) -> list[float]:
    """The ends of the domain; every few decades between them where all is asked for."""
    ends = {axis.low, axis.high}
    if FULL and axis.low > 0:
        digits = 6 if axis.high < 10 else 0 if axis.low >= 1 else 50
        ends |= {axis.usual, *np.geomspace(axis.low, axis.high, 9).round(digits)}
    return sorted(ends)


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


def measured(law: Law, axis: Axis, value: float, differences: bool = False) -> tuple[float, float]:
    """Errors of value and gradient at one place of an axis, after a look at the twin."""
    arguments = axis.inputs(np.random.default_rng(0), value)
    ours, true = in_both_precisions(law.function, arguments, differences=differences)
    if law.twin is not None:
        twin = jax.tree.leaves(law.twin(*(np.float64(np.float32(x)) for x in arguments)))
        assert error(true[0], twin, law.floors) <= law.agreement
    return error(ours[0], true[0], law.floors), error(ours[1], true[1])


@table("twin", "shared")
def test_values_are_the_twins_and_gradients_central_differences_and_float32_is_near(law):
    assert max(measured(law, law.axes[0], law.axes[0].usual, law.smooth)) <= law.budget


@pytest.mark.ci
@pytest.mark.parametrize(("law", "axis"), SWEEPS, ids=[f"{law.name}, {axis.name}" for law, axis in SWEEPS])
def test_a_function_keeps_its_budget_in_its_domain(law, axis):
    found = {value: measured(law, axis, value) for value in values_of(axis)}
    worst = {value: max(pair) for value, pair in found.items() if max(pair) > law.budget}
    assert not worst, worst
    value, gradient = np.max(list(found.values()), axis=0) / 2.0**-23
    row = f"{law.name}, {axis.name}: {axis.low:g} to {axis.high:g}"
    print(f"\n{row}: value {value:.2g}, gradient {gradient:.2g} ulp", end="")


@table("core")
def test_jit_vmap_and_every_batch_rank_are_the_loop(law):
    arguments = [
        x if core is None else x.reshape(-1, *x.shape[x.ndim - core :])[:6].reshape(2, 3, *x.shape[x.ndim - core :])
        for x, core in zip(inputs(law), law.core, strict=True)
    ]
    batch_law(law.function, *arguments, core=law.core)


@table("shared")
def test_points_do_not_see_each_other_nor_their_order_nor_padding(law):
    points_law(law.function, *inputs(law), shared=law.shared)


@table("extremes")
def test_inputs_that_nobody_meant_to_give_have_the_twins_values_and_finite_gradients(law):
    told = law.extremes

    @hypotheses
    @given(st.tuples(*told.arguments))
    def holds(drawn):
        arguments = drawn[0] if isinstance(drawn[0], tuple) else drawn
        arguments = tuple(np.asarray(x, np.float32) for x in arguments)
        floors = told.floors(*arguments) if callable(told.floors) else told.floors
        out = extremes_law(law.function, arguments, floors)
        if told.twin:
            expected = jax.tree.leaves(law.twin(*map(np.float64, arguments)))
            slack = told.atol(*arguments)
            for i, (found, wanted) in enumerate(zip(out, expected, strict=True)):
                close(found, wanted, rtol=told.rtol, atol=slack[i] if isinstance(slack, tuple) else slack)
        if told.check:
            told.check(arguments, out)

    holds()


def test_the_error_of_float32_a_wrong_twin_and_a_wrong_gradient_are_seen():
    def rounded(x):
        return x if x.dtype == jnp.float64 else x * (1 + 2.0**-12)

    axis = Axis("a", 1, 1, 1, lambda rng, v: (rng.uniform(0.5, 1, 8),))
    np.testing.assert_allclose(measured(Law("b", rounded, None, (axis,)), axis, 1), 2.0**-12, rtol=1e-3)
    with pytest.raises(AssertionError):
        measured(Law("b", rounded, lambda x: x * (1 + 1e-8), (axis,)), axis, 1)
    with pytest.raises(AssertionError):
        in_both_precisions(lambda x: x**2 + jax.lax.stop_gradient(x), (np.arange(1.0, 4.0),), differences=True)
