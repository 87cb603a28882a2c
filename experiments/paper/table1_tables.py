"""The results of Table 1 as tables: quality and cost, paired differences, and a table of each class of objects."""

from collections.abc import Mapping

from experiments.comparison.budget import QUICK_STEPS
from experiments.comparison.trained_networks import LABELS
from spnr_jax.scoring.report import duration
from spnr_jax.scoring.score_tables import Cell, Table, difference, head, lowered, number, quality

METRICS = ("psnr", "ssim", "lpips", "flip", "cpsnr", "iou")
COSTS = {"parameters": "Parameters", "steps": "Steps", "training_seconds": "Training", "ms_per_view": "ms per view"}
HEADS = tuple(map(head, METRICS))
BUDGETS = {
    "quick": f"the tiny presets for {QUICK_STEPS} steps each, which shows that everything runs and nothing else",
    "tiny": "the tiny presets, 64 px",
    "paper": "the paper presets",
}


def tables(results: Mapping) -> list[Table]:
    """The table of methods, the differences, and a table of each class of objects."""
    made = [methods_table(results)]
    if results["differences"]:
        made.append(differences_table(results["compared"], results["differences"]))
    for name, methods in results["per_category"].items():
        count = next(iter(methods.values()))["objects"]
        title = f"{name}, {count} object{'s' * (count != 1)}"
        made.append(
            Table(
                title=title,
                heads=HEADS,
                rows=tuple((LABELS[name], cells) for name, cells in quality(methods, METRICS).items()),
            )
        )
    return made


def methods_table(results: Mapping) -> Table:
    """Quality and cost of every method; rows that could not be made say why."""
    methods, missing = results["methods"], results["missing"]
    rows = {
        LABELS[name]: (*cells, *(_cost(results["costs"][name], column) for column in COSTS))
        for name, cells in quality(methods, METRICS).items()
    }
    rows |= {LABELS[name]: (Cell(text=reason),) for name, reason in missing.items()}
    counts = next(iter(methods.values()))
    return Table(
        title=f"Methods, {counts['objects']} unseen objects, {counts['views']} views",
        heads=(*HEADS, *COSTS.values()),
        rows=tuple((label, rows[label]) for label in LABELS.values() if label in rows),
        note="Means over images with 95 % bootstrap intervals over objects; the best of a column stands out.",
    )


def differences_table(first: str, differences: Mapping) -> Table:
    """A network minus each other method, image by image."""
    rows = tuple(
        (f"{LABELS[first]} minus {lowered(name)}", tuple(difference(row.get(metric), metric) for metric in METRICS))
        for name, row in differences.items()
    )
    note = "Image by image, with 95 % bootstrap intervals and the p-value of a sign-flip test, both over objects."
    return Table(title="Paired differences", heads=HEADS, rows=rows, note=note)


def _cost(cost: Mapping, column: str) -> Cell:
    value = cost.get(column)
    if column == "training_seconds" and value is not None:
        return Cell(text=duration(value), value=value)
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
