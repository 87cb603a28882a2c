"""The paper's Table 1: every method trained on one data set and scored on the same unseen objects, points and cameras.

    python -m experiments.paper.table1 --data DIR --out DIR [--budget quick|tiny|paper] [--minutes M] [--methods ...]

    OUT/runs/METHOD/          the run folders of the networks (experiments/comparison/budget.py says what a budget is)
    OUT/poisson_1024/         pictures of the reconstructions from so many points; OUT/poisson_trimmed_1024/
    OUT/results.json          everything below as numbers: scores, costs, settings, hardware, seed
    OUT/table.md .csv .tex    the tables
    OUT/table1.html           the tables, and pictures of unseen objects to flip through

The same command goes on where it was stopped and trains nothing twice.  The same seed gives the same scores on a CPU;
times, and with --minutes the number of steps, are those of the machine.
"""

import dataclasses
import statistics
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from data_gen.render.poisson_surface import pymeshlab
from experiments import entry_point
from experiments.comparison import budget, page, poisson, results_folder
from experiments.comparison.budget import NETWORKS, Budget, Trained
from experiments.comparison.object_scores import ObjectMethod, Scored, Shown, by_category, of_cloud, score_objects
from experiments.comparison.trained_networks import LABELS, test_objects
from experiments.paper import table1_tables
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import machine
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.summary import differences, metric_settings, summarise

