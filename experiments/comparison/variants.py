"""Networks trained one after another, each in its run folder, and compared on the same unseen objects and cameras.

    OUT/runs/NAME/           the run folders; a stopped run goes on, a finished one is only read
    OUT/asked.json           whose folder it is: another data set, preset, seed or number of steps is refused
    OUT/results.json  OUT/table.md  OUT/gallery.png

Differences are those of one network, the reference, to each other method, view by view; intervals are bootstraps over
objects.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from experiments.comparison import figures, results_folder
from experiments.comparison.contenders import of_network
from experiments.comparison.scores import Scored, score_objects
from experiments.comparison.study_objects import test_objects
from experiments.comparison.view_scores import compare_high_frequencies
from spnr_jax.config import TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError, require_at_least
from spnr_jax.formats import data_sets, images
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.picture_scores import Scores, differences, means, metric_settings, summarise
from spnr_jax.scoring.report import Cell, Table, difference, head, number, quality
from spnr_jax.training import checkpoint, optimisation, trainer

Preset = Literal["abo", "shapenet_car", "shapenet_plane", "shapenet_chair", "small", "tiny"]
QUICK_STEPS, QUICK_OBJECTS = 4, 2
SAVES = 40  # checkpoints and previews of a long run
METRICS = ("psnr", "ssim", "flip", "iou")  # of a study


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
        require_at_least(self, 1, "objects", "shown")

    def config(self) -> TrainConfig:
        """The preset with the steps and the seed of this budget."""
        config = PRESETS[self.preset]()
        steps = QUICK_STEPS if self.quick else self.steps or config.num_steps
        return dataclasses.replace(config, num_steps=steps, seed=self.seed)

    def names(self, dataset: data_sets.Dataset) -> tuple[str, ...]:
        """The objects to be scored."""
        return test_objects(dataset, QUICK_OBJECTS if self.quick else self.objects, 1)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to train; `start` makes the state that training begins with, where that is not a fresh one."""

    name: str
    label: str
    config: TrainConfig
    dataset: data_sets.Dataset
    start: Callable[[TrainConfig], optimisation.TrainState] | None = None


@dataclass(frozen=True, kw_only=True)
class Trained:
    """A trained network, ready to be shown: and what it cost."""

    config: TrainConfig
    variables: dict
    cost: dict[str, str | int | float | None]


