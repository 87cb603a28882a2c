"""Variants of a training beside each other: results.json, table.md, a plot of the differences, and a gallery.

Differences are taken to one variant, the reference, view by view on equal seeds; intervals are bootstraps over objects.
In the plot a bar is an interval, the large dot the mean, and small dots are the means of single seeds.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.comparison import figures, results_folder, variants
from experiments.comparison.object_scores import OPAQUE
from experiments.comparison.variants import Budget, Compared, Variant
from spnr_jax.devices import runtime
from spnr_jax.formats import data_sets, images
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.report import ARROWS, HIGHER, QUALITY, Cell, Table, number, text
from spnr_jax.scoring.summary import difference, means, metric_settings

METRICS = {  # head, decimals, what is better
    "psnr": QUALITY["psnr"],
    "inside": ("PSNR inside, dB", 2, HIGHER),
    "color": ("Mean colour: PSNR, dB", 2, HIGHER),
    "hue": ("Its hue: PSNR, dB", 2, HIGHER),
    **{name: QUALITY[name] for name in ("ssim", "flip", "iou")},
    "detail": ("HF energy", 2, 0),
}
COSTS = {"parameters": "Parameters", "ms_per_step": "ms per step", "ms_per_view": "ms per view"}
BETTER, WORSE, OPEN = figures.GREEN, figures.RED, figures.COLORS[6]


def study(
    out: Path,
    what: str,
    trainings: Sequence[Variant],
    reference: str,
    budget: Budget,
    dataset: data_sets.Dataset,
    more: Mapping[str, object] | None = None,
    **asked: object,
) -> None:
    """Trains what is not trained in a folder that is this experiment's, scores all variants, writes the files."""
    names = budget.names(dataset)
    data_sets.check_resolution(data_sets.read_object(dataset, names[0]), trainings[0].config)
    variants.claim(out, what, budget, dataset, **asked)
    compared = variants.score(variants.train(trainings, budget, out), reference, dataset, names, budget.shown)
    write(out, trainings, reference, compared, budget, dataset, more)


def write(
    out: Path,
    trained: Sequence[Variant],
    reference: str,
    compared: Compared,
    budget: Budget,
    dataset: data_sets.Dataset,
    more: Mapping[str, object] | None = None,
) -> None:
    """Writes the files and prints the tables; what is in `more` is written with the results."""
    found = numbers(trained, reference, compared, budget, dataset) | dict(more or {})
    files = {"gallery.png": gallery({variant.name: variant.label for variant in trained}, compared)}
    if len(trained) > 1:
        files["differences.png"] = differences_plot(found)
    results_folder.write(out, found, tables_of(found), notes(found), files)


