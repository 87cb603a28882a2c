"""Variants of one training, each in its run folder, scored on the same unseen objects, points and cameras.

    OUT/runs/VARIANT_SEED/   the run folders; a stopped run goes on, a finished one is only read
    OUT/asked.json           whose folder it is: another data set, preset or number of steps is refused
    OUT/results.json  OUT/table.md  OUT/differences.png  OUT/gallery.png

Every variant trains with every seed.  Its scores are those of all its seeds: object by object, their views one after
another.  Differences are taken to one variant, the reference, view by view on equal seeds; intervals are bootstraps
over objects.  In the plot a bar is an interval, the large dot the mean, and small dots are the means of single seeds.
"""

import dataclasses
import itertools
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.comparison import budget as budgets
from experiments.comparison import figures, results_folder
from experiments.comparison.budget import Trained
from experiments.comparison.contenders import of_network
from experiments.comparison.scores import OPAQUE, Shown, score_objects
from experiments.comparison.study_objects import test_objects
from spnr_jax.config import TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels import metrics
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.report import ARROWS, HIGHER, QUALITY, Cell, Table, number, text
from spnr_jax.scoring.summary import Scores, difference, means, metric_settings
from spnr_jax.training import checkpoint, optimisation, trainer

Preset = Literal["abo", "shapenet_car", "shapenet_plane", "shapenet_chair", "small", "tiny"]
QUICK_STEPS, QUICK_OBJECTS = 4, 2
FEWEST_ROWS = 8  # of a log, two of which may hold a compilation
METRICS = {  # head, decimals, what is better
    "psnr": QUALITY["psnr"],
    "inside": ("PSNR inside, dB", 2, HIGHER),
    **{name: QUALITY[name] for name in ("ssim", "flip", "iou")},
    "detail": ("HF energy", 2, 0),
}
HEADS = tuple(f"{head} {ARROWS[better]}" if better else head for head, _, better in METRICS.values())
COSTS = {"parameters": "Parameters", "ms_per_step": "ms per step", "ms_per_view": "ms per view"}
BETTER, WORSE, OPEN = figures.GREEN, figures.RED, figures.COLORS[6]


@dataclass(frozen=True, kw_only=True)
class Budget:
    """How much is trained and scored."""

    preset: Preset = "tiny"
    """What every variant changes one thing of."""
    steps: int | None = None
    """Training steps of every variant (default: the preset's)."""
    minutes: float | None = None
    """Minutes of training steps that each gets on this machine instead, as many steps as fit."""
    even_share: float = 0.0
    """Share of the training clouds that are first points of an object, in a data set of `--spread even`."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of weights, batches and jitter; every variant trains with each of them."""
    objects: int | None = None
    """Test objects, spread over the split (default: all)."""
    shown: int = 6
    """Objects in the gallery."""
    quick: bool = False
    """A check that everything works: a few steps, two objects."""

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise UserError(f"--seeds: expected one or more numbers, none of them twice, got {list(self.seeds)}")
        if self.steps is not None and (self.quick or self.steps < 1):
            raise UserError(f"--steps: expected 1 or more, and not together with --quick, got {self.steps}")
        if self.minutes is not None and (self.quick or self.steps is not None or not self.minutes > 0):
            raise UserError(
                f"--minutes: expected more than 0, and neither with --steps nor --quick, got {self.minutes:g}"
            )
        at_least(self, 1, "shown")

    def config(self) -> TrainConfig:
        """The preset with the steps and the clouds of this budget."""
        config = PRESETS[self.preset]()
        steps = QUICK_STEPS if self.quick else self.steps or config.num_steps
        return dataclasses.replace(config, num_steps=steps, even_share=self.even_share)

    def names(self, dataset: data_sets.Dataset) -> tuple[str, ...]:
        """The objects to be scored."""
        return test_objects(dataset, QUICK_OBJECTS if self.quick else self.objects)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to train; `start` makes the state that training begins with, where that is not a fresh one."""

    name: str
    label: str
    config: TrainConfig
    dataset: data_sets.Dataset
    start: Callable[[TrainConfig], optimisation.TrainState] | None = None


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Scores by variant, seed and object; what each run took, by variant; pictures of a few objects."""

    scores: dict[str, dict[int, dict[str, Scores]]]
    costs: dict[str, list[dict[str, Any]]]
    shown: list[Shown]

    @property
    def names(self) -> list[str]:
        """The objects."""
        return list(next(iter(next(iter(self.scores.values())).values())))

    def by_object(self, variant: str) -> list[Scores]:
        """The scores of each object's views with one seed after another."""
        seeds = self.scores[variant].values()
        return [
            {metric: np.concatenate([scores[name][metric] for scores in seeds]) for metric in METRICS}
            for name in self.names
        ]


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
    data_sets.check_resolution(data_sets.read_object(dataset, budget.names(dataset)[0]), trainings[0].config)
    claim(out, what, budget, dataset, **asked)
    compared = score(trainings, train(trainings, budget, out), reference, budget, dataset, budget.shown)
    write(out, trainings, reference, compared, budget, dataset, more)


