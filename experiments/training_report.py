"""Variants of a training beside each other: results.json, table.md, a plot of the differences, and a gallery.

Differences are taken to one variant, the reference, view by view on equal seeds; intervals are bootstraps over objects.
In the plot a bar is an interval, the large dot the mean, and small dots are the means of single seeds.
"""

import io
import json
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from experiments import training_runs
from experiments.table1_report import Cell, Table, markdown
from experiments.training_runs import OPAQUE, Budget, Compared, Variant
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.scoring import evaluation, intervals
from spnr_jax.scoring.report import ARROWS, HIGHER, QUALITY
from spnr_jax.scoring.summary import Scores, metric_settings

METRICS = {  # head, decimals, what is better
    "psnr": QUALITY["psnr"],
    "inside": ("PSNR inside, dB", 2, HIGHER),
    **{name: QUALITY[name] for name in ("ssim", "flip", "iou")},
    "detail": ("HF energy", 2, 0),
}
COSTS = {"parameters": "Parameters", "ms_per_step": "ms per step", "ms_per_view": "ms per view"}
BETTER, WORSE, OPEN, INK = "#2f9e44", "#d9480f", "#868e96", "#1d2330"
LINE = 19  # letters of a title above a picture
CAPTION = "Below a picture: PSNR in dB, and its\nhigh-frequency energy over the reference's."


def write(
    out: Path,
    variants: Sequence[Variant],
    reference: str,
    compared: Compared,
    budget: Budget,
    dataset: data_sets.Dataset,
    more: Mapping[str, object] | None = None,
) -> None:
    """Writes the files and prints the tables; what is in `more` is written with the results."""
    results = numbers(variants, reference, compared, budget, dataset) | dict(more or {})
    labels = {variant.name: variant.label for variant in variants}
    tables = tables_of(results)
    if len(variants) > 1:
        write_whole(out / "differences.png", differences_plot(results))
    write_whole(out / "results.json", (json.dumps(results, indent=1, allow_nan=False) + "\n").encode())
    write_whole(out / "table.md", markdown(tables, notes(results)).encode())
    write_whole(out / "gallery.png", gallery(labels, compared))
    print(markdown(tables, []))
    print(f"wrote tables and pictures in {out}")


def numbers(
    variants: Sequence[Variant], reference: str, compared: Compared, budget: Budget, dataset: data_sets.Dataset
) -> dict:
    """Everything that is written, and the conditions that it stands on."""
    config, names = variants[0].config, compared.names
    meshes = evaluation.classes_of(names).get(evaluation.MESHES, [])
    origins = {"mesh files": meshes, "procedural": [name for name in names if name not in meshes]}
    whole = comparison(compared, reference)
    return whole | {
        "variants": {
            variant.name: {"label": variant.label, "training_objects": len(variant.dataset.splits["train"])}
            | compared.costs[variant.name]
            | whole["variants"][variant.name]
            for variant in variants
        },
        "reference": reference,
        "by_origin": {
            origin: comparison(training_runs.part(compared, found), reference)
            for origin, found in origins.items()
            if 0 < len(found) < len(names)
        },
        "by_object": {
            name: {
                variant: {metric: round(float(scores[i][metric].mean()), 4) for metric in ("psnr", "flip")}
                for variant, scores in compared.scores.items()
            }
            for i, name in enumerate(names)
        },
        "preset": budget.preset,
        "minutes": budget.minutes,
        "even_share": budget.even_share,
        "seeds": list(budget.seeds),
        "hardware": machine.hardware(),
        "data": dataset.settings.get("settings", {}),
        "views": len(next(iter(compared.scores.values()))[0]["psnr"]) // len(budget.seeds),
        "points": config.test_points,
        "resolution": config.model.image_resolution,
        "metrics": metric_settings(with_lpips=False),
    }


def comparison(compared: Compared, reference: str) -> dict:
    """Quality of every variant on the objects that were compared, and all differences to the reference."""
    return {
        "variants": {name: means(scores) for name, scores in compared.scores.items()},
        "minus_reference": {
            name: {metric: change(compared, name, reference, metric) for metric in METRICS}
            for name in compared.scores
            if name != reference
        },
        "test_objects": list(compared.names),
    }