def numbers(
    trained: Sequence[Variant], reference: str, compared: Compared, budget: Budget, dataset: data_sets.Dataset
) -> dict:
    """Everything that is written, and the conditions that it stands on."""
    config, names = trained[0].config, compared.names
    meshes = evaluation.classes_of(names).get(evaluation.MESHES, [])
    origins = {"mesh files": meshes, "procedural": [name for name in names if name not in meshes]}
    whole = comparison(compared, reference)
    return whole | {
        "variants": {
            variant.name: {"label": variant.label, "training_objects": len(variant.dataset.splits["train"])}
            | compared.costs[variant.name]
            | whole["variants"][variant.name]
            for variant in trained
        },
        "reference": reference,
        "by_origin": {
            origin: comparison(variants.part(compared, found), reference)
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
        "hardware": runtime.hardware(),
        "data": dataset.settings.get("settings", {}),
        "views": len(next(iter(compared.scores.values()))[0]["psnr"]) // len(budget.seeds),
        "points": config.test_points,
        "resolution": config.model.image_resolution,
        "metrics": metric_settings(),
    }


def comparison(compared: Compared, reference: str) -> dict:
    """Quality of every variant on the objects that were compared, and all differences to the reference."""
    return {
        "variants": {name: means(scores, METRICS) for name, scores in compared.scores.items()},
        "minus_reference": {
            name: {metric: change(compared, name, reference, metric) for metric in METRICS}
            for name in compared.scores
            if name != reference
        },
        "test_objects": list(compared.names),
    }


def change(compared: Compared, variant: str, reference: str, metric: str) -> dict | None:
    """The variant minus the reference: mean, interval, p-value, and the mean of each seed alone."""
    found = difference(compared.scores[variant], compared.scores[reference], metric)
    if found is None:
        return None
    pairs = zip(compared.by_seed[variant], compared.by_seed[reference], strict=True)
    seeds = [difference(*pair, metric) for pair in pairs]
    return found | {"by_seed": [None if one is None else one["mean"] for one in seeds]}


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
        cells = [number(row[m], decimals, row[f"{m}_interval"]) for m, (_, decimals, _) in METRICS.items()]
        costs = [number(row[c], 0 if c == "parameters" else 1, missing="-") for c in COSTS]
        rows.append((row["label"], (*cells, *costs)))
    title = f"{len(results['test_objects'])} unseen objects{from_(origin)}, {results['views']} views each"
    return Table(title=title, heads=(*heads(), *COSTS.values()), rows=tuple(rows))


def differences_table(results: Mapping, origin: str = "") -> Table:
    """Every variant minus the reference."""

    def cell(found: Mapping | None, decimals: int) -> Cell:
        if found is None:
            return text("n/a")
        ends = found["interval"]
        certain = ends is not None and (ends[0] > 0 or ends[1] < 0)
        return number(found["mean"], decimals, ends, sign="+", best=certain)

    rows = tuple(
        (
            results["variants"][name]["label"],
            tuple(cell(changes[metric], decimals) for metric, (_, decimals, _) in METRICS.items()),
        )
        for name, changes in results["minus_reference"].items()
    )
    label = results["variants"][results["reference"]]["label"]
    note = "View by view on equal seeds; 95 % bootstrap intervals over objects. Bold: the interval leaves out 0."
    return Table(title=f"Minus {label}{from_(origin)}", heads=heads(), rows=rows, note=note)


def from_(origin: str) -> str:
    """Which objects a table is of, for its title."""
    return f" ({origin})" if origin else ""


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


@figures.drawing
def differences_plot(results: Mapping) -> Figure:
    """The differences, a panel a metric, a line a variant."""
    changes = results["minus_reference"]
    figure = Figure(figsize=(2 + 2.3 * len(METRICS), 1.2 + 0.36 * len(changes)))
    panels = figure.subplots(1, len(METRICS), sharey=True)
    for axes, (metric, (head, _, better)) in zip(panels, METRICS.items(), strict=True):
        axes.axvline(0, color="#adb5bd", linewidth=1)
        for place, found in enumerate(change[metric] for change in changes.values()):
            if found is not None:
                difference_line(axes, place, found, better)
        axes.set_title(f"{head} {ARROWS[better]}" if better else head)
        axes.xaxis.set_major_locator(MaxNLocator(4))
    panels[0].set_yticks(range(len(changes)), [results["variants"][name]["label"] for name in changes])
    panels[0].set_ylim(len(changes) - 0.5, -0.5)
    figure.supxlabel(f"minus {results['variants'][results['reference']]['label']}", fontsize=9)
    return figure


def difference_line(axes: Axes, place: int, found: Mapping, better: int) -> None:
    """The interval of one difference as a bar, its mean as a large dot, the means of its seeds as small ones."""
    low, high = found["interval"] or (found["mean"],) * 2
    certain = low > 0 or high < 0
    color = OPEN if not certain else figures.INK_COLOR if not better else BETTER if better * low > 0 else WORSE
    axes.plot([low, high], [place, place], color=color, linewidth=2.5, alpha=0.6, solid_capstyle="butt")
    axes.plot(found["mean"], place, "o", color=color, markersize=6)
    seeds = [value for value in found["by_seed"] if value is not None]
    if len(seeds) > 1:
        axes.plot(seeds, [place] * len(seeds), ".", color=figures.INK_COLOR, markersize=3)


def gallery(labels: Mapping[str, str], compared: Compared) -> bytes:
    """PNG: a row an object, the reference image and every variant's picture with PSNR and HF energy below."""
    cells, below = [], []
    for shown, scores in zip(compared.shown, compared.shown_scores, strict=True):
        cells.append([shown.reference, *(shown.images[f"{name}/0"] for name in labels)])
        below.append(["", *(f"{scores[name]['psnr']:.1f} dB, {scores[name]['detail']:.2f}" for name in labels)])
    rows = [f"{shown.name} view {shown.view}" for shown in compared.shown]
    return images.png(figures.grid(cells, ["Reference", *labels.values()], rows, 128, below))
