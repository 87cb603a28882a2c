"""Variants of one training, each in its run folder, scored on the same unseen objects, points and cameras.

    OUT/runs/VARIANT/        the run folders; a stopped run goes on, a finished one is only read
    OUT/asked.json           whose folder it is: another data set, preset, seed or number of steps is refused
    OUT/results.json  OUT/table.md  OUT/gallery.png

Differences are taken to one variant, the reference, view by view; intervals are bootstraps over objects.
"""

import dataclasses
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
from experiments.comparison.scores import OPAQUE, Scored, score_objects
from experiments.comparison.study_objects import test_objects
from spnr_jax.config import TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels import metrics
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.picture_scores import Scores, difference, means, metric_settings
from spnr_jax.scoring.report import ARROWS, HIGHER, QUALITY, Cell, Table, number, text
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
    seed: int = 0
    """Seed of weights, batches and jitter of every variant."""
    objects: int | None = None
    """Test objects, spread over the split (default: all)."""
    shown: int = 6
    """Objects in the gallery."""
    quick: bool = False
    """A check that everything works: a few steps, two objects."""

    def __post_init__(self) -> None:
        if self.steps is not None and (self.quick or self.steps < 1):
            raise UserError(f"--steps: expected 1 or more, and not together with --quick, got {self.steps}")
        at_least(self, 1, "shown")

    def config(self) -> TrainConfig:
        """The preset with the steps and the seed of this budget."""
        config = PRESETS[self.preset]()
        steps = QUICK_STEPS if self.quick else self.steps or config.num_steps
        return dataclasses.replace(config, num_steps=steps, seed=self.seed)

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


def study(
    out: Path,
    what: str,
    variants: Sequence[Variant],
    reference: str,
    budget: Budget,
    dataset: data_sets.Dataset,
    more: Mapping[str, object] | None = None,
    **asked: object,
) -> None:
    """Trains what is not trained in a folder that is this experiment's, scores all variants, writes the files."""
    names = budget.names(dataset)
    config = variants[0].config  # its points and pixels are given to every variant
    data_sets.check_resolution(data_sets.read_object(dataset, names[0]), config)
    asked = {"preset": budget.preset, "steps": config.num_steps, "seed": budget.seed, **asked}
    results_folder.claim(out, what, asked, dataset)
    trained = train(variants, out)
    order = sorted(trained, key=lambda name: name != reference)  # the first chooses the view of an object that is shown
    methods = {name: of_network(trained[name].config, trained[name].variables) for name in order}
    scored = score_objects(methods, config, dataset, names, budget.shown, more_scores)
    found = numbers(variants, reference, scored, budget, dataset) | dict(more or {})
    tables = [quality_table(found)]
    if len(variants) > 1:
        tables.append(differences_table(found))
    picture = gallery({one.name: one.label for one in variants}, scored, ("psnr", "detail"))
    results_folder.write(out, found, tables, notes(found), {"gallery.png": picture})


def train(variants: Sequence[Variant], out: Path) -> dict[str, Trained]:
    """The network of every variant, trained one after another."""
    found: dict[str, Trained] = {}
    for place, variant in enumerate(variants, start=1):
        run, config = out / "runs" / variant.name, variant.config
        print(f"run {place} of {len(variants)}: {variant.label}, {config.num_steps} steps in {run}", flush=True)
        if variant.start and not (run / "checkpoints").is_dir():
            state = variant.start(config)
            checkpoint.write_config(run, config)
            checkpoint.save(run, state)
        found[variant.name] = budgets.train(config, variant.dataset, run)
    return found


def without_colour_variants(dataset: data_sets.Dataset) -> data_sets.Dataset:
    """The data set whose training objects have no colour variants."""
    train = tuple(name for name in dataset.splits["train"] if name == original(name))
    return dataclasses.replace(dataset, splits=dataset.splits | {"train": train})


def original(name: str) -> str:
    """The object that a variant was made of (these are called ID--1, ID--2, ...), or the object itself."""
    return name.partition("--")[0]


# --- scores and differences -------------------------------------------------------------------------------------------


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
    variants: Sequence[Variant], reference: str, scored: Scored, budget: Budget, dataset: data_sets.Dataset
) -> dict:
    """Everything that is written, and the conditions that it stands on."""
    config = variants[0].config
    scores = {variant.name: [of[variant.name] for of in scored.scores.values()] for variant in variants}
    return {
        "variants": {
            variant.name: {"label": variant.label, "training_objects": len(variant.dataset.splits["train"])}
            | means(scores[variant.name], METRICS)
            for variant in variants
        },
        "minus_reference": {
            name: {metric: difference(of, scores[reference], metric) for metric in METRICS}
            for name, of in scores.items()
            if name != reference
        },
        "test_objects": list(scored.scores),
        "reference": reference,
        "preset": budget.preset,
        "steps": config.num_steps,
        "seed": budget.seed,
        "hardware": runtime.hardware(),
        "data": dataset.settings.get("settings", {}),
        "views": len(scores[reference][0]["psnr"]),
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
    note = "View by view; 95 % bootstrap intervals over objects. Bold: the interval leaves out 0."
    return Table(title=f"Minus {labels[results['reference']]}", heads=HEADS, rows=rows, note=note)


def notes(results: Mapping) -> list[str]:
    """What a reader has to know of the numbers."""
    counts = sorted({row["training_objects"] for row in results["variants"].values()})
    return [
        f"Budget: preset {results['preset']}, {results['steps']:,} steps each, "
        f"{' or '.join(map(str, counts))} training objects. Seed {results['seed']}.",
        f"Hardware: {results['hardware']}.",
        f"Every variant: the same test objects, cameras and first {results['points']} points; "
        f"{results['resolution']} px.",
        f"PSNR inside: over the pixels whose opacity in the reference exceeds {OPAQUE:g}.",
        "HF energy: above half of the Nyquist frequency in a Hann window, over the reference's; 1 is equally sharp, "
        "less is smoother, more is noise or a sharpness that is not there.",
        *(f"{name}: {text}." for name, text in results["metrics"].items() if name != "LPIPS"),
    ]


def gallery(labels: Mapping[str, str], scored: Scored, below: Sequence[str]) -> bytes:
    """PNG: a row an object, the reference image and every method's picture, with some of its scores below."""
    cells, lines = [], []
    for shown in scored.shown:
        cells.append([shown.reference, *(shown.images[name] for name in labels)])
        scores = [[scored.scores[shown.name][name][metric][shown.view] for metric in below] for name in labels]
        lines.append(["", *(", ".join(f"{value:.2f}" for value in values) for values in scores)])
    rows = [f"{shown.name} view {shown.view}" for shown in scored.shown]
    return images.png(figures.grid(cells, ["Reference", *labels.values()], rows, 128, lines))
