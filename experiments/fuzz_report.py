"""What experiments/fuzz.py found, as a table and a picture: a row and a bar a reader."""

import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from spnr_jax.formats.images import write_whole

COLORS = {"read": "#2457d6", "refused": "#a8b3c7", "failed": "#c0392b"}


def write(out: Path, results: Sequence[Any]) -> None:
    """Writes fuzz.json, fuzz.md and fuzz.png, and prints the table."""
    text = table(results)
    write_whole(out / "fuzz.json", (json.dumps([asdict(result) for result in results], indent=1) + "\n").encode())
    write_whole(out / "fuzz.md", text.encode())
    write_whole(out / "fuzz.png", plot(results))
    print(f"{text}\nwrote {out / 'fuzz.md'}, .json and .png")


def table(results: Sequence[Any]) -> str:
    """Markdown: a row a reader, and their sum.  Memory is the peak, and how far above the first input's."""
    lines = ["| reader | inputs | read | refused | failures | slowest, s | mean, ms | peak, MB | growth, MB |"]
    lines.append("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for one in results:
        mean, growth = 1000 * one.seconds / max(one.done, 1), one.peak_mb - one.base_mb
        lines.append(
            f"| {one.name} | {one.done:,} | {one.read:,} | {one.refused:,} | {one.failed:,} | {one.slowest:.2f} | "
            f"{mean:.1f} | {one.peak_mb:.0f} | {growth:.0f} |"
        )
    sums = [sum(getattr(one, name) for one in results) for name in ("done", "read", "refused", "failed")]
    lines.append(f"| {len(results)} readers | {' | '.join(f'{n:,}' for n in sums)} | | | | |")
    return "\n".join(lines) + "\n"


def plot(results: Sequence[Any]) -> bytes:
    """PNG: what came of each reader's inputs, and its slowest one."""
    from matplotlib.figure import Figure

    figure = Figure((9, 1 + 0.28 * len(results)), dpi=110, layout="constrained")
    shares, slowest = figure.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    names, left = [one.name for one in results], [0.0] * len(results)
    for outcome, color in COLORS.items():
        values = [100 * getattr(one, outcome) / max(one.done, 1) for one in results]
        shares.barh(names, values, left=left, color=color, label=outcome, height=0.7)
        left = [a + b for a, b in zip(left, values, strict=True)]
    shares.set_xlabel("% of the inputs")
    shares.set_xlim(0, 100)
    shares.invert_yaxis()
    shares.legend(frameon=False, fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
    slowest.barh(names, [1000 * one.slowest for one in results], color=COLORS["read"], height=0.5)
    slowest.set_xlabel("slowest input, ms")
    for panel in (shares, slowest):
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=8)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()