def means(objects: Sequence[Scores]) -> dict[str, float | list[float] | None]:
    """Mean of each metric over views (of all seeds) and its interval; None where there is no number."""
    row: dict[str, float | list[float] | None] = {}
    for metric in METRICS:
        values = [scores[metric] for scores in objects]
        every = np.concatenate(values)
        ends = None if np.isnan(every).all() else intervals.interval(values)
        row[metric] = None if np.isnan(every).all() else float(np.nanmean(every))
        row[f"{metric}_interval"] = None if ends is None else list(ends)
    return row


def change(compared: Compared, variant: str, reference: str, metric: str) -> dict | None:
    """The variant minus the reference: mean, interval, p-value, and the mean of each seed alone."""

    def minus(first: Sequence[Scores], second: Sequence[Scores]) -> intervals.Difference | None:
        return intervals.difference([s[metric] for s in first], [s[metric] for s in second])

    found = minus(compared.scores[variant], compared.scores[reference])
    if found is None:
        return None
    seeds = [minus(*pair) for pair in zip(compared.by_seed[variant], compared.by_seed[reference], strict=True)]
    return {
        "mean": found.mean,
        "interval": None if found.interval is None else list(found.interval),
        "p_value": found.p_value,
        "by_seed": [None if one is None else one.mean for one in seeds],
    }


def heads() -> tuple[str, ...]:
    """Heads of the metrics' columns."""
    return tuple(f"{head} {ARROWS[better]}" if better else head for head, _, better in METRICS.values())


def tables_of(results: Mapping) -> list[Table]:
    """Qualities and differences on all objects, and on those of each origin where there are several."""
    found = []
    for origin, own in {"": results, **results["by_origin"]}.items():
        variants = {name: row | own["variants"][name] for name, row in results["variants"].items()}
        shown = results | own | {"variants": variants}
        found.append(quality_table(shown, origin))
        if shown["minus_reference"]:
            found.append(differences_table(shown, origin))
    return found


def quality_table(results: Mapping, origin: str = "") -> Table:
    """Quality and cost of every variant."""
    rows = []
    for row in results["variants"].values():
        cells = [
            Cell(text="n/a")
            if row[metric] is None
            else Cell(text=f"{row[metric]:.{decimals}f}", small=ends(row[f"{metric}_interval"], decimals))
            for metric, (_, decimals, _) in METRICS.items()
        ]
        cells += [
            Cell(text="-" if row[c] is None else f"{row[c]:,}" if c == "parameters" else f"{row[c]:.1f}") for c in COSTS
        ]
        rows.append((row["label"], tuple(cells)))
    title = f"{len(results['test_objects'])} unseen objects{from_(origin)}, {results['views']} views each"
    return Table(title=title, heads=(*heads(), *COSTS.values()), rows=tuple(rows))


def differences_table(results: Mapping, origin: str = "") -> Table:
    """Every variant minus the reference."""
    rows = []
    for name, changes in results["minus_reference"].items():
        cells = []
        for metric, (_, decimals, _) in METRICS.items():
            found = changes[metric]
            cells.append(
                Cell(text="n/a")
                if found is None
                else Cell(
                    text=f"{found['mean']:+.{decimals}f}",
                    small=ends(found["interval"], decimals, "+"),
                    best=bool(found["interval"]) and (found["interval"][0] > 0 or found["interval"][1] < 0),
                )
            )
        rows.append((results["variants"][name]["label"], tuple(cells)))
    label = results["variants"][results["reference"]]["label"]
    note = "View by view on equal seeds; 95 % bootstrap intervals over objects. Bold: the interval leaves out 0."
    return Table(title=f"Minus {label}{from_(origin)}", heads=heads(), rows=tuple(rows), note=note)


def from_(origin: str) -> str:
    """Which objects a table is of, for its title."""
    return f" ({origin})" if origin else ""


def ends(interval: Sequence[float] | None, decimals: int, sign: str = "") -> tuple[str, ...]:
    """An interval as small text."""
    return () if interval is None else (f"[{interval[0]:{sign}.{decimals}f}, {interval[1]:{sign}.{decimals}f}]",)


