"""What experiments.long_run found, in lines and as curves."""

import io

import numpy as np

INK, GREY, RED = "#2457d6", "#a8b3c7", "#d9480f"


def table(results: dict) -> str:
    """A line for each law, and one for each cause of compilations."""
    lines = [f"{'held' if law['held'] else 'NOT HELD'}: {law['name']}, {law['found']}" for law in results["laws"]]
    causes: dict[tuple[str, int], list[dict]] = {}
    for one in results["compilations"]:
        causes.setdefault((one["cause"], one["step"]), []).append(one)
    lines += [
        f"compiled at step {step} by {cause}: {len(found)} programs, {sum(x['seconds'] for x in found):.1f} s"
        for (cause, step), found in causes.items()
    ]
    lines += [f"steps {first} to {last}: {pace:.0f} ms a step" for first, last, pace in hundreds(results["samples"])]
    return "\n".join([*lines, f"{results['last step']} steps in {results['seconds']:.0f} s; {results['hardware']}"])


def hundreds(samples: list[dict]) -> list[tuple[int, int, float]]:
    """(first, last, median milliseconds of a step) of every hundred steps."""
    found: dict[int, list[float]] = {}
    for sample in samples:
        if sample["ms_per_step"] is not None:
            found.setdefault((sample["step"] - 1) // 100, []).append(sample["ms_per_step"])
    return [(100 * i + 1, 100 * (i + 1), float(np.median(values))) for i, values in found.items()]


def plot(results: dict) -> bytes:
    """PNG: memory and milliseconds of a step over the steps, with the stretches that count."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6), layout="constrained")
    memory, pace = figure.subplots(2, 1, sharex=True)
    samples = results["samples"]
    timed, quiet = ([x for x in samples if (x["ms_per_step"] is None) == kind] for kind in (False, True))
    for rows, style, label in (
        (timed, {"marker": ".", "ms": 4, "ls": "", "color": GREY}, "between two steps"),
        (quiet, {"color": INK, "lw": 1.5}, "after a preview"),
    ):
        memory.plot([x["step"] for x in rows], [x["memory"] for x in rows], label=label, **style)
    pace.plot([x["step"] for x in timed], [x["ms_per_step"] for x in timed], ".", color=GREY, ms=4, label="a row")
    middle = [(0.5 * (first + last), value) for first, last, value in hundreds(samples)]
    pace.plot(*zip(*middle, strict=True), color=INK, lw=1.5, label="median of a hundred steps")
    memory.set_ylabel("resident memory, MB")
    memory.set_ylim(0)
    pace.set_ylabel("ms a step")
    pace.set_xlabel("step")
    pace.set_ylim(0, 2 * float(np.median([x["ms_per_step"] for x in timed])))  # rows with a compilation lie far above
    for axes in (memory, pace):
        for first, last in results["stretches"]:
            if first < last:
                axes.axvspan(first, last, color=GREY, alpha=0.15, lw=0)
        axes.legend(frameon=False, fontsize=8, loc="lower right")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.2)
    for step in {x["step"] for x in results["compilations"] if x["step"] > 1}:
        memory.axvline(step, color=RED, lw=0.8, ls=":")
    memory.set_title("grey: the stretches that count; dotted: something was compiled for the first time", fontsize=10)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()
