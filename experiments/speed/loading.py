"""Whether training waits for its data: both forms of a data set, read alone and under the train steps of the presets.

    python -m experiments.speed.loading DATASET [--presets tiny small abo] [--out runs/loading]

The data set is packed into a temporary folder first. Nothing is kept in the cache of decoded objects, so every object
is read and decoded anew, as it is where a data set is larger than memory. A preset is left out, with a line, if the
images of the data set have another size than its network's.

samples/s   objects a second that come out of the loader when nobody else works
ms a step   median train step, data included, after the first, which compiles
waiting     share of the steps' time before the batch was there
"""

import dataclasses
import json
import sys
import tempfile
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import tyro
from tqdm import tqdm

from data_gen.store.pack import PackConfig, pack
from experiments import entry_point
from experiments.comparison import results_folder
from spnr_jax import cli, presets
from spnr_jax.config import TrainConfig
from spnr_jax.devices import machine
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.scoring.score_tables import Table, number, text
from spnr_jax.training import batching, optimisation

TARGET = 0.02  # share of a step


@dataclass(frozen=True, kw_only=True)
class Loading:
    """Measure the loader alone and the share of train steps spent waiting for it."""

    dataset: tyro.conf.Positional[Path]
    """Folder of the data set."""
    out: Path = Path("runs/loading")
    """Folder of a folder for each size of images, with results.json and table.md."""
    presets: tuple[str, ...] = ("tiny", "small", "abo")
    """Presets whose train step is measured."""
    steps: int = 20
    """Train steps that are timed; one more compiles."""
    batches: int = 100
    """Batches that the loader alone delivers."""


def main(options: Loading) -> None:
    """Measures, and writes the figures as JSON and as a Markdown table."""
    cli.set_up_jax()
    size = image_size(data_sets.open_dataset(options.dataset))
    rows: list[dict] = []
    with tempfile.TemporaryDirectory() as folder:
        pack(PackConfig(dataset=options.dataset, out=Path(folder) / "packed"))
        for preset in options.presets:
            settings = presets.PRESETS[preset]()
            if settings.model.image_resolution != size:
                print(f"{preset} left out: it needs images of {settings.model.image_resolution} px, these have {size}")
                continue
            for form, place in (("folder", options.dataset), ("packed", Path(folder) / "packed")):
                figures = measure(data_sets.open_dataset(place), settings, options)
                rows.append({"preset": preset, "form": form, "batch_objects": settings.batch_objects, **figures})
                print(json.dumps(rows[-1]), file=sys.stderr)
    if not rows:
        raise UserError(f"{options.dataset}: no preset of {', '.join(options.presets)} has images of {size} px")
    found = {"hardware": machine.hardware(), "image_size": size, "rows": rows}
    results_folder.write(options.out / str(size), found, [table(rows)], [machine.hardware()])


def image_size(dataset: data_sets.Dataset) -> int:
    """Width of the data set's images in pixels."""
    return data_sets.read_object(dataset, dataset.splits["train"][0]).camera.width


def measure(dataset: data_sets.Dataset, settings: TrainConfig, options: Loading) -> dict[str, float]:
    """The figures of one data set under one preset, with the discriminator at work."""
    settings = dataclasses.replace(settings, num_steps=1 + max(options.steps, options.batches))
    waits, steps = time_steps(dataset, settings, options.steps)
    return {
        "samples_per_second": round(samples_per_second(dataset, settings, options.batches), 1),
        "ms_per_step": round(1000 * float(np.median(steps)), 1),
        "waiting": round(sum(waits) / sum(steps), 5),
    }


def samples_per_second(dataset: data_sets.Dataset, settings: TrainConfig, num_batches: int) -> float:
    """Objects a second that the loader delivers, after the first batch."""
    with closing(batching.batches(dataset, settings, 0, cache_bytes=0)) as batches:
        next(batches)
        start = time.monotonic()
        for _ in range(num_batches):
            next(batches)
        return num_batches * settings.batch_objects / (time.monotonic() - start)


def time_steps(dataset: data_sets.Dataset, settings: TrainConfig, num_steps: int) -> tuple[list[float], list[float]]:
    """Seconds of each train step before its batch was there, and in all."""
    state = optimisation.jitted_create_state(settings)
    waits, steps = [], []
    with closing(batching.batches(dataset, settings, 0, cache_bytes=0)) as batches:
        for _ in tqdm(range(1 + num_steps), desc=f"{settings.preset} {dataset.folder.name}"):
            start = time.monotonic()
            batch = next(batches)
            waits.append(time.monotonic() - start)
            state, metrics = optimisation.jitted_train_step(
                state, jax.device_put(batch), config=settings, adversarial=settings.loss.adversarial_weight > 0
            )
            jax.block_until_ready((state, metrics))
            steps.append(time.monotonic() - start)
    return waits[1:], steps[1:]


def table(rows: list[dict]) -> Table:
    """The figures of each preset and form."""
    heads = ("form", "objects a step", "objects a second", "ms a step", f"waiting, % (at most {100 * TARGET:g})")
    made = tuple(
        (
            row["preset"],
            (
                text(row["form"]),
                number(row["batch_objects"], 0),
                number(row["samples_per_second"], 0),
                number(row["ms_per_step"], 0),
                number(row["waiting"], 2, factor=100),
            ),
        )
        for row in rows
    )
    return Table(title="Reading beside training", heads=heads, rows=made)


if __name__ == "__main__":
    entry_point.run(main, Loading, "speed.loading")
