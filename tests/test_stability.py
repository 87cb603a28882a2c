"""The error budget: domains end where an error or a number that is not finite begins, and the kernels have theirs."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.stability import Options, domain, errors, main, measure, sweep
from experiments.stability_sweeps import FIGURES, Axis, Kernel, decades


def scaled(rng, value):
    return (value * rng.uniform(0.5, 1, 8),)


WITHOUT_DOMAIN = {"volume_weights if in bfloat16", "discriminator, bfloat16"}  # bfloat16 rounds by more than 1e-3
SIZE = Axis("size", decades(-30, 30, 10), 1.0, scaled)


def rows_of(folder):
    return json.loads((folder / "stability.json").read_text())["sweeps"]


def inside(row):
    low, high = row["domain"]
    return [point for point in row["points"] if low <= point["value"] <= high]


def check(rows):
    """Every kernel but those named has a domain; in it all is finite and every judged error within budget."""
    for row in rows:
        if row["kernel"] in WITHOUT_DOMAIN:
            continue
        assert row["domain"] is not None, row["kernel"]
        for point in inside(row):
            assert point["finite"]
            assert max(point[name] for name in row["judged"]) <= row["budget"]


def test_a_quick_run_ends_with_table_plot_and_domains_that_hold(tmp_path, capsys):
    main(Options(out=tmp_path, quick=True, only=("expected_distance", "l1")))
    assert {path.name for path in tmp_path.iterdir()} == {
        "stability.json",
        "stability.md",
        "stability_light.png",
        "stability_losses.png",
    }
    rows = rows_of(tmp_path)
    assert [row["kernel"] for row in rows] == ["expected_distance", "expected_distance", "l1"]
    check(rows)
    assert all(len(row["points"]) == 3 for row in rows)
    assert (tmp_path / "stability.md").read_text().count("\n") == 2 + len(rows)
    assert capsys.readouterr().out.splitlines()[-1].startswith("3 sweeps")


@pytest.mark.slow
def test_every_kernel_has_a_domain_and_keeps_its_budget_in_it(tmp_path):
    main(Options(out=tmp_path, quick=True))
    rows = rows_of(tmp_path)
    assert {row["kernel"] for row in rows} == {kernel.name for kernels in FIGURES.values() for kernel in kernels}
    check(rows)


def test_the_domain_is_the_unbroken_run_of_good_values_around_the_usual_one():
    values = [1, 2, 3, 4, 5]
    assert domain(values, [True, False, True, True, False], 3) == (3, 4)
    assert domain(values, [True] * 5, 5) == (1, 5)
    assert domain(values, [True, True, False, True, True], 3) is None


def test_a_domain_ends_where_a_gradient_alone_is_not_finite():
    curve = sweep(Kernel("inverse", lambda x: 1 / x, (SIZE,)), SIZE, seed=0, quick=False)
    assert curve.domain == (1e-10, 1e10)  # 1e20: 1 / x^2 is subnormal; 1e-20: it overflows
    assert [point.finite for point in curve.points] == [False, False, True, True, True, True, True]


def test_an_error_is_relative_to_the_largest_entry_or_to_the_floor_and_nan_is_infinite():
    true = (np.array([4.0, 1.0]), np.array([0.0, 1e-9]))
    ours = (np.array([4.0, 1.4]), np.array([0.0, 1e-9]))
    np.testing.assert_allclose(errors(ours, true, (0.0, 0.0)), (0.1, 0.1 / np.sqrt(2)), rtol=1e-12)
    np.testing.assert_allclose(errors(ours, true, (40.0, 0.0))[0], 0.01, rtol=1e-12)
    assert errors((np.array([np.nan]),), (np.array([1.0]),), (0.0,)) == (np.inf, np.inf)


def test_the_measured_error_is_that_of_float32():
    def rounded(x):
        return x if x.dtype == jnp.float64 else x * (1 + 2.0**-12)

    point = measure(Kernel("rounded", rounded, (SIZE,)), SIZE, 1.0, seed=0)
    np.testing.assert_allclose([point.value_max, point.gradient_max], 2.0**-12, rtol=1e-3)


def test_a_float64_run_that_is_not_its_twin_stops_the_script():
    kernel = Kernel("square", lambda x: x**2, (SIZE,), twin=lambda x: (x**2 * (1 + 1e-8),))
    with pytest.raises(AssertionError, match="square in float64, size 1: 1.0e-08 from its twin"):
        measure(kernel, SIZE, 1.0, seed=0)


def test_an_unknown_kernel_is_named(tmp_path):
    with pytest.raises(ValueError, match="--only softmax: no such kernel; known: camera_rays"):
        main(Options(out=tmp_path, only=("softmax",)))
