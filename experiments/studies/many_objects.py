"""Whole trainings, and objects, by the handful in one compiled program: `jax.vmap` beside a Python loop.

    python -m experiments.studies.many_objects --data DIR --out DIR [--runs 8] [--steps 20] [--preset tiny]

M runs (seeds) of a training step (`spnr_jax/training/many_runs.py`), and N objects that are encoded and rendered, are
each done by a Python loop over the jitted function and by one program under vmap, in turns.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import entry_point
from experiments.comparison import results_folder
from experiments.comparison.result_tables import Table, number
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.kernels.records import Batch
from spnr_jax.method import inference
from spnr_jax.presets import PRESETS
from spnr_jax.training import batching, many_runs, optimisation


@dataclass(frozen=True, kw_only=True)
class ManyObjects:
    """Train M seeds, and render N objects, in one compiled program."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results."""
    preset: str = "tiny"
    """Network and losses."""
    runs: int = 8
    """Runs that train at once, with the seeds 0, 1, ..."""
    steps: int = 20
    """Steps of each run, its warm-up and decay over exactly these."""
    objects: int = 16
    """Objects that are encoded and rendered at once, one view each."""


def main(options: ManyObjects) -> None:
    """Trains and renders in both forms, and writes how fast they were and how far they lie apart."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    config = dataclasses.replace(PRESETS[options.preset](), num_steps=options.steps)
    names = (*dataset.splits["test"], *dataset.splits["train"])[: options.objects]
    trained = train(dataset, config, range(options.runs))
    rendered = render(dataset, config, names)
    found = {"hardware": machine.hardware(), "preset": options.preset, "train": trained, "render": rendered}
    rows = (
        (f"{options.runs} runs, steps of a run a second", row(trained, options.runs)),
        (f"{len(names)} objects, views a second", row(rendered, len(names))),
    )
    heads = ("Python loop", "jax.vmap", "vmap over loop", "apart at first, relative", "at last")
    table = Table(title="One compiled program beside a loop", heads=heads, rows=rows)
    results_folder.write(
        options.out, found, [table], [f"Preset {options.preset}, {options.steps} steps; {found['hardware']}."]
    )


def row(found: Mapping[str, Any], count: int) -> tuple:
    """Rates of both forms, their ratio with the least and the most of all turns, and the differences."""
    loop, vmap = (np.array(found["seconds"][form]) for form in ("loop", "vmap"))
    ratios = loop / vmap
    rates = (number(count / float(np.median(seconds)), 2) for seconds in (loop, vmap))
    ratio = number(float(np.median(ratios)), 2, (float(ratios.min()), float(ratios.max())))
    return (*rates, ratio, *(number(value, 8) for value in found["apart"]))


def train(dataset: data_sets.Dataset, config: TrainConfig, seeds: Sequence[int]) -> dict[str, Any]:
    """Seconds of a step of all runs in both forms, and the largest relative difference of a loss, first and in all."""
    singles = [optimisation.jitted_create_state(config, jnp.uint32(seed)) for seed in seeds]
    stacked = many_runs.stack(singles)
    adversarial_from = optimisation.first_adversarial_step(config)
    seconds: dict[str, list[float]] = {"loop": [], "vmap": []}
    apart = []
    for step, batch in enumerate(batches(dataset, config, seeds)):
        late = step >= adversarial_from
        one = partial(optimisation.jitted_train_step, config=config, adversarial=late)
        pieces = [jax.tree.map(lambda x, i=i: x[i], batch) for i in range(len(seeds))]
        start = time.perf_counter()
        stepped = jax.block_until_ready([one(state, piece) for state, piece in zip(singles, pieces, strict=True)])
        middle = time.perf_counter()
        stacked, metrics = jax.block_until_ready(
            many_runs.jitted_train_step(stacked, batch, config=config, adversarial=late)
        )
        for form, taken in (("loop", middle - start), ("vmap", time.perf_counter() - middle)):
            seconds[form].append(taken)
        singles = [state for state, _ in stepped]
        losses = np.array([float(one["loss"]) for _, one in stepped])
        apart.append(float(np.abs(np.asarray(metrics["loss"]) / losses - 1).max()))
    warm = {form: [s for i, s in enumerate(found) if i not in (0, adversarial_from)] for form, found in seconds.items()}
    return {"seconds": warm, "apart": [apart[0], max(apart)]}


def batches(dataset: data_sets.Dataset, config: TrainConfig, seeds: Sequence[int]) -> Iterator[Batch]:
    """Of each step the batches of all runs, each the one that the run alone would see."""
    read = batching.cached_reader(dataset, config, batching.CACHE_BYTES)
    for step in range(config.num_steps):
        made = []
        for one in (dataclasses.replace(config, seed=seed) for seed in seeds):
            names = batching.object_names(dataset.splits["train"], one, step)
            made.append(batching.make_batch([read(name) for name in names], one, step))
        yield jax.device_put(jax.tree.map(lambda *x: np.stack(x), *made))


def render(dataset: data_sets.Dataset, config: TrainConfig, names: Sequence[str], rounds: int = 6) -> dict[str, Any]:
    """Seconds to encode and render one view of every object in both forms, and the largest difference of a pixel."""
    variables = optimisation.averaged_variables(optimisation.jitted_create_state(config))
    items = [data_sets.read_object(dataset, name) for name in names]
    inputs = [
        (data_sets.test_cloud(item, config), jax.tree.map(lambda x: np.asarray(x)[:1], item.camera)) for item in items
    ]
    stacked = jax.device_put(jax.tree.map(lambda *x: np.stack(x), *inputs))

    def one(cloud, camera) -> jax.Array:
        cloud, camera = jax.tree.map(lambda x: x[None], (cloud, camera))
        scene = inference.encode(variables, cloud, config=config.model)
        return inference.render(variables, scene, camera, config=config.model).image[0]

    single, many = jax.jit(one), jax.jit(jax.vmap(one))
    pieces = [jax.tree.map(lambda x, i=i: x[i], stacked) for i in range(len(names))]
    work: dict[str, Callable] = {"loop": lambda: [single(*piece) for piece in pieces], "vmap": lambda: many(*stacked)}
    apart = float(np.abs(np.asarray(work["vmap"]()) - np.stack(work["loop"]())).max())  # and compiles
    seconds: dict[str, list[float]] = {"loop": [], "vmap": []}
    for _ in range(rounds):
        for form, images in work.items():
            start = time.perf_counter()
            jax.block_until_ready(images())
            seconds[form].append(time.perf_counter() - start)
    return {"seconds": seconds, "apart": [apart, apart]}


if __name__ == "__main__":
    entry_point.run(main, ManyObjects, "studies.many_objects")
