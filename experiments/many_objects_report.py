"""What experiments.many_objects found, as a table and as curves."""

import io

import numpy as np

LABELS = {
    "loop": "Python loop",
    "vmap": "jax.vmap",
    "map": "jax.lax.map",
    "batch": "batch axis",
}
COLORS = ("#2457d6", "#d9480f", "#2f9e44", "#9c36b5", "#0b7285", "#e8a700", "#868e96", "#1d2330")


def gain(seconds: dict[str, list[float]], form: str) -> tuple[float, float, float]:
    """How many times as fast as the loop a form is: median, least and most over the rounds."""
    ratios = np.array(seconds["loop"]) / np.array(seconds[form])
    return float(np.median(ratios)), float(ratios.min()), float(ratios.max())


def table(results: dict) -> str:
    """Markdown: the pace of every form, and how far it lies from the loop."""
    runs, objects = results["runs"], results["objects"]
    lines = [f"| {runs} runs at once | steps of a run a second | times the loop |", "|---|---:|---:|"]
    for phase, seconds in results["pace"].items():
        lines += [
            f"| {LABELS[form]}, {phase} | {runs / np.median(seconds[form]):.2f} | {ratio(seconds, form)} |"
            for form in seconds
        ]
    lines += ["", f"| {objects} objects at once | views a second | times the loop | pixel off by at most |"]
    lines.append("|---|---:|---:|---:|")
    seconds, off = results["render"]["seconds"], results["render"]["largest difference of a pixel"]
    lines += [
        f"| {LABELS[form]} | {objects / np.median(seconds[form]):.1f} | {ratio(seconds, form)} | {off[form]:.1e} |"
        for form in seconds
    ]
    lines += [
        "",
        f"| {results['steps']} steps against the loop | first loss | any loss | parameters, largest | median |",
    ]
    lines.append("|---|---:|---:|---:|---:|")
    for form, found in results["apart from the loop"].items():
        values = (found[name] for name in ("first loss", "losses", "largest", "median"))
        lines.append(f"| {LABELS[form]} | {' | '.join(f'{value:.1e}' for value in values)} |")
    note = (
        f"Preset {results['preset']}, {results['parameters']:,} parameters, {results['batch objects']} objects a step; "
        f"seeds {results['seed']} to {results['seed'] + runs - 1}; {results['hardware']}. Forms take turns, "
        f"{results['rounds']} rounds; medians, in brackets the least and the most. Differences are relative: "
        "|a - b| / |b| of a loss, the same of the norms of a parameter array of a run."
    )
    return "\n".join([*lines, "", note, ""])


def ratio(seconds: dict[str, list[float]], form: str) -> str:
    """A gain as a cell."""
    middle, low, high = gain(seconds, form)
    return "1" if form == "loop" else f"{middle:.2f} ({low:.2f} to {high:.2f})"


def plot(results: dict) -> bytes:
    """PNG: the loss curves of all runs, by the loop and by vmap, and the gains."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), layout="constrained")
    curves, bars = figure.subplots(1, 2, width_ratios=(2, 1))
    steps = np.arange(1, results["steps"] + 1)
    losses = {form: np.array(found) for form, found in results["losses"].items()}
    for run in range(results["runs"]):
        color, seed = COLORS[run % len(COLORS)], results["seed"] + run
        curves.plot(steps, losses["loop"][:, run], color=color, lw=1, label=f"seed {seed}")
        curves.plot(steps, losses["vmap"][:, run], ".", color=color, ms=3)
    curves.set_title("lines: Python loop, dots: vmap", fontsize=10)
    curves.set_xlabel("step")
    curves.set_ylabel("loss")
    curves.set_yscale("log")
    curves.legend(fontsize=7, frameon=False, ncols=2)
    timed = {"training": next(iter(results["pace"].values())), "rendering": results["render"]["seconds"]}
    rows = [(f"{what}: {LABELS[form]}", *gain(found, form)) for what, found in timed.items() for form in found]
    middles = np.array([row[1] for row in rows])
    bars.barh([row[0] for row in rows], middles, color="#a8b3c7")
    bars.errorbar(
        middles,
        range(len(rows)),
        xerr=[[row[1] - row[2] for row in rows], [row[3] - row[1] for row in rows]],
        fmt="none",
        color="#1d2330",
        lw=1,
    )
    bars.axvline(1, color="#1d2330", lw=0.8)
    bars.invert_yaxis()
    bars.set_xlabel("throughput, times the loop's")
    for axes in (curves, bars):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.2)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()
