"""The paper's Table 1: every method trained on one data set and scored on the same unseen objects, points and cameras.

    python -m experiments.paper.table1 --data DIR --out DIR [--budget quick|tiny|paper] [--minutes M] [--methods ...]

    OUT/runs/METHOD/          the run folders of the networks (experiments/comparison/budget.py says what a budget is)
    OUT/poisson_1024/         pictures of the reconstructions from so many points (.npz); OUT/poisson_trimmed_1024/
    OUT/results.json          everything below as numbers: scores, costs, settings, hardware, seed
    OUT/table.md              the tables
    OUT/gallery.png           pictures of unseen objects by every method

The same command goes on where it was stopped and trains nothing twice.  The same seed gives the same scores on a CPU;
times, and with --minutes the number of steps, are those of the machine.
"""

import importlib
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments import entry_point
from experiments.comparison import budget, contenders, poisson, results_folder
from experiments.comparison.budget import NETWORKS, QUICK_STEPS, Budget, Trained
from experiments.comparison.contenders import LABELS, Method
from experiments.comparison.scores import Scored, score_objects
from experiments.comparison.study_objects import test_objects
from experiments.comparison.variants import gallery
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets
from spnr_jax.scoring.picture_scores import differences, metric_settings, summarise
from spnr_jax.scoring.report import Cell, Table, difference, duration, head, lower_first, number, quality

METRICS = ("psnr", "ssim", "lpips", "flip", "cpsnr", "iou")
COSTS = {"parameters": "Parameters", "steps": "Steps", "training_seconds": "Training", "ms_per_view": "ms per view"}
HEADS = tuple(map(head, METRICS))
BUDGETS = {
    "quick": f"the tiny presets for {QUICK_STEPS} steps each, which shows that everything runs and nothing else",
    "tiny": "the tiny presets, 64 px",
    "paper": "the paper presets",
}
Row = Literal[
    "paper", "npbg", "point_nerf", "points2nerf",
    "poisson", "poisson_trimmed", "nearest", "splat", "white",
]  # fmt: skip
ROWS: tuple[Row, ...] = Row.__args__  # type: ignore[attr-defined]
QUICK_OBJECTS = 3


@dataclass(frozen=True, kw_only=True)
class Table1:
    """Train every method of the paper's Table 1 on one data set, score all on the same objects, write the table."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of runs and results; the same command goes on there."""
    budget: Budget = "tiny"
    """Sizes of the networks: quick (tiny presets, a few steps), tiny, or paper (needs a GPU)."""
    minutes: float | None = None
    """Minutes of training steps that each network gets on this machine (default: the steps of its preset)."""
    methods: tuple[Row, ...] = ROWS
    """Rows of the table."""
    objects: int | None = None
    """Test objects, spread over the split (default: all; 3 with --budget quick)."""
    shown: int = 12
    """Objects in the gallery."""
    envmap: Path | None = None
    """The environment map of the data set, where that is a file: Poisson surfaces are rendered in it."""
    variant: str = "auto"
    """Mitsuba variant for these: scalar_rgb, llvm_ad_rgb, or auto for the faster one that works here."""
    seed: int = 0
    """Seed of weights, batches, jitter, and the noise of the Poisson pictures."""

    def __post_init__(self) -> None:
        if self.minutes is not None and (self.budget == "quick" or not self.minutes > 0):
            raise UserError(
                f"--minutes {self.minutes}: expected more than 0 with --budget tiny or paper (quick takes "
                f"{budget.QUICK_STEPS} steps); leave it out for the steps of the presets"
            )
        if not self.methods:
            raise UserError(f"--methods: name at least one of {', '.join(ROWS)}")
        at_least(self, 1, "objects")
        at_least(self, 1, "shown")


