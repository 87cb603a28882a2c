"""What experiments.chaos found: results.json and kills.csv for programs, chaos.md and chaos.png for people."""

import csv
import io
import json
from pathlib import Path

import numpy as np

from experiments.chaos_child import PHASES
from spnr_jax.formats.images import write_whole

COLORS = {
    "start": "#868e96", "step": "#2457d6", "log": "#2f9e44", "checkpoint": "#d9480f", "preview": "#9c36b5",
}  # fmt: skip


def write(out: Path, results: dict) -> None:
    """All four files."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, results["kills"][0].keys())
    writer.writeheader()
    writer.writerows(results["kills"])
    write_whole(out / "results.json", (json.dumps(results, indent=1, allow_nan=False) + "\n").encode())
    write_whole(out / "kills.csv", stream.getvalue().encode())
    write_whole(out / "chaos.md", table(results).encode())
    write_whole(out / "chaos.png", plot(results))


def verdict(results: dict) -> tuple[str, bool]:
    """The last line, and whether nothing was lost: the kills of one training are survived together or not at all."""
    faults = [fault for fault in results["faults"] if fault["verdict"] != "skipped"]
    skipped = len(results["faults"]) - len(faults)
    same = all(results["same"].values()) and results["ended"] == 0
    survived = len(results["kills"]) * same + sum(fault["verdict"] == "survived" for fault in faults)
    count = len(results["kills"]) + len(faults)
    more = f", {skipped} skipped" if skipped else ""
    line = f"{survived} of {count} faults survived ({len(results['kills'])} kills, {len(faults)} others{more})"
    return line, survived == count


def table(results: dict) -> str:
    """Markdown: kills by phase, what is the same in both trainings, and every other fault."""
    kills = results["kills"]
    lines = [
        f"{verdict(results)[0]}.",
        "",
        "| killed in | kills | aimed at it | half a checkpoint there | rows written again | steps trained again |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    next_begun = [kill["begun"] for kill in kills[1:]] + [results["last begun"]]
    again = [max(kill["step"] - step, 0) for kill, step in zip(kills, next_begun, strict=True)]
    for phase in PHASES:
        here = [i for i, kill in enumerate(kills) if kill["phase"] == phase]
        row = [
            len(here),
            sum(kill["aimed"] == phase for kill in kills),
            sum(kills[i]["unfinished"] for i in here),
            sum(kills[i]["doomed_rows"] for i in here),
            sum(again[i] for i in here),
        ]
        lines.append(f"| {phase} | {' | '.join(map(str, row))} |")
    lines += ["", "| the same in both trainings, bit by bit | |", "|---|---|"]
    lines += [f"| {what} | {'yes' if same else 'NO'} |" for what, same in results["same"].items()]
    if results["faults"]:
        lines += ["", "| fault | | exit code | what it said | s |", "|---|---|---:|---|---:|"]
    for fault in results["faults"]:
        said = "; ".join(text for text in (fault["line"], fault["note"]) if text).replace("|", "/")
        code = "" if fault["verdict"] == "skipped" else fault["code"]
        lines.append(f"| {fault['name']} | {fault['verdict']} | {code} | {said} | {fault['seconds']:.0f} |")
    note = (
        f"{results['steps']} steps, a checkpoint every {results['checkpoint_every']}, a row every "
        f"{results['log_every']}; seed {results['seed']}; {results['hardware']}; "
        f"{results['seconds'] / 60:.0f} minutes for the kills. The metrics file is compared without the milliseconds "
        "that a step took."
    )
    return "\n".join([*lines, "", note, ""])


def plot(results: dict) -> bytes:
    """PNG: how far each start of the killed training came, and in which phase it was killed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    axes = figure.subplots()
    kills = results["kills"]
    numbers, begun, steps = (np.array([kill[name] for kill in kills]) for name in ("number", "begun", "step"))
    axes.vlines(numbers, begun, steps, color="#a8b3c7", lw=1.5)
    axes.vlines(len(kills) + 1, results["last begun"], results["steps"], color="#1d2330", lw=1.5)
    axes.plot(len(kills) + 1, results["steps"], "s", color="#1d2330", ms=5, label="trained to the end")
    for phase in PHASES:
        here = np.array([kill["phase"] == phase for kill in kills])
        if here.any():
            axes.plot(numbers[here], steps[here], "o", color=COLORS[phase], ms=5, label=f"{here.sum()} in: {phase}")
    axes.set_xlabel("start of the command; each bar from the step that it went on at to the one where it was killed")
    axes.set_ylabel("training step")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.2)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()
