"""The error budget: how far each kernel in float32 is from float64, value and gradient, over the whole range of inputs.

    python -m experiments.stability [--out runs/stability] [--quick] [--only KERNEL ...]

Each point of a sweep runs one kernel, jitted, on the same numbers in float32 and in float64, and compares every output
and the gradient of a random projection of the outputs by every input.  An error is relative to the largest entry of its
array, so 2^-23 (1.2e-7) is one unit in the last place (ulp) of that entry.  The domain of a kernel along an axis is the
longest run of swept values around the usual one in which no number is NaN or infinite and the errors keep the budget.
Where a twin in NumPy is given, the float64 run has to agree with it, else the script stops.

    OUT/stability.json  stability.md  stability_FIGURE.png
"""

import functools
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import stability_report as report
from experiments.stability_report import Curve, Point
from experiments.stability_sweeps import FIGURES, Axis, Kernel
from spnr_jax import cli
from spnr_jax.formats.images import write_whole

AGREEMENT = 1e-9  # between the float64 run and the NumPy twin


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure the error of every kernel against float64 and write the table and the plots."""

    out: Path = Path("runs/stability")
    """Folder of stability.json, stability.md and the plots."""
    quick: bool = False
    """Only the usual and the outermost values of each axis."""
    only: tuple[str, ...] = ()
    """Names of kernels to measure (default: all)."""
    seed: int = 0
    """Seed of the inputs."""


def main(options: Options) -> None:
    """Measures, prints one line per sweep, writes table and plots."""
    names = [kernel.name for kernels in FIGURES.values() for kernel in kernels]
    for name in options.only:
        if name not in names:
            raise ValueError(f"--only {name}: no such kernel; known: {', '.join(names)}")
    start, curves = time.monotonic(), []
    for figure, kernels in FIGURES.items():
        here = []
        for kernel in kernels:
            for axis in kernel.axes if not options.only or kernel.name in options.only else ():
                here.append(sweep(kernel, axis, options.seed, options.quick))
                print(report.line(here[-1]), flush=True)
        if here:
            write_whole(options.out / f"stability_{figure}.png", report.plot(here))
        curves += here
    setting = {
        "hardware": f"{os.cpu_count()} cores {platform.machine()}, {jax.default_backend()}, jax {jax.__version__}",
        "date": time.strftime("%Y-%m-%d"),
        "seed": options.seed,
    }
    results = {**setting, "sweeps": [report.row(curve) for curve in curves]}
    write_whole(options.out / "stability.json", (json.dumps(results, indent=1) + "\n").encode())
    write_whole(options.out / "stability.md", report.table(curves).encode())
    print(f"{len(curves)} sweeps in {time.monotonic() - start:.0f} s; tables and plots in {options.out}")


def sweep(kernel: Kernel, axis: Axis, seed: int, quick: bool) -> Curve:
    """The errors of a kernel along an axis, and the domain that follows from them."""
    values = sorted({*axis.values, axis.usual})
    if quick:
        values = sorted({values[0], axis.usual, values[-1]})
    points = tuple(measure(kernel, axis, value, seed) for value in values)
    good = [point.finite and point.error(kernel.judged) <= kernel.budget for point in points]
    return Curve(kernel=kernel, axis=axis, points=points, domain=domain(values, good, axis.usual))


def domain(values: Sequence[float], good: Sequence[bool], usual: float) -> tuple[float, float] | None:
    """First and last value of the run of good ones around the usual one; None if that one is not good."""
    first = last = values.index(usual)
    if not good[first]:
        return None
    while first > 0 and good[first - 1]:
        first -= 1
    while last + 1 < len(values) and good[last + 1]:
        last += 1
    return values[first], values[last]


def measure(kernel: Kernel, axis: Axis, value: float, seed: int) -> Point:
    """Errors of a kernel at one value of its axis."""
    rng = np.random.default_rng(seed)
    single = tuple(np.asarray(x, np.float32) for x in axis.inputs(rng, value))
    double = tuple(np.float64(x) for x in single)
    run, options = compiled(kernel.function, tuple(axis.options(value).items())), axis.options(value)
    shapes = jax.eval_shape(lambda *x: outputs_of(kernel.function(*x, **options)), *single)
    cotangents = tuple(rng.normal(size=shape.shape) for shape in shapes)
    ours, our_gradient = jax.device_get(run(single, cotangents))
    with jax.enable_x64(True):
        true, true_gradient = jax.device_get(run(double, cotangents))
    floors = kernel.floors or (0.0,) * len(true)
    if kernel.twin is not None:
        difference, _ = errors(true, kernel.twin(*double, **options), floors)
        if not difference <= AGREEMENT:
            raise AssertionError(f"{kernel.name} in float64, {axis.name} {value:g}: {difference:.1e} from its twin")
    value_max, value_rms = errors(kernel.score(single, ours), kernel.score(single, true), floors)
    gradient_max, gradient_rms = errors(our_gradient, true_gradient, (0.0,) * len(true_gradient))
    return Point(
        value=value,
        value_max=value_max,
        value_rms=value_rms,
        gradient_max=gradient_max,
        gradient_rms=gradient_rms,
        finite=all(np.isfinite(x).all() for x in (*ours, *our_gradient)),
    )


@functools.cache
def compiled(function: Callable, options: tuple) -> Callable:
    """Jitted (outputs, gradients) of a kernel with fixed options, the outputs weighted as the cotangents say."""

    def run(arguments, cotangents):
        outputs, pull_back = jax.vjp(lambda *x: outputs_of(function(*x, **dict(options))), *arguments)
        return outputs, pull_back(tuple(jnp.asarray(c, o.dtype) for c, o in zip(cotangents, outputs, strict=True)))

    return jax.jit(run)


def outputs_of(result) -> tuple:
    """What a kernel returns, as a tuple."""
    return result if isinstance(result, tuple) else (result,)


def errors(ours: Sequence, true: Sequence, floors: Sequence[float]) -> tuple[float, float]:
    """Largest and root-mean-square error of the worst array, relative to its largest entry (at least its floor)."""
    largest, mean_square = 0.0, 0.0
    for a, b, floor in zip(ours, true, floors, strict=True):
        a, b = np.float64(a), np.float64(b)
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            return math.inf, math.inf
        scale = max(float(np.abs(b).max()), floor)
        error = np.abs(a - b) / (scale or 1.0)
        largest, mean_square = max(largest, float(error.max())), max(mean_square, float(np.mean(error**2)))
    return largest, math.sqrt(mean_square)


if __name__ == "__main__":
    sys.exit(cli.guarded(lambda: main(tyro.cli(Options, prog="python -m experiments.stability")), "stability"))