def main(options: Table1) -> None:
    """Trains what is not trained, scores all methods, writes tables and pictures."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, options.objects or (QUICK_OBJECTS if options.budget == "quick" else None))
    first = data_sets.read_object(dataset, names[0])
    category = dataset.settings.get("settings", {}).get("category")
    configs = budget.configs(options.budget, first.camera.height, category)
    config = configs["paper"]  # its points and pixels are given to every method
    data_sets.check_resolution(first, config)
    asked = {name: getattr(options, name) for name in ("budget", "minutes", "seed")}
    results_folder.claim(options.out, "a table", asked, dataset)
    surfaces, missing = surface_methods(options, dataset, config)  # before hours of training: something may be amiss
    trained = train_networks(options, dataset, configs)
    floors = contenders.floors(options.methods, dataset, config)
    compared = {name: contenders.of_network(t.config, t.variables) for name, t in trained.items()} | surfaces | floors
    if not compared:
        raise UserError(f"--methods {' '.join(options.methods)}: none can be made here, {' '.join(missing.values())}")
    scored = score_objects(compared, config, dataset, names, options.shown)
    found = {
        **asked,
        **conditions(dataset, names, config),
        "radius_factors": {name: of.radius for name, of in floors.items() if of.radius is not None},
        "metrics": metric_settings(),
        "missing": missing,
        **numbers(scored),
        "costs": costs(options, trained, scored, config),
    }
    how, tables = notes(found), [methods_table(found)]
    if found["differences"]:
        tables.append(differences_table(found["compared"], found["differences"]))
    picture = gallery({name: LABELS[name] for name in compared}, scored, ("psnr",))
    results_folder.write(options.out, found, tables, how, {"gallery.png": picture})


def conditions(dataset: data_sets.Dataset, names: tuple[str, ...], config: TrainConfig) -> dict[str, object]:
    """What the numbers stand on."""
    counts = {f"{split} objects": len(objects) for split, objects in dataset.splits.items()}
    return {
        "hardware": runtime.hardware(),
        "data": dataset.settings.get("settings", {}) | counts,
        "test_objects": list(names),
        "points": config.test_points,
        "resolution": config.model.image_resolution,
    }


def numbers(scored: Scored) -> dict[str, str | dict | None]:
    """The scores as tables: of every method, and the first network minus the others."""
    scores = list(scored.scores.values())
    first = next((name for name in NETWORKS if name in scores[0]), None)
    return {
        "methods": summarise(scores),
        "compared": first,
        "differences": {} if first is None else differences(scores, first),
    }


def surface_folder(options: Table1, config: TrainConfig, row: str) -> Path:
    """Where the pictures of a Poisson row are kept."""
    return options.out / f"{row}_{config.test_points}"


def surface_methods(
    options: Table1, dataset: data_sets.Dataset, config: TrainConfig
) -> tuple[dict[str, Method], dict[str, str]]:
    """The Poisson rows in the data set's light, and those that have to be left out, with the reason."""
    wanted = {name: surface for name, surface in poisson.SURFACES.items() if name in options.methods}
    if not wanted:
        return {}, {}
    try:
        for package in ("pymeshlab", "mitsuba"):
            importlib.import_module(package)
    except ImportError as error:
        print(f"Poisson not run: {error}", flush=True)
        return {}, dict.fromkeys(wanted, f"not run: {error}; pip install 'spnr-jax[data,baselines]'")
    renderer = poisson.Renderer(dataset.settings, options.envmap, options.variant, options.seed)
    return {
        name: poisson.keep_pictures(renderer, surface, surface_folder(options, config, name))
        for name, surface in wanted.items()
    }, {}


def train_networks(options: Table1, dataset: data_sets.Dataset, configs: dict[str, TrainConfig]) -> dict[str, Trained]:
    """The networks of the table, one after another; finished ones are only read."""
    wanted: list[str] = [name for name in NETWORKS if name in options.methods]
    trained = {}
    for number_of, name in enumerate(wanted, start=1):
        run = options.out / "runs" / name
        if options.minutes and not (run / "config.json").is_file():
            print(f"{LABELS[name]}: measuring the pace of a step", flush=True)
        config = budget.config_of(configs[name], options.budget, options.seed, options.minutes, dataset, run)
        place = f"network {number_of} of {len(wanted)}, {LABELS[name]}"
        print(f"{place}: preset {config.preset}, {config.num_steps} steps in {run}", flush=True)
        trained[name] = budget.train(config, dataset, run)
    return trained


