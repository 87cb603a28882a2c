"""Variants of one training, each in its run folder, scored on the same unseen objects, points and cameras.

    OUT/runs/VARIANT_SEED/   the run folders; a stopped run goes on, a finished one is only read
    OUT/asked.json           whose folder it is: another data set, preset or number of steps is refused

Every variant trains with every seed.  Its scores are those of all its seeds: object by object, their views one after
another, so that a difference compares equal seeds, objects and views, and an interval is one over objects.
"""

import dataclasses
import itertools
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from experiments.comparison import budget as budgets
from experiments.comparison import results_folder
from experiments.comparison.budget import Trained
from experiments.comparison.object_scores import Shown, color_scores, of_cloud, score_objects, silhouette
from experiments.comparison.trained_networks import test_objects
from spnr_jax.config import TrainConfig
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets
from spnr_jax.kernels import metrics
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.summary import Scores
from spnr_jax.training import checkpoint, optimisation, run_record

Preset = Literal["abo", "shapenet_car", "shapenet_plane", "shapenet_chair", "small", "tiny"]
QUICK_STEPS, QUICK_OBJECTS = 4, 2
FEWEST_ROWS = 8  # of a log, two of which may hold a compilation


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
class Run:
    """A trained network, and the pace of its steps in milliseconds, where enough of them were measured."""

    trained: Trained
    ms_per_step: float | None


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Scores by variant and object, costs by variant, and the first seed's pictures of a few objects.

    `shown_scores` are those of the pictures.
    """

    names: tuple[str, ...]
    scores: dict[str, list[Scores]]
    by_seed: dict[str, list[list[Scores]]]
    costs: dict[str, dict]
    shown: list[Shown]
    shown_scores: list[dict[str, dict[str, float]]]


def claim(out: Path, what: str, budget: Budget, dataset: data_sets.Dataset, **more: object) -> None:
    """Makes the folder that of this experiment; ValueError if it is another's."""
    asked = {"preset": budget.preset, "steps": budget.config().num_steps, **more}
    if budget.minutes is not None:
        asked |= {"steps": None, "minutes": budget.minutes}
    if budget.even_share:
        asked |= {"even_share": budget.even_share}
    results_folder.claim(out, what, asked, dataset)


def train(variants: Sequence[Variant], budget: Budget, out: Path) -> dict[str, list[Run]]:
    """The network of every variant and seed, trained one after another."""
    runs: dict[str, list[Run]] = {variant.name: [] for variant in variants}
    todo = list(itertools.product(budget.seeds, variants))
    steps: dict[str, int] = {}
    for number, (seed, variant) in enumerate(todo, start=1):
        run, config = out / "runs" / f"{variant.name}_{seed}", dataclasses.replace(variant.config, seed=seed)
        place = f"run {number} of {len(todo)}: {variant.label}, seed {seed}"
        if budget.minutes is not None:
            config = budgets.within(budget.minutes, config, variant.dataset, run, steps.get(variant.name))
            steps[variant.name] = config.num_steps  # its other seeds train for as many
        print(f"{place}: {config.num_steps} steps in {run}", flush=True)
        if variant.start and not (run / "checkpoints").is_dir():
            state = variant.start(config)
            checkpoint.write_config(run, config)
            checkpoint.save(run, state)
        trained = budgets.train(config, variant.dataset, run)
        runs[variant.name].append(Run(trained=trained, ms_per_step=step_milliseconds(run)))
        jax.clear_caches()  # two dozen trainings' programs are more pieces of memory than Linux maps for a process
    return runs


def step_milliseconds(run: Path) -> float | None:
    """Median milliseconds of a run's steps over the rows of its log; None of a few, which are mostly compilation."""
    found = [row["ms_per_step"] for row in run_record.read_rows(run) if "ms_per_step" in row]
    return round(statistics.median(found), 2) if len(found) >= FEWEST_ROWS else None


def without_colour_variants(dataset: data_sets.Dataset) -> data_sets.Dataset:
    """The data set whose training objects have no colour variants."""
    train = tuple(name for name in dataset.splits["train"] if name == original(name))
    return dataclasses.replace(dataset, splits=dataset.splits | {"train": train})


def original(name: str) -> str:
    """The object that a variant was made of (these are called ID--1, ID--2, ...), or the object itself."""
    return name.partition("--")[0]


