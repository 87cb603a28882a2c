"""Variants of one training, each in its run folder, scored on the same unseen objects, points and cameras.

    OUT/runs/VARIANT_SEED/   the run folders; a stopped run goes on, a finished one is only read
    OUT/asked.json           whose folder it is: another data set, preset or number of steps is refused
    OUT/results.json  OUT/table.md  OUT/gallery.png

Every variant trains with every seed.  Its scores are those of all its seeds: object by object, their views one after
another.  Differences are taken to one variant, the reference, view by view on equal seeds; intervals are bootstraps
over objects.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import numpy as np

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
from spnr_jax.training import checkpoint, optimisation

Preset = Literal["abo", "shapenet_car", "shapenet_plane", "shapenet_chair", "small", "tiny"]
QUICK_STEPS, QUICK_OBJECTS = 4, 2
METRICS = {  # head, decimals, what is better
    "psnr": QUALITY["psnr"],
    "inside": ("PSNR inside, dB", 2, HIGHER),
    **{name: QUALITY[name] for name in ("ssim", "flip", "iou")},
    "detail": ("HF energy", 2, 0),
}
HEADS = tuple(f"{head} {ARROWS[better]}" if better else head for head, _, better in METRICS.values())


@dataclass(frozen=True, kw_only=True)
class Budget:
    """How much is trained and scored."""

    preset: Preset = "tiny"
    """What every variant changes one thing of."""
    steps: int | None = None
    """Training steps of every variant (default: the preset's)."""
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
        at_least(self, 1, "shown")

    def config(self) -> TrainConfig:
        """The preset with the steps of this budget."""
        config = PRESETS[self.preset]()
        steps = QUICK_STEPS if self.quick else self.steps or config.num_steps
        return dataclasses.replace(config, num_steps=steps)

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
    """Scores by variant, seed and object; pictures of a few objects."""

    scores: dict[str, dict[int, dict[str, Scores]]]
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
    asked = {"preset": budget.preset, "steps": budget.config().num_steps, **asked}
    results_folder.claim(out, what, asked, dataset)
    compared = score(trainings, train(trainings, budget, out), reference, budget, dataset)
    found = numbers(trainings, reference, compared, budget, dataset) | dict(more or {})
    tables = [quality_table(found)]
    if len(trainings) > 1:
        tables.append(differences_table(found))
    picture = gallery({one.name: one.label for one in trainings}, compared)
    results_folder.write(out, found, tables, notes(found), {"gallery.png": picture})


def train(variants: Sequence[Variant], budget: Budget, out: Path) -> dict[str, dict[int, Trained]]:
    """The network of every variant and seed, trained one after another."""
    found: dict[str, dict[int, Trained]] = {variant.name: {} for variant in variants}
    todo = list(itertools.product(budget.seeds, variants))
    for place, (seed, variant) in enumerate(todo, start=1):
        run, config = out / "runs" / f"{variant.name}_{seed}", dataclasses.replace(variant.config, seed=seed)
        what = f"run {place} of {len(todo)}: {variant.label}, seed {seed}"
        print(f"{what}: {config.num_steps} steps in {run}", flush=True)
        if variant.start and not (run / "checkpoints").is_dir():
            state = variant.start(config)
            checkpoint.write_config(run, config)
            checkpoint.save(run, state)
        found[variant.name][seed] = budgets.train(config, variant.dataset, run)
        jax.clear_caches()  # two dozen trainings' programs are more pieces of memory than Linux maps for a process
    return found


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
) -> Compared:
    """All networks on the same objects; those of the reference choose the view of an object that is shown."""
    names = [variant.name for variant in variants]
    runs = [(name, seed) for name in sorted(names, key=lambda name: name != reference) for seed in budget.seeds]
    config = trained[reference][budget.seeds[0]].config  # its points and pixels are given to every variant
    methods = {
        f"{name}/{seed}": of_network(trained[name][seed].config, trained[name][seed].variables) for name, seed in runs
    }
    scored = score_objects(methods, config, dataset, budget.names(dataset), budget.shown, more_scores)
    scores = {
        name: {seed: {item: found[f"{name}/{seed}"] for item, found in scored.scores.items()} for seed in budget.seeds}
        for name in names
    }
    return Compared(scores=scores, shown=scored.shown)


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


# --- tables and picture -----------------------------------------------------------------------------------------------


def numbers(
    trained: Sequence[Variant], reference: str, compared: Compared, budget: Budget, dataset: data_sets.Dataset
) -> dict:
    """Everything that is written, and the conditions that it stands on."""
    config, scores = trained[0].config, {variant.name: compared.by_object(variant.name) for variant in trained}
    return {
        "variants": {
            variant.name: {"label": variant.label, "training_objects": len(variant.dataset.splits["train"])}
            | means(scores[variant.name], METRICS)
            for variant in trained
        },
        "minus_reference": {
            name: {metric: difference(of, scores[reference], metric) for metric in METRICS}
            for name, of in scores.items()
            if name != reference
        },
        "test_objects": compared.names,
        "reference": reference,
        "preset": budget.preset,
        "steps": config.num_steps,
        "seeds": list(budget.seeds),
        "hardware": runtime.hardware(),
        "data": dataset.settings.get("settings", {}),
        "views": len(scores[reference][0]["psnr"]) // len(budget.seeds),
        "points": config.test_points,
        "resolution": config.model.image_resolution,
        "metrics": metric_settings(),
    }


def quality_table(results: Mapping) -> Table:
    """Quality of every variant."""
    rows = []
    for row in results["variants"].values():
        cells = [number(row[m], decimals, row[f"{m}_interval"]) for m, (_, decimals, _) in METRICS.items()]
        rows.append((row["label"], tuple(cells)))
    title = f"{len(results['test_objects'])} unseen objects, {results['views']} views each"
    return Table(title=title, heads=HEADS, rows=tuple(rows))


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
    return [
        f"Budget: preset {results['preset']}, {results['steps']:,} steps each, "
        f"{' or '.join(map(str, counts))} training objects. Seeds: {', '.join(map(str, results['seeds']))}.",
        f"Hardware: {results['hardware']}.",
        f"Every variant: the same test objects, cameras and first {results['points']} points; "
        f"{results['resolution']} px.",
        f"PSNR inside: over the pixels whose opacity in the reference exceeds {OPAQUE:g}.",
        "HF energy: above half of the Nyquist frequency in a Hann window, over the reference's; 1 is equally sharp, "
        "less is smoother, more is noise or a sharpness that is not there.",
        *(f"{name}: {text}." for name, text in results["metrics"].items() if name != "LPIPS"),
    ]


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
