"""The error budget for people: what was measured, as one line, one table row and one panel per sweep."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from experiments.stability_sweeps import Axis, Kernel

ULP = 2.0**-23
INK, VALUE, GRADIENT, DOMAIN = "#1d2330", "#2457d6", "#d9480f", "#e8f3ea"
LOWEST, HIGHEST = 1e-9, 4.0  # smaller and larger errors are drawn here
COLUMNS = 3


@dataclass(frozen=True, kw_only=True)
class Point:
    """Errors at one value of a sweep, relative to the largest entry; infinity if something is not finite."""

    value: float
    value_max: float
    value_rms: float
    gradient_max: float
    gradient_rms: float
    finite: bool

    def error(self, judged: Sequence[str]) -> float:
        """The largest of the errors named."""
        return max(getattr(self, name) for name in judged)


@dataclass(frozen=True, kw_only=True)
class Curve:
    """What was measured along one axis, and the domain that follows from it (None: the usual value fails)."""

    kernel: Kernel
    axis: Axis
    points: tuple[Point, ...]
    domain: tuple[float, float] | None

    @property
    def inside(self) -> list[Point]:
        """Points of the domain; the usual one alone if there is none."""
        low, high = self.domain or (self.axis.usual, self.axis.usual)
        return [point for point in self.points if low <= point.value <= high]

    @property
    def beyond(self) -> list[Point]:
        """The points next to the domain on either side."""
        low, high = self.domain or (math.inf, -math.inf)
        below = [point for point in self.points if point.value < low]
        return (below[-1:] + [point for point in self.points if point.value > high][:1]) if self.domain else []


def number(x: float) -> str:
    """Short form of a swept value."""
    return f"{x:.0f}" if x == round(x) and x < 1e6 else f"{x:g}".replace("e+", "e").replace("e0", "e")


def error(x: float) -> str:
    """Short form of an error."""
    return "not finite" if math.isinf(x) else f"{x:.0e}".replace("e-0", "e-").replace("e+00", "")


def domain_text(curve: Curve) -> str:
    """The domain as an interval, with a sign where the sweep ended before the domain did."""
    if curve.domain is None:
        return "none"
    low, high = curve.domain
    start = "≤ " if low == curve.points[0].value else ""
    end = "≥ " if high == curve.points[-1].value else ""
    return f"{start}{number(low)} … {end}{number(high)}"


def beyond_text(curve: Curve) -> str:
    """What was measured next to the domain."""
    ends = ((p, p.error(curve.kernel.judged) if p.finite else math.inf) for p in curve.beyond)
    return ", ".join(f"{error(e)} at {number(p.value)}" for p, e in ends) or "–"


def row(curve: Curve) -> dict:
    """Everything about a sweep, for JSON."""
    return {
        "kernel": curve.kernel.name,
        "axis": curve.axis.name,
        "budget": curve.kernel.budget,
        "judged": curve.kernel.judged,
        "domain": curve.domain,
        "points": [{k: v if math.isfinite(v) else None for k, v in vars(p).items()} for p in curve.points],
    }


def line(curve: Curve) -> str:
    """One line for the terminal."""
    return f"{curve.kernel.name:30s} {curve.axis.name:28s} {domain_text(curve):24s} outside: {beyond_text(curve)}"


def table(curves: Sequence[Curve]) -> str:
    """Markdown: domain, largest errors in it, and what is outside."""
    lines = [
        "| kernel | along | domain | value max / rms, ulp | gradient max / rms, ulp | next outside |",
        "|---|---|---|---:|---:|---|",
    ]
    for curve in curves:
        worst = {
            kind: " / ".join(
                f"{max(p.error([f'{kind}_{how}']) for p in curve.inside) / ULP:.2g}" for how in ("max", "rms")
            )
            for kind in ("value", "gradient")
        }
        cells = (curve.kernel.name, curve.axis.name, domain_text(curve), *worst.values(), beyond_text(curve))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def plot(curves: Sequence[Curve]) -> bytes:
    """PNG of the curves of one figure: error over the swept value, the domain shaded."""
    rows = math.ceil(len(curves) / COLUMNS)
    figure = Figure((3.6 * COLUMNS, 2.7 * rows + 0.4), layout="constrained")
    for i, curve in enumerate(curves):
        panel(figure.add_subplot(rows, COLUMNS, i + 1), curve)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=9)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90, metadata={"Software": None})
    return stream.getvalue()


def panel(axes, curve: Curve) -> None:
    """One sweep."""
    x = np.array([p.value for p in curve.points])
    if x[0] == 0:
        axes.set_xscale("symlog", linthresh=x[1] / 10)
    else:
        axes.set_xscale("log")
    axes.set_yscale("log")
    if curve.domain and curve.domain[0] < curve.domain[1]:
        axes.axvspan(*curve.domain, color=DOMAIN, zorder=0)
    for kind, color in (("value", VALUE), ("gradient", GRADIENT)):
        for how, style in (("max", "-"), ("rms", ":")):
            y = np.array([p.error([f"{kind}_{how}"]) for p in curve.points])
            drawn = np.where(np.isfinite(y), np.clip(y, LOWEST, HIGHEST), np.nan)
            axes.plot(x, drawn, style, color=color, marker=".", markersize=4, linewidth=1.3, label=f"{kind}, {how}")
    lost = x[[not p.finite for p in curve.points]]
    axes.plot(lost, np.full(len(lost), 1.0), "x", color=INK, markersize=5, label="not finite")
    axes.axhline(curve.kernel.budget, color=INK, linewidth=0.8, linestyle="--", label="budget")
    axes.set_ylim(LOWEST / 2, 2 * HIGHEST)
    axes.set_title(curve.kernel.name, fontsize=9)
    axes.set_xlabel(curve.axis.name, fontsize=8)
    axes.set_ylabel("relative error", fontsize=7)
    axes.tick_params(labelsize=7)
    ulps = axes.secondary_yaxis("right", functions=(lambda y: y / ULP, lambda y: y * ULP))
    ulps.tick_params(labelsize=7)
    ulps.set_ylabel("ulp", fontsize=7)