def score(
    runs: Mapping[str, Sequence[Run]],
    reference: str,
    dataset: data_sets.Dataset,
    names: tuple[str, ...],
    num_shown: int,
) -> Compared:
    """All networks on these objects; those of the reference choose the view of an object that is shown."""
    order = sorted(runs, key=lambda name: name != reference)
    networks = {f"{name}/{i}": run.trained for name in order for i, run in enumerate(runs[name])}
    config = runs[reference][0].trained.config  # its points and pixels are given to every variant
    shows = {
        key: of_cloud(evaluation.network(found.variables, found.config), config) for key, found in networks.items()
    }
    scored = score_objects(shows, config, dataset, names, num_shown, more_scores)
    by_seed = {
        name: [[scores[f"{name}/{i}"] for scores in scored.scores.values()] for i in range(len(found))]
        for name, found in runs.items()
    }
    costs = {}
    for name, found in runs.items():
        warm = [seconds for i in range(len(found)) for seconds in scored.seconds[f"{name}/{i}"][1:]]
        steps = [run.ms_per_step for run in found if run.ms_per_step is not None]
        costs[name] = {
            "parameters": found[0].trained.cost["parameters"],
            "steps": [run.trained.cost["steps"] for run in found],
            "training_seconds": [run.trained.cost["training_seconds"] for run in found],
            "ms_per_step": round(statistics.mean(steps), 2) if steps else None,
            "ms_per_view": round(1000 * statistics.median(warm), 2) if warm else None,
        }
    return Compared(
        names=names,
        scores={name: [joined(seeds) for seeds in zip(*lists, strict=True)] for name, lists in by_seed.items()},
        by_seed=by_seed,
        costs=costs,
        shown=scored.shown,
        shown_scores=[
            {
                name: {m: float(values[one.view]) for m, values in scored.scores[one.name][f"{name}/0"].items()}
                for name in runs
            }
            for one in scored.shown
        ],
    )


def merged(parts: Sequence[Compared]) -> Compared:
    """Comparisons of the same variants on different objects as one; costs are means of theirs."""

    def mean(found: Sequence) -> float | None:
        return None if None in found else round(statistics.fmean(found), 2)

    variants = parts[0].scores
    return Compared(
        names=tuple(name for part in parts for name in part.names),
        scores={name: [scores for part in parts for scores in part.scores[name]] for name in variants},
        by_seed={
            name: [list(itertools.chain(*seeds)) for seeds in zip(*(part.by_seed[name] for part in parts), strict=True)]
            for name in variants
        },
        costs={
            name: {
                "parameters": parts[0].costs[name]["parameters"],
                "steps": [steps for part in parts for steps in part.costs[name]["steps"]],
                "training_seconds": [seconds for part in parts for seconds in part.costs[name]["training_seconds"]],
                **{c: mean([part.costs[name][c] for part in parts]) for c in ("ms_per_step", "ms_per_view")},
            }
            for name in variants
        },
        shown=[one for part in parts for one in part.shown],
        shown_scores=[one for part in parts for one in part.shown_scores],
    )


def part(compared: Compared, names: Sequence[str]) -> Compared:
    """The comparison on some of its objects; costs and pictures are those of all."""
    own = [compared.names.index(name) for name in names]
    return dataclasses.replace(
        compared,
        names=tuple(names),
        scores={name: [scores[i] for i in own] for name, scores in compared.scores.items()},
        by_seed={name: [[scores[i] for i in own] for scores in seeds] for name, seeds in compared.by_seed.items()},
    )


def joined(seeds: Sequence[Scores]) -> Scores:
    """The scores of an object's views with one seed after another."""
    return {metric: np.concatenate([scores[metric] for scores in seeds]) for metric in seeds[0]}


def more_scores(item: data_sets.ObjectData, pictures: evaluation.Pictures) -> Scores:
    """PSNR inside the silhouette, of its mean colour and hue; high-frequency energy over the reference's; by view."""
    image, reference = np.asarray(pictures.image), data_sets.on_white(item.images)
    more = jax.device_get(_more_scores(image, reference, silhouette(item)))
    return more | color_scores(item, reference, image)


@jax.jit
def _more_scores(image, reference, inside):
    return {
        "inside": metrics.conditional_psnr(image, reference, inside),
        "detail": metrics.high_frequency_ratio(image, reference),
    }