def notes(results: Mapping) -> list[str]:
    """What a reader has to know of the numbers."""
    counts = sorted({row["training_objects"] for row in results["variants"].values()})
    steps = [count for row in results["variants"].values() for count in row["steps"]]
    budget = f"{steps[0]:,} steps each"
    if results["minutes"] is not None:
        budget = f"{results['minutes']:g} minutes of training steps each, {min(steps):,} to {max(steps):,}"
    share = results["even_share"]
    clouds = f" Share of the training clouds that are evenly spread: {share:g}." if share else ""
    return [
        f"Budget: preset {results['preset']}, {budget}, {' or '.join(map(str, counts))} training objects. "
        f"Seeds: {', '.join(map(str, results['seeds']))}.{clouds}",
        f"Hardware: {results['hardware']}.",
        f"Every variant: the same {len(results['test_objects'])} test objects, cameras and first {results['points']} "
        f"points; {results['resolution']} px.",
        "ms per step: median over the rows of a run's log; ms per view: median over the objects but the first; "
        "encoding is shared by the views of an object.",
        f"PSNR inside: over the pixels whose opacity in the reference exceeds {OPAQUE:g}.",
        "HF energy: above half of the Nyquist frequency in a Hann window, over the reference's; 1 is equally sharp, "
        "less is smoother, more is noise or a sharpness that is not there.",
        *(f"{name}: {text}." for name, text in results["metrics"].items() if name != "LPIPS"),
    ]


def differences_plot(results: Mapping) -> bytes:
    """PNG of the differences, a panel a metric, a line a variant."""
    names = list(results["minus_reference"])
    figure = Figure(figsize=(2 + 2.3 * len(METRICS), 1.2 + 0.36 * len(names)), layout="constrained")
    panels = figure.subplots(1, len(METRICS), sharey=True)
    for axes, (metric, (head, _, better)) in zip(panels, METRICS.items(), strict=True):
        axes.axvline(0, color="#adb5bd", linewidth=1)
        for place, name in enumerate(names):
            if (found := results["minus_reference"][name][metric]) is None:
                continue
            low, high = found["interval"] or (found["mean"],) * 2
            certain = low > 0 or high < 0
            color = OPEN if not certain else INK if not better else BETTER if better * low > 0 else WORSE
            axes.plot([low, high], [place, place], color=color, linewidth=2.5, alpha=0.6, solid_capstyle="butt")
            axes.plot(found["mean"], place, "o", color=color, markersize=6)
            seeds = [value for value in found["by_seed"] if value is not None]
            if len(seeds) > 1:
                axes.plot(seeds, [place] * len(seeds), ".", color=INK, markersize=3)
        axes.set_title(f"{head} {ARROWS[better]}" if better else head, fontsize=9)
        axes.tick_params(labelsize=8)
        axes.tick_params(axis="y", length=0)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.grid(axis="x", alpha=0.25)
        axes.spines[["top", "right", "left"]].set_visible(False)
    panels[0].set_yticks(range(len(names)), [results["variants"][name]["label"] for name in names])
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    figure.supxlabel(f"minus {results['variants'][results['reference']]['label']}", fontsize=9)
    return png(figure)


def gallery(labels: Mapping[str, str], compared: Compared) -> bytes:
    """PNG: a row an object, the reference image and every variant's picture with its numbers below."""
    rows = []
    for shown, scores in zip(compared.shown, compared.shown_scores, strict=True):
        pictures = [(shown.reference, "")]
        for name in labels:
            own = scores[name]
            pictures.append((shown.images[f"{name}/0"], f"{own['psnr']:.1f} dB, {own['detail']:.2f}"))
        rows.append((f"{shown.name}\nview {shown.view}", pictures))
    return picture_rows(["Reference", *labels.values()], rows, CAPTION)


def picture_rows(
    titles: Sequence[str], rows: Sequence[tuple[str, Sequence[tuple[np.ndarray, str]]]], caption: str = ""
) -> bytes:
    """PNG of rows of pictures (h, w, 3), each with a text below it, named beside them; titles stand above."""
    wide = max(len(pictures) for _, pictures in rows)
    layout = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.03, wspace=0, hspace=0)
    figure = Figure(figsize=(1.25 * wide + 0.9, 1.45 * len(rows) + 0.5), layout=layout)
    panels = figure.subplots(len(rows), wide, squeeze=False)
    for (name, pictures), line in zip(rows, panels, strict=True):
        for axes in line:
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_visible(False)
        for axes, (image, text) in zip(line, pictures, strict=False):
            axes.imshow(np.clip(image, 0, 1), interpolation="nearest")
            axes.set_xlabel(text, fontsize=7, labelpad=2)
        line[0].set_ylabel(name.replace("_", "_\n", 1), fontsize=7, rotation=0, ha="right", va="center")
    for axes, title in zip(panels[0], titles, strict=False):
        axes.set_title(textwrap.fill(title, LINE), fontsize=8)
    if caption:
        figure.supxlabel(caption, fontsize=8)
    return png(figure)


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=120, metadata={"Software": None})
    return stream.getvalue()