def claim(out: Path, what: str, budget: Budget, dataset: data_sets.Dataset, **more: object) -> None:
    """Makes the folder that of this experiment; ValueError if it is another's."""
    asked = {"preset": budget.preset, "steps": budget.config().num_steps, **more}
    if budget.minutes is not None:
        asked |= {"steps": None, "minutes": budget.minutes}
    if budget.even_share:
        asked |= {"even_share": budget.even_share}
    results_folder.claim(out, what, asked, dataset)


def train(variants: Sequence[Variant], budget: Budget, out: Path) -> dict[str, dict[int, Trained]]:
    """The network of every variant and seed, trained one after another."""
    found: dict[str, dict[int, Trained]] = {variant.name: {} for variant in variants}
    todo = list(itertools.product(budget.seeds, variants))
    steps: dict[str, int] = {}
    for place, (seed, variant) in enumerate(todo, start=1):
        run, config = out / "runs" / f"{variant.name}_{seed}", dataclasses.replace(variant.config, seed=seed)
        if budget.minutes is not None:
            config = budgets.within(budget.minutes, config, variant.dataset, run, steps.get(variant.name))
            steps[variant.name] = config.num_steps  # its other seeds train for as many
        what = f"run {place} of {len(todo)}: {variant.label}, seed {seed}"
        print(f"{what}: {config.num_steps} steps in {run}", flush=True)
        if variant.start and not (run / "checkpoints").is_dir():
            state = variant.start(config)
            checkpoint.write_config(run, config)
            checkpoint.save(run, state)
        trained = budgets.train(config, variant.dataset, run)
        cost = {**trained.cost, "ms_per_step": step_milliseconds(run)}
        found[variant.name][seed] = dataclasses.replace(trained, cost=cost)
        jax.clear_caches()  # two dozen trainings' programs are more pieces of memory than Linux maps for a process
    return found


def step_milliseconds(run: Path) -> float | None:
    """Median milliseconds of a run's steps over the rows of its log; None of a few, which are mostly compilation."""
    found = [row["ms_per_step"] for row in trainer.read_rows(run) if "ms_per_step" in row]
    return round(statistics.median(found), 2) if len(found) >= FEWEST_ROWS else None


def without_colour_variants(dataset: data_sets.Dataset) -> data_sets.Dataset:
    """The data set whose training objects have no colour variants."""
    train = tuple(name for name in dataset.splits["train"] if name == original(name))
    return dataclasses.replace(dataset, splits=dataset.splits | {"train": train})


def original(name: str) -> str:
    """The object that a variant was made of (these are called ID--1, ID--2, ...), or the object itself."""
    return name.partition("--")[0]


# --- scores and differences -------------------------------------------------------------------------------------------


def score(
    variants: Sequence[Variant],
    trained: Mapping[str, Mapping[int, Trained]],
    reference: str,
    budget: Budget,
    dataset: data_sets.Dataset,
    num_shown: int,
) -> Compared:
    """All networks on the same objects; those of the reference choose the view of an object that is shown."""
    names = [variant.name for variant in variants]
    runs = [(name, seed) for name in sorted(names, key=lambda name: name != reference) for seed in budget.seeds]
    config = trained[reference][budget.seeds[0]].config  # its points and pixels are given to every variant
    methods = {
        f"{name}/{seed}": of_network(trained[name][seed].config, trained[name][seed].variables) for name, seed in runs
    }
    scored = score_objects(methods, config, dataset, budget.names(dataset), num_shown, more_scores)
    costs: dict[str, list[dict]] = {name: [] for name in names}
    for name, seed in runs:
        warm = scored.seconds[f"{name}/{seed}"][1:]
        pace = {"ms_per_view": 1000 * statistics.median(warm) if warm else None}
        costs[name].append(trained[name][seed].cost | pace)
    scores = {
        name: {seed: {item: found[f"{name}/{seed}"] for item, found in scored.scores.items()} for seed in budget.seeds}
        for name in names
    }
    return Compared(scores=scores, costs=costs, shown=scored.shown)


def merge(parts: Sequence[Compared]) -> Compared:
    """Comparisons of the same variants on different objects as one."""
    first = parts[0]
    return Compared(
        scores={
            name: {seed: {k: v for part in parts for k, v in part.scores[name][seed].items()} for seed in seeds}
            for name, seeds in first.scores.items()
        },
        costs={name: [cost for part in parts for cost in part.costs[name]] for name in first.costs},
        shown=[one for part in parts for one in part.shown],
    )


def more_scores(item: data_sets.ObjectData, pictures: evaluation.Pictures) -> Scores:
    """PSNR inside the silhouette, and high-frequency energy over the reference's, by view."""
    inside = item.images[..., 3] > 255 * OPAQUE
    return jax.device_get(_more_scores(np.asarray(pictures.image), data_sets.on_white(item.images), inside))


@jax.jit
def _more_scores(image, reference, inside):
    return {
        "inside": metrics.conditional_psnr(image, reference, inside),
        "detail": metrics.high_frequency_ratio(image, reference),
    }