def costs(options: Table1, trained: dict[str, Trained], scored: Scored, config: TrainConfig) -> dict[str, dict]:
    """What each method took; milliseconds per view are the median over all objects but the first, which compiled."""
    table: dict[str, dict] = {}
    for method, seconds in scored.seconds.items():
        if method in poisson.SURFACES:  # the pictures may have been there already
            seconds = poisson.seconds_per_view(surface_folder(options, config, method), scored.scores)
        warm = seconds[1:]
        cost = trained[method].cost if method in trained else {}
        table[method] = cost | {"ms_per_view": round(1000 * statistics.median(warm), 2) if warm else None}
    return table


# --- tables ---------------------------------------------------------------------------------------------------------


def methods_table(results: Mapping) -> Table:
    """Quality and cost of every method; rows that could not be made say why."""
    scores, missing = results["methods"], results["missing"]
    rows = {
        LABELS[name]: (*cells, *(_cost(results["costs"][name], column) for column in COSTS))
        for name, cells in quality(scores, METRICS).items()
    }
    rows |= {LABELS[name]: (Cell(text=reason),) for name, reason in missing.items()}
    counts = next(iter(scores.values()))
    return Table(
        title=f"Methods, {counts['objects']} unseen objects, {counts['views']} views",
        heads=(*HEADS, *COSTS.values()),
        rows=tuple((label, rows[label]) for label in LABELS.values() if label in rows),
        note="Means over images with 95 % bootstrap intervals over objects; the best of a column stands out.",
    )


def differences_table(first: str, differences: Mapping) -> Table:
    """A network minus each other method, image by image."""
    rows = tuple(
        (f"{LABELS[first]} minus {lower_first(name)}", tuple(difference(row.get(metric), metric) for metric in METRICS))
        for name, row in differences.items()
    )
    note = "Image by image, with 95 % bootstrap intervals and the p-value of a sign-flip test, both over objects."
    return Table(title="Paired differences", heads=HEADS, rows=rows, note=note)


def _cost(cost: Mapping, column: str) -> Cell:
    value = cost.get(column)
    if column == "training_seconds" and value is not None:
        return Cell(text=duration(value))
    return number(value, 1 if column == "ms_per_view" else 0, missing="-")


def notes(results: Mapping) -> list[str]:
    """What a reader has to know of the numbers: budget, data, machine, seed, how they were measured."""
    counts, costs = next(iter(results["methods"].values())), results["costs"]
    presets = ", ".join(f"{LABELS[name]} {cost['preset']}" for name, cost in costs.items() if "preset" in cost)
    minutes = results["minutes"]
    rule = (
        "every network trains the steps of its preset"
        if minutes is None
        else f"every network trains as many steps as fit into {minutes:g} minutes on this machine, its warm-up and "
        "decay over exactly these; measured beforehand, compilation, checkpoints and previews not counted"
    )
    budget = f"Budget {results['budget']}: {BUDGETS[results['budget']]}"
    factors = ", ".join(f"{LABELS[name]} {value:g}" for name, value in results["radius_factors"].items())
    objects = results["data"]
    lines = [
        budget + ("." if results["budget"] == "quick" else f"; {rule}.") + (f" Presets: {presets}." if presets else ""),
        f"All methods: the same {objects['train objects']} training objects, {counts['objects']} test objects of "
        f"{objects['test objects']}, cameras, and first {results['points']} points; {results['resolution']} px.",
        f"Hardware: {results['hardware']}; Poisson surfaces are made and rendered on its CPU. Seed {results['seed']}.",
        "Training is the time of the steps, without compilation. ms per view: median over the objects but the first; "
        "what is done once per object is shared by its views.",
        *(f"{name}: {text}." for name, text in results["metrics"].items()),
    ]
    return lines + ([f"Radius of a point, in point spacings, best on training objects: {factors}."] if factors else [])


if __name__ == "__main__":
    entry_point.run(main, Table1, "paper.table1")