def study(
    out: Path,
    what: str,
    variants: Sequence[Variant],
    reference: str,
    budget: Budget,
    dataset: data_sets.Dataset,
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
    scored = score_objects(methods, config, dataset, names, budget.shown, measure_detail)
    found = asked | conditions(dataset, names, config) | compare(scored, reference)
    labels, more = {one.name: one.label for one in variants}, {}
    for variant in variants:
        detail = means([of[variant.name] for of in scored.scores.values()], ("detail",))
        found["methods"][variant.name] |= {"training_objects": len(variant.dataset.splits["train"]), **detail}
        more[variant.name] = (number(detail["detail"], 2, detail["detail_interval"]),)
    tables = [methods_table(found, labels, METRICS, ("HF energy",), more)]
    if len(variants) > 1:
        tables.append(differences_table(found, labels, METRICS))
    picture = gallery(labels, scored, {"psnr": "PSNR", "detail": "HF energy"})
    results_folder.write(out, found, tables, notes(found), {"gallery.png": picture})


def measure_detail(item: data_sets.ObjectData, pictures: evaluation.Pictures) -> Scores:
    """High-frequency energy over the reference's, by view."""
    return {"detail": compare_high_frequencies(np.asarray(pictures.image), data_sets.on_white(item.images))}


def notes(found: Mapping) -> list[str]:
    """Notes under the tables of a study."""
    counts = sorted({row["training_objects"] for row in found["methods"].values()})
    return [
        f"Budget: preset {found['preset']}, {found['steps']:,} steps each, {' or '.join(map(str, counts))} training "
        f"objects. Seed {found['seed']}.",
        f"Hardware: {found['hardware']}.",
        f"Every variant: the same test objects, cameras and first {found['points']} points; {found['resolution']} px.",
        "HF energy: above half of the Nyquist frequency in a Hann window, over the reference's; 1 is equally sharp, "
        "less is smoother, more is noise or a sharpness that is not there.",
        *(f"{name}: {text}." for name, text in found["metrics"].items() if name != "LPIPS"),
    ]


# --- trainings --------------------------------------------------------------------------------------------------------


def train(variants: Sequence[Variant], out: Path) -> dict[str, Trained]:
    """The network of every variant, trained one after another."""
    found: dict[str, Trained] = {}
    for place, variant in enumerate(variants, start=1):
        run, config = out / "runs" / variant.name, variant.config
        about = f"{variant.label}, preset {config.preset}, {config.num_steps} steps"
        print(f"run {place} of {len(variants)}: {about} in {run}", flush=True)
        if variant.start and not any(path.name.isdecimal() for path in run.glob("checkpoints/*")):
            state = variant.start(config)
            checkpoint.write_config(run, config)
            checkpoint.save(run, state)
        found[variant.name] = train_one(config, variant.dataset, run)
    return found


def train_one(config: TrainConfig, dataset: data_sets.Dataset, run: Path) -> Trained:
    """The network after its last step; a finished run is only read."""
    every = max(500, config.num_steps // SAVES)
    schedule = trainer.Schedule(preview_every=every, checkpoint_every=every)
    state = trainer.train(config, dataset, run, schedule)
    variables = optimisation.averaged_variables(state)
    cost = {
        "preset": config.preset,
        "parameters": sum(x.size for x in jax.tree.leaves(variables["params"])),
        "steps": int(state.step),
        "training_seconds": training_seconds(run),
    }
    return Trained(config=config, variables=variables, cost=cost)


def training_seconds(run: Path) -> float:
    """Seconds that a run's steps took over all calls, from its log: not compilation, previews and saving."""
    seconds, before = 0.0, 0
    for row in trainer.read_rows(run):
        if "ms_per_step" in row:
            seconds += (row["step"] - before) * row["ms_per_step"] / 1000
            before = row["step"]
    return round(seconds, 2)


# --- numbers, tables and picture --------------------------------------------------------------------------------------


def conditions(dataset: data_sets.Dataset, names: tuple[str, ...], config: TrainConfig) -> dict[str, object]:
    """Conditions of the measurement."""
    counts = {f"{split} objects": len(objects) for split, objects in dataset.splits.items()}
    return {
        "hardware": runtime.describe_hardware(),
        "data": dataset.settings.get("settings", {}) | counts,
        "test_objects": list(names),
        "points": min(config.test_points, len(data_sets.read_object(dataset, names[0]).cloud.mask)),
        "resolution": config.model.image_resolution,
        "metrics": metric_settings(),
    }


def compare(scored: Scored, first: str | None) -> dict:
    """The scores of every method, and those of the first network minus the others."""
    scores = list(scored.scores.values())
    minus = {} if first is None else differences(scores, first)
    return {"methods": summarise(scores), "compared": first, "differences": minus}


def methods_table(
    found: Mapping,
    labels: Mapping[str, str],
    columns: Sequence[str],
    heads: Sequence[str],
    more: Mapping[str, tuple[Cell, ...]],
) -> Table:
    """Quality of every method in the order of the labels, and `more` of it under heads of their own."""
    rows = {name: (*cells, *more[name]) for name, cells in quality(found["methods"], columns).items()}
    counts = next(iter(found["methods"].values()))
    return Table(
        title=f"Methods, {counts['objects']} unseen objects, {counts['views']} views",
        heads=(*map(head, columns), *heads),
        rows=tuple((label, rows[name]) for name, label in labels.items() if name in rows),
        note="Means over images with 95 % bootstrap intervals over objects; the best of a column stands out.",
    )


def differences_table(found: Mapping, labels: Mapping[str, str], columns: Sequence[str]) -> Table:
    """A network minus each other method, image by image."""
    rows = tuple(
        (f"{labels[found['compared']]} minus {labels[name]}", tuple(difference(row.get(one), one) for one in columns))
        for name, row in found["differences"].items()
    )
    note = "Image by image, with 95 % bootstrap intervals and the p-value of a sign-flip test, both over objects."
    return Table(title="Paired differences", heads=tuple(map(head, columns)), rows=rows, note=note)


def gallery(labels: Mapping[str, str], scored: Scored, below: Mapping[str, str]) -> bytes:
    """PNG: a row an object, the reference and every method's picture; below it the names of some scores, and these."""
    cells, lines = [], []
    for shown in scored.shown:
        cells.append([shown.reference, *(shown.images[name] for name in labels)])
        scores = [[scored.scores[shown.name][name][metric][shown.view] for metric in below] for name in labels]
        lines.append([", ".join(below.values()), *(", ".join(f"{value:.2f}" for value in values) for values in scores)])
    rows = [f"{shown.name} view {shown.view}" for shown in scored.shown]
    return images.png(figures.grid(cells, ["Reference", *labels.values()], rows, 128, lines))