def change(compared: Compared, variant: str, reference: str, metric: str) -> dict | None:
    """The variant minus the reference: mean, interval, p-value, and the mean of each seed alone."""
    found = difference(compared.by_object(variant), compared.by_object(reference), metric)
    if found is None:
        return None
    seeds = []
    for seed, scores in compared.scores[variant].items():
        own, others = (list(of.values()) for of in (scores, compared.scores[reference][seed]))
        seeds.append(difference(own, others, metric))
    return found | {"by_seed": [None if one is None else one["mean"] for one in seeds]}


def total_cost(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the runs of a variant took: lists of steps and seconds, means of paces."""
    whole: dict[str, Any] = {"parameters": runs[0]["parameters"]}
    whole |= {name: [run[name] for run in runs] for name in ("steps", "training_seconds")}
    for name in ("ms_per_step", "ms_per_view"):
        known = [run[name] for run in runs if run[name] is not None]
        whole[name] = round(statistics.fmean(known), 2) if known else None
    return whole


# --- files ------------------------------------------------------------------------------------------------------------


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
    tables = [quality_table(found)]
    if len(trained) > 1:
        tables.append(differences_table(found))
        files["differences.png"] = differences_plot(found)
    results_folder.write(out, found, tables, notes(found), files)


def numbers(
    trained: Sequence[Variant], reference: str, compared: Compared, budget: Budget, dataset: data_sets.Dataset
) -> dict:
    """Everything that is written, and the conditions that it stands on."""
    config, scores = trained[0].config, {variant.name: compared.by_object(variant.name) for variant in trained}
    return {
        "variants": {
            variant.name: {"label": variant.label, "training_objects": len(variant.dataset.splits["train"])}
            | total_cost(compared.costs[variant.name])
            | means(scores[variant.name], METRICS)
            for variant in trained
        },
        "minus_reference": {
            name: {metric: change(compared, name, reference, metric) for metric in METRICS}
            for name in scores
            if name != reference
        },
        "test_objects": compared.names,
        "reference": reference,
        "by_object": {
            item: {
                name: {metric: round(float(found[i][metric].mean()), 4) for metric in ("psnr", "flip")}
                for name, found in scores.items()
            }
            for i, item in enumerate(compared.names)
        },
        "preset": budget.preset,
        "minutes": budget.minutes,
        "even_share": budget.even_share,
        "seeds": list(budget.seeds),
        "hardware": runtime.hardware(),
        "data": dataset.settings.get("settings", {}),
        "views": len(scores[reference][0]["psnr"]) // len(budget.seeds),
        "points": config.test_points,
        "resolution": config.model.image_resolution,
        "metrics": metric_settings(),
    }


def quality_table(results: Mapping) -> Table:
    """Quality and cost of every variant."""
    rows = []
    for row in results["variants"].values():
        cells = [number(row[m], decimals, row[f"{m}_interval"]) for m, (_, decimals, _) in METRICS.items()]
        costs = [number(row[c], 0 if c == "parameters" else 1, missing="-") for c in COSTS]
        rows.append((row["label"], (*cells, *costs)))
    title = f"{len(results['test_objects'])} unseen objects, {results['views']} views each"
    return Table(title=title, heads=(*HEADS, *COSTS.values()), rows=tuple(rows))


def differences_table(results: Mapping) -> Table:
    """Every variant minus the reference."""

    def cell(found: Mapping | None, decimals: int) -> Cell:
        if found is None:
            return text("n/a")
        ends = found["interval"]
        certain = ends is not None and (ends[0] > 0 or ends[1] < 0)
        return number(found["mean"], decimals, ends, sign="+", best=certain)

    labels = {name: row["label"] for name, row in results["variants"].items()}
    rows = tuple(
        (labels[name], tuple(cell(changes[metric], decimals) for metric, (_, decimals, _) in METRICS.items()))
        for name, changes in results["minus_reference"].items()
    )
    note = "View by view on equal seeds; 95 % bootstrap intervals over objects. Bold: the interval leaves out 0."
    return Table(title=f"Minus {labels[results['reference']]}", heads=HEADS, rows=rows, note=note)


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
        f"Every variant: the same test objects, cameras and first {results['points']} points; "
        f"{results['resolution']} px.",
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
    for axes, head, (metric, (_, _, better)) in zip(panels, HEADS, METRICS.items(), strict=True):
        axes.axvline(0, color="#adb5bd", linewidth=1)
        for place, found in enumerate(change[metric] for change in changes.values()):
            if found is not None:
                difference_line(axes, place, found, better)
        axes.set_title(head)
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
    first = {name: next(iter(seeds.items())) for name, seeds in compared.scores.items()}
    cells, below = [], []
    for shown in compared.shown:
        cells.append([shown.reference, *(shown.images[f"{name}/{first[name][0]}"] for name in labels)])
        scores = {name: {m: float(x[shown.view]) for m, x in of[shown.name].items()} for name, (_, of) in first.items()}
        below.append(["", *(f"{scores[name]['psnr']:.1f} dB, {scores[name]['detail']:.2f}" for name in labels)])
    rows = [f"{shown.name} view {shown.view}" for shown in compared.shown]
    return images.png(figures.grid(cells, ["Reference", *labels.values()], rows, 128, below))
