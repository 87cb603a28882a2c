"""The paper's Table 1: every method trained on one data set and scored on the same unseen objects, points and cameras.

    python -m experiments.paper.table1 --data DIR --out DIR [--budget quick|tiny|paper] [--methods ...]

    OUT/runs/METHOD/          the run folders of the networks
    OUT/results.json          everything below as numbers: scores, costs, settings, hardware, seed
    OUT/table.md              the tables
    OUT/gallery.png           pictures of unseen objects by every method

    quick   the tiny presets for a few steps: the whole way, no quality
    tiny    the tiny presets, 64 px: minutes each on two cores
    paper   the published sizes, 128 px (ABO) or 200 px (ShapeNet): a GPU

The same command goes on where it was stopped and trains nothing twice.  The same seed gives the same scores on a CPU.
"""

import dataclasses
import importlib
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments import entry_point
from experiments.baselines import PUBLISHED
from experiments.comparison import contenders, poisson, results_folder, variants
from experiments.comparison.contenders import LABELS, Method
from experiments.comparison.scores import Scored, score_objects
from experiments.comparison.study_objects import test_objects
from experiments.comparison.variants import QUICK_STEPS, Trained, Variant
from spnr_jax.config import TrainConfig
from spnr_jax.errors import UserError, require, require_at_least
from spnr_jax.formats import data_sets
from spnr_jax.presets import PRESETS
from spnr_jax.scoring.report import Cell, Table, number, text

METRICS = ("psnr", "ssim", "lpips", "flip", "cpsnr", "iou")
COSTS = {"parameters": "Parameters", "steps": "Steps", "training_seconds": "Training", "ms_per_view": "ms per view"}
NETWORKS = ("paper", "npbg", "point_nerf", "points2nerf")
Budget = Literal["quick", "tiny", "paper"]
BUDGETS = {
    "quick": f"the tiny presets for {QUICK_STEPS} steps each, which shows that everything runs and nothing else",
    "tiny": "the tiny presets and their steps, 64 px",
    "paper": "the paper presets and their steps",
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
        require(bool(self.methods), f"--methods: name at least one of {', '.join(ROWS)}")
        require_at_least(self, 1, "objects", "shown")


def main(options: Table1) -> None:
    """Trains what is not trained, scores all methods, writes tables and pictures."""
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, options.objects or (QUICK_OBJECTS if options.budget == "quick" else None), 1)
    first = data_sets.read_object(dataset, names[0])
    category = dataset.settings.get("settings", {}).get("category")
    configs = make_configs(options, first.camera.height, category)
    config = configs["paper"]  # its points and pixels are given to every method
    data_sets.check_resolution(first, config)
    asked = {name: getattr(options, name) for name in ("budget", "seed")}
    results_folder.claim(options.out, "a table", asked, dataset)
    surfaces, missing = surface_methods(options, dataset)  # before hours of training: something may be amiss
    wanted = [name for name in NETWORKS if name in options.methods]
    trained = variants.train(
        [Variant(name=name, label=LABELS[name], config=configs[name], dataset=dataset) for name in wanted], options.out
    )
    trivial = contenders.trivial_ones(options.methods, dataset, config)
    compared = {name: contenders.of_network(t.config, t.variables) for name, t in trained.items()} | surfaces | trivial
    if not compared:
        raise UserError(f"--methods {' '.join(options.methods)}: none can be made here, {' '.join(missing.values())}")
    scored = score_objects(compared, config, dataset, names, options.shown)
    found = {
        **asked,
        **variants.conditions(dataset, names, config),
        "radius_factors": {name: of.radius for name, of in trivial.items() if of.radius is not None},
        "missing": missing,
        **variants.compare(scored, next((name for name in NETWORKS if name in trained), None)),
        "costs": costs(trained, scored),
    }
    picture = variants.gallery({name: LABELS[name] for name in compared}, scored, {"psnr": "PSNR"})
    results_folder.write(options.out, found, make_tables(found), notes(found), {"gallery.png": picture})


