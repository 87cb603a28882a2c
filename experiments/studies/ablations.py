"""Ablations: a reference training, and one that differs in one thing a row, on the same data and budget.

    python -m experiments.studies.ablations --data DIR --out DIR [--steps N | --minutes M] [--seeds 0 1 2] [--rows ...]

    OUT/runs/ROW_SEED/                            run folders; finished ones are only read
    OUT/results.json  table.md                    scores, costs, and differences to the reference with intervals
    OUT/gallery.png                               pictures of unseen objects

Every variant trains for as many steps, or with --minutes for as long.

Rows that are the preset itself (its own depth) are left out, and that without colour variants where the training split
has none: `spnr-data generate DIR --colour-variants 5` makes them.  More rows and seeds can be asked for later.
Runs of one seed see the same batches and jitter, whatever the row.  The same command gives the same scores on a CPU.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from experiments import entry_point
from experiments.comparison import variants
from experiments.comparison.variants import Budget, Variant
from spnr_jax import cli
from spnr_jax.config import PaperConfig, TrainConfig
from spnr_jax.formats import data_sets

REFERENCE = "reference"
LABELS = {
    "no_condition": "No condition image",
    "no_colour_variants": "No colour variants",
    "depth_3": "U-Net of 3 stages",
    "depth_4": "U-Net of 4 stages",
    "depth_5": "U-Net of 5 stages",
    "no_fine_samples": "No fine samples",
    "no_view_direction": "No view direction",
    "plain_inputs": "Materials as they are",
    "fewer_channels": "Two thirds of the volume's channels",
    "no_average": "Last weights, not their average",
    "one_count": "Clouds of one size",
    "more_views": "4 views of an object a step",
    "half_samples": "Half the samples",
    "twice_samples": "Twice the samples",
}
ROWS = tuple(LABELS)
if TYPE_CHECKING:
    Row = str
else:
    Row = Literal[ROWS]


@dataclass(frozen=True, kw_only=True)
class Ablations:
    """Train a preset and variants that differ from it in one thing each, and compare them on unseen objects."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of runs and results; the same command goes on there."""
    rows: tuple[Row, ...] = ROWS
    """What is changed, one thing a row."""
    budget: tyro.conf.OmitArgPrefixes[Budget] = field(default_factory=Budget)


def main(options: Ablations) -> None:
    """Trains what is not trained, scores all rows, writes tables and pictures."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    runs = rows(options.rows, options.budget.config(), dataset)
    variants.study(options.out, "ablations", runs, REFERENCE, options.budget, dataset)


def rows(wanted: tuple[Row, ...], config: TrainConfig, dataset: data_sets.Dataset) -> list[Variant]:
    """The reference, and the rows that differ from it; a line says which do not."""
    found = [Variant(name=REFERENCE, label=f"Unchanged ({config.preset})", config=config, dataset=dataset)]
    for name in (name for name in ROWS if name in wanted):
        plain = variants.without_colour_variants(dataset) if name == "no_colour_variants" else dataset
        variant = Variant(name=name, label=LABELS[name], config=change(name, config), dataset=plain)
        if (variant.config, variant.dataset.splits) == (config, dataset.splits):
            print(f"{LABELS[name]}: left out, {config.preset} is the same or has no such form")
        else:
            found.append(variant)
    return found


def change(row: Row, config: TrainConfig) -> TrainConfig:
    """The config with the one change of a row."""
    return put(config, changes(config).get(row, {}))


def changes(config: TrainConfig) -> dict[str, dict[str, object]]:
    """The fields that rows change, whichever record holds them."""
    assert isinstance(config.model, PaperConfig)
    samples, width = config.model.sampling, config.model.encoder.base_width
    coarse, fine = samples.num_coarse, samples.num_fine
    return {
        "no_condition": {"condition": False},
        **{f"depth_{stages}": {"num_stages": stages} for stages in (3, 4, 5)},
        "no_fine_samples": {"num_coarse": coarse + fine, "num_fine": 0},
        "no_view_direction": {"sees_direction": False},
        "plain_inputs": {"inputs": "plain"},
        "fewer_channels": {"base_width": 2 * width // 3 or 1},
        "no_average": {"ema_decay": 0.0},
        "one_count": {"min_points": config.max_points},
        "more_views": {"views_per_object": 4 * config.views_per_object},
        "half_samples": {"num_coarse": round(coarse / 2), "num_fine": round(fine / 2)},
        "twice_samples": {"num_coarse": 2 * coarse, "num_fine": 2 * fine},
    }


def put(record: Any, fields: Mapping[str, object]) -> Any:
    """A record with these fields changed, in it and in the records that it holds."""
    own = {}
    for name in (one.name for one in dataclasses.fields(record)):
        value = getattr(record, name)
        own[name] = put(value, fields) if dataclasses.is_dataclass(value) else fields.get(name, value)
    return dataclasses.replace(record, **own)


if __name__ == "__main__":
    entry_point.run(main, Ablations, "studies.ablations")