Row = Literal[
    "near_points", "paper", "npbg", "point_nerf", "points2nerf",
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
    shown: int = 24
    """Objects whose pictures are in the page."""
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
        at_least(self, 0, "shown")


def main(options: Table1) -> None:
    """Trains what is not trained, scores all methods, writes the tables and the page."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, options.objects or (QUICK_OBJECTS if options.budget == "quick" else None))
    first = data_sets.read_object(dataset, names[0])
    category = dataset.settings.get("settings", {}).get("category")
    presets = budget.presets(options.budget, first.camera.height, category)
    config = PRESETS[presets["paper"]]()  # its points and pixels are given to every method
    data_sets.check_resolution(first, config)
    asked = {name: getattr(options, name) for name in ("budget", "minutes", "seed")}
    results_folder.claim(options.out, "a table", asked, dataset)
    surfaces, missing = surface_methods(options, dataset, config)  # before hours of training: something may be amiss
    trained = train_networks(options, dataset, presets)
    floors, factors = floor_methods(options, dataset, config)
    networks = {name: of_cloud(evaluation.network(t.variables, t.config), config) for name, t in trained.items()}
    methods = networks | surfaces | floors
    if not methods:
        raise UserError(f"--methods {' '.join(options.methods)}: none can be made here, {' '.join(missing.values())}")
    scored = score_objects(methods, config, dataset, names, options.shown)
    found = {
        **asked,
        **conditions(dataset, names, config),
        "radius_factors": factors,
        "metrics": metric_settings(),
        "missing": missing,
        **numbers(scored),
        "costs": costs(options, trained, scored, config),
    }
    write(options.out, found, scored.shown)


def conditions(dataset: data_sets.Dataset, names: tuple[str, ...], config: TrainConfig) -> dict[str, object]:
    """What the numbers stand on."""
    counts = {f"{split} objects": len(objects) for split, objects in dataset.splits.items()}
    return {
        "hardware": machine.hardware(),
        "data": dataset.settings.get("settings", {}) | counts,
        "test_objects": list(names),
        "points": config.test_points,
        "resolution": config.model.image_resolution,
    }


def numbers(scored: Scored) -> dict[str, str | dict | None]:
    """The scores as tables: of every method, the first network minus the others, and of each class of objects."""
    scores = list(scored.scores.values())
    first = next((name for name in NETWORKS if name in scores[0]), None)
    return {
        "methods": summarise(scores),
        "compared": first,
        "differences": {} if first is None else differences(scores, first),
        "per_category": by_category(scored.scores),
    }


def write(out: Path, found: dict, shown: list[Shown]) -> None:
    """Writes results, tables and page, and prints the tables."""
    tables, notes = table1_tables.tables(found), table1_tables.notes(found)
    named = [
        dataclasses.replace(
            one,
            images={LABELS[name]: image for name, image in one.images.items()},
            psnr={LABELS[name]: value for name, value in one.psnr.items()},
        )
        for one in shown
    ]
    whole = page.page("Table 1: every method on the same unseen objects", tables, notes, named)
    results_folder.write(out, found, tables, notes, {"table1.html": whole.encode()})


def surface_folder(options: Table1, config: TrainConfig, row: str) -> Path:
    """Where the pictures of a Poisson row are kept."""
    return options.out / f"{row}_{config.test_points}"


def surface_methods(
    options: Table1, dataset: data_sets.Dataset, config: TrainConfig
) -> tuple[dict[str, ObjectMethod], dict[str, str]]:
    """The Poisson rows in the data set's light, and those that have to be left out, with the reason."""
    wanted = {name: surface for name, surface in poisson.SURFACES.items() if name in options.methods}
    if not wanted:
        return {}, {}
    try:
        poisson.check_packages()
        pymeshlab()
    except ValueError as error:
        print(f"Poisson not run: {error}", flush=True)
        return {}, dict.fromkeys(wanted, f"not run: {error}")
    renderer = poisson.Renderer(dataset.settings, options.envmap, options.variant, options.seed)
    show = partial(poisson.show, renderer, config.test_points)
    return {name: partial(show, s, surface_folder(options, config, name)) for name, s in wanted.items()}, {}


def floor_methods(
    options: Table1, dataset: data_sets.Dataset, config: TrainConfig
) -> tuple[dict[str, ObjectMethod], dict[str, float]]:
    """The trivial renderers, and the radius factors that are best for them on training objects."""
    wanted: list[str] = [name for name in reversed(evaluation.FLOORS) if name in options.methods]
    factors = {name: evaluation.choose_radius(dataset, config, name) for name in wanted if name != "white"}
    return {name: of_cloud(evaluation.floor(name, factors.get(name, 1.0)), config) for name in wanted}, factors


def train_networks(options: Table1, dataset: data_sets.Dataset, presets: dict[str, str]) -> dict[str, Trained]:
    """The networks of the table, one after another; finished ones are only read."""
    wanted: list[str] = [name for name in NETWORKS if name in options.methods]
    trained = {}
    for number, name in enumerate(wanted):
        run = options.out / "runs" / name
        if options.minutes and not (run / "config.json").is_file():
            print(f"{LABELS[name]}: measuring the pace of a step", flush=True)
        config = budget.config_of(presets[name], options.budget, options.seed, options.minutes, dataset, run)
        left = (
            ""
            if options.minutes is None
            else f", {options.minutes * (len(wanted) - number):g} min of steps left in all"
        )
        place = f"network {number + 1} of {len(wanted)}, {LABELS[name]}"
        print(f"{place}: preset {config.preset}, {config.num_steps} steps in {run}{left}", flush=True)
        trained[name] = budget.train(config, dataset, run)
    return trained


def costs(options: Table1, trained: dict[str, Trained], scored: Scored, config: TrainConfig) -> dict[str, dict]:
    """What each method took; milliseconds per view are the median over all objects but the first, which compiled."""
    table: dict[str, dict] = {}
    for method, seconds in scored.seconds.items():
        if method in poisson.SURFACES:  # the pictures may have been there already
            seconds = poisson.seconds_per_view(surface_folder(options, config, method), tuple(scored.scores))
        warm = seconds[1:]
        cost = trained[method].cost if method in trained else {}
        table[method] = cost | {"ms_per_view": round(1000 * statistics.median(warm), 2) if warm else None}
    return table


if __name__ == "__main__":
    entry_point.run(main, Table1, "paper.table1")