def make_configs(options: Table1, size: int, category: str | None) -> dict[str, TrainConfig]:
    """The training of each network for images of so many pixels; ValueError if the paper has no such size."""
    if options.budget != "paper":
        found = {name: PRESETS["tiny" if name == "paper" else f"{name}_tiny"]() for name in NETWORKS}
    elif size in (128, 200):
        paper = "abo" if size == 128 else f"shapenet_{category}"
        found = {"paper": PRESETS[paper if paper in PRESETS else "shapenet_car"]()}
        found |= {name: published(size) for name, published in PUBLISHED.items()}
    else:
        raise UserError(
            f"--budget paper: the data's images have {size} pixels, the paper's 128 (ABO) or 200 (ShapeNet); generate "
            "with --resolution 128, or take --budget tiny"
        )
    if options.budget == "quick":
        found = {name: dataclasses.replace(config, num_steps=QUICK_STEPS) for name, config in found.items()}
    return {name: dataclasses.replace(config, seed=options.seed) for name, config in found.items()}


def surface_methods(options: Table1, dataset: data_sets.Dataset) -> tuple[dict[str, Method], dict[str, str]]:
    """The Poisson rows in the data set's light, and those that have to be left out, with the reason."""
    wanted = [name for name in poisson.SURFACES if name in options.methods]
    if not wanted:
        return {}, {}
    try:
        for package in ("pymeshlab", "mitsuba"):
            importlib.import_module(package)
    except ImportError as error:
        print(f"Poisson not run: {error}", flush=True)
        return {}, dict.fromkeys(wanted, f"not run: {error}; pip install 'spnr-jax[data,baselines]'")
    renderer = poisson.Renderer(dataset.settings, options.envmap, options.variant, options.seed)
    return {name: renderer.method(name) for name in wanted}, {}


def costs(trained: dict[str, Trained], scored: Scored) -> dict[str, dict]:
    """What each method took; milliseconds per view are the median over all objects but the first, which compiled."""
    table: dict[str, dict] = {}
    for method, seconds in scored.seconds.items():
        warm = seconds[1:]
        cost = trained[method].cost if method in trained else {}
        table[method] = cost | {"ms_per_view": round(1000 * statistics.median(warm), 2) if warm else None}
    return table


# --- tables ---------------------------------------------------------------------------------------------------------


def make_tables(found: Mapping) -> list[Table]:
    """Quality and cost of every method, with the reason for rows that could not be made; differences."""
    costs = {name: tuple(_cost(cost, column) for column in COSTS) for name, cost in found["costs"].items()}
    table = variants.methods_table(found, LABELS, METRICS, tuple(COSTS.values()), costs)
    rows = dict(table.rows) | {LABELS[name]: (text(reason),) for name, reason in found["missing"].items()}
    table = table._replace(rows=tuple((label, rows[label]) for label in LABELS.values() if label in rows))
    return [table, *([variants.differences_table(found, LABELS, METRICS)] if found["differences"] else [])]


def _cost(cost: Mapping, column: str) -> Cell:
    value = cost.get(column)
    if column == "training_seconds" and value is not None:
        return Cell(text=duration(value))
    return number(value, 1 if column == "ms_per_view" else 0, missing="-")


def duration(seconds: float | int) -> str:
    """Seconds in words: 8.4 s, 6 min 12 s, 2 h 5 min."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60} min"


def notes(results: Mapping) -> list[str]:
    """Notes under the table: budget, data, machine, seed, how they were measured."""
    counts, costs = next(iter(results["methods"].values())), results["costs"]
    presets = ", ".join(f"{LABELS[name]} {cost['preset']}" for name, cost in costs.items() if "preset" in cost)
    budget = f"Budget {results['budget']}: {BUDGETS[results['budget']]}."
    factors = ", ".join(f"{LABELS[name]} {value:g}" for name, value in results["radius_factors"].items())
    objects = results["data"]
    lines = [
        budget + (f" Presets: {presets}." if presets else ""),
        f"All methods: the same {objects['train objects']} training objects, {counts['objects']} test objects of "
        f"{objects['test objects']}, cameras, and first {results['points']} points; {results['resolution']} px.",
        f"Hardware: {results['hardware']}; Poisson surfaces are made and rendered on its CPU. Seed {results['seed']}.",
        "Training is the time of the steps, without compilation. ms per view: median over the objects but the first; "
        "what is done once per object is shared by its views.",
        *(f"{name}: {how}." for name, how in results["metrics"].items()),
    ]
    return lines + ([f"Radius of a point, in point spacings, best on training objects: {factors}."] if factors else [])


if __name__ == "__main__":
    entry_point.run(main, Table1, "paper.table1")
