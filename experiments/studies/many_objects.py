"""Whole trainings, and objects, by the handful in one compiled program: `jax.vmap` beside a Python loop.

    python -m experiments.studies.many_objects --data DIR --out DIR [--runs 8] [--steps 20] [--preset tiny]

M runs (seeds) of a training step (`spnr_jax/training/many_runs.py`), one small network fitted to each of N objects,
and N objects that are encoded and rendered, are each done by a Python loop over the jitted function and by one program
under vmap, in turns.  Objects of many sizes are encoded in a loop, each padded to its own power of two, by one program
padded to the largest, and by one program for each power of two.

seconds  of the processor on a CPU, all cores together: other work on the machine does not count
MB       temporary memory of the compiled program, the largest where there are several
apart    largest relative difference of a loss, and largest difference of a pixel or of an encoded number
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import entry_point
from experiments.comparison import clock, results_folder
from spnr_jax import cli
from spnr_jax.config import RayNetworkConfig, TrainConfig
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.kernels import cloud_arrays
from spnr_jax.kernels.records import Batch, PointCloud
from spnr_jax.method import inference
from spnr_jax.presets import PRESETS
from spnr_jax.scoring.score_tables import Table, number
from spnr_jax.training import adversary, batching, many_runs, optimisation

MOST_POINTS = 4096  # of an object that is encoded


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
    """Objects that are encoded and rendered at once, one view each, and to each of which a network is fitted."""
    encoded: int = 64
    """Objects of different sizes that are encoded at once."""


def main(options: ManyObjects) -> None:
    """Trains, fits, encodes and renders in all forms, and writes how fast they were and how far they lie apart."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    config = dataclasses.replace(PRESETS[options.preset](), num_steps=options.steps)
    names = (*dataset.splits["test"], *dataset.splits["train"])[: options.objects]
    trained = train(dataset, config, range(options.runs))
    fitted = train(dataset, fitting(config), [0] * len(names), names)
    rendered = render(dataset, config, names)
    found: dict[str, Any] = {"hardware": machine.hardware(), "load": machine.load(), "preset": options.preset}
    found |= {"train": trained, "fit": fitted, "render": rendered}
    rows = (
        (f"{options.runs} runs, steps of a run a second", row(trained, options.runs)),
        (f"{len(names)} networks, one for each object, steps of one a second", row(fitted, len(names))),
        (f"{len(names)} objects, views a second", row(rendered, len(names))),
    )
    heads = ("Python loop", "jax.vmap", "vmap over loop", "apart at first", "at last", "MB, one", "MB, all")
    tables = [Table(title="One compiled program beside a loop", heads=heads, rows=rows)]
    found["encode"] = encode(dataset, config, options.encoded)
    tables.append(encoding_table(found["encode"], options.encoded))
    note = f"Preset {options.preset}, {options.steps} steps; {found['hardware']}, load {found['load']}."
    results_folder.write(options.out, found, tables, [note])


def row(found: Mapping[str, Any], count: int) -> tuple:
    """Rates of both forms, their ratio with the least and the most of all turns, the differences, the memory."""
    loop, vmap = (np.array(found["seconds"][form]) for form in ("loop", "vmap"))
    ratios = loop / vmap
    rates = (number(count / float(np.median(seconds)), 2) for seconds in (loop, vmap))
    ratio = number(float(np.median(ratios)), 2, (float(ratios.min()), float(ratios.max())))
    memory = (number(found["mb"][form], 1) for form in ("loop", "vmap"))
    return (*rates, ratio, *(number(value, 8) for value in found["apart"]), *memory)


def encoding_table(found: Mapping[str, Any], count: int) -> Table:
    """A row for each form of encoding objects of many sizes."""
    loop = np.array(found["seconds"]["loop"])
    rows = []
    for form, seconds in found["seconds"].items():
        ratios = loop / np.array(seconds)
        cells = [number(count / float(np.median(seconds)), 1)]
        cells.append(number(float(np.median(ratios)), 2, (float(ratios.min()), float(ratios.max()))))
        rows.append((form, (*cells, number(found["padding"][form], 2), number(found["mb"][form], 1))))
    low, high = found["points"]
    title = f"{count} objects of {low} to {high} points encoded"
    return Table(
        title=title, heads=("objects a second", "over the loop", "points with padding", "MB"), rows=tuple(rows)
    )


def fitting(config: TrainConfig) -> TrainConfig:
    """The config of a small network of one object: a volume of half the resolution, no discriminator."""
    model = config.model
    if isinstance(model, RayNetworkConfig):
        halved = model.encoder.volume_resolution // 2
        encoder = dataclasses.replace(model.encoder, volume_resolution=halved)
        model = dataclasses.replace(model, encoder=encoder)
    return dataclasses.replace(config, model=model, loss=dataclasses.replace(config.loss, adversarial_weight=0.0))


def train(
    dataset: data_sets.Dataset, config: TrainConfig, seeds: Sequence[int], objects: Sequence[str] | None = None
) -> dict[str, Any]:
    """Seconds of a step of all runs in both forms, the largest relative difference of a loss, first and in all, and MB.

    With `objects` each run sees one of them alone.
    """
    singles = [optimisation.jitted_create_state(config, jnp.uint32(seed)) for seed in seeds]
    stacked = many_runs.stack(singles)
    adversarial_from = adversary.first_adversarial_step(config)
    seconds: dict[str, list[float]] = {"loop": [], "vmap": []}
    memory, apart, losses = {"loop": 0.0, "vmap": 0.0}, [], []
    for step, batch in enumerate(batches(dataset, config, seeds, objects)):
        pieces = [jax.tree.map(lambda x, i=i: x[i], batch) for i in range(len(seeds))]
        if step in (0, adversarial_from):
            static = {"config": config, "adversarial": step >= adversarial_from}
            one = optimisation.jitted_train_step.lower(singles[0], pieces[0], **static).compile()
            many = many_runs.jitted_train_step.lower(stacked, batch, **static).compile()
            memory = {form: max(memory[form], temporary_mb(p)) for form, p in (("loop", one), ("vmap", many))}
        start = clock.now()
        stepped = jax.block_until_ready([one(state, piece) for state, piece in zip(singles, pieces, strict=True)])
        middle = clock.now()
        stacked, metrics = jax.block_until_ready(many(stacked, batch))
        for form, taken in (("loop", middle - start), ("vmap", clock.now() - middle)):
            seconds[form].append(taken)
        singles = [state for state, _ in stepped]
        alone = np.array([float(metrics_of["loss"]) for _, metrics_of in stepped])
        losses.append(float(alone.mean()))
        apart.append(float(np.abs(np.asarray(metrics["loss"]) / alone - 1).max()))
    warm = {form: [s for i, s in enumerate(found) if i not in (0, adversarial_from)] for form, found in seconds.items()}
    return {"seconds": warm, "apart": [apart[0], max(apart)], "mb": memory, "losses": [losses[0], losses[-1]]}


def temporary_mb(program: Any) -> float:
    """MB of 2^20 bytes that a compiled program needs beside its inputs and outputs."""
    analysis = program.memory_analysis()
    return analysis.temp_size_in_bytes / 2**20 if analysis else float("nan")


def batches(
    dataset: data_sets.Dataset, config: TrainConfig, seeds: Sequence[int], objects: Sequence[str] | None = None
) -> Iterator[Batch]:
    """Of each step the batches of all runs, each the one that the run alone would see: of one object, if it has one."""
    pools = [(name,) for name in objects] if objects else [dataset.splits["train"]] * len(seeds)
    read = batching.cached_reader(dataset, config, batching.CACHE_BYTES)
    for step in range(config.num_steps):
        made = []
        for seed, pool in zip(seeds, pools, strict=True):
            one = dataclasses.replace(config, seed=seed)
            names = batching.object_names(pool, one, step)
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

    pieces = [jax.tree.map(lambda x, i=i: x[i], stacked) for i in range(len(names))]
    single, many = jax.jit(one).lower(*pieces[0]).compile(), jax.jit(jax.vmap(one)).lower(*stacked).compile()
    work: dict[str, Callable] = {"loop": lambda: [single(*piece) for piece in pieces], "vmap": lambda: many(*stacked)}
    apart = float(np.abs(np.asarray(work["vmap"]()) - np.stack(work["loop"]())).max())
    memory = {"loop": temporary_mb(single), "vmap": temporary_mb(many)}
    return {"seconds": clock.in_turns(work, rounds), "apart": [apart, apart], "mb": memory}


def encode(dataset: data_sets.Dataset, config: TrainConfig, count: int, rounds: int = 4) -> dict[str, Any]:
    """Seconds to encode objects of many sizes in each form, their points with padding over those without, and MB."""
    variables = optimisation.averaged_variables(optimisation.jitted_create_state(config))
    clouds = clouds_of_many_sizes(dataset, count)

    def one(cloud: PointCloud) -> Any:
        scene = inference.encode(variables, jax.tree.map(lambda x: x[None], cloud), config=config.model)
        return jax.tree.map(lambda x: x[0], scene)

    points = [len(cloud.positions) for cloud in clouds]
    buckets = [cloud_arrays.bucket(number_of) for number_of in points]
    padded = [jax.device_put(cloud_arrays.pad(c, b)) for c, b in zip(clouds, buckets, strict=True)]
    groups = {b: stacked_clouds([c for c, own in zip(padded, buckets, strict=True) if own == b]) for b in set(buckets)}
    whole = stacked_clouds([cloud_arrays.pad(cloud, max(buckets)) for cloud in clouds])
    by_bucket = {c.positions.shape: jax.jit(one).lower(c).compile() for c in padded}
    of_groups = {b: jax.jit(jax.vmap(one)).lower(group).compile() for b, group in groups.items()}
    at_once = jax.jit(jax.vmap(one)).lower(whole).compile()
    work: dict[str, Callable] = {
        "loop": lambda: [by_bucket[c.positions.shape](c) for c in padded],
        "vmap, padded to the largest": lambda: at_once(whole),
        "vmap for each power of two": lambda: [of_groups[b](group) for b, group in groups.items()],
    }
    programs = (by_bucket.values(), [at_once], of_groups.values())
    held = (sum(buckets), max(buckets) * count, sum(buckets))
    return {
        "seconds": clock.in_turns(work, rounds),
        "points": [min(points), max(points)],
        "padding": {form: with_padding / sum(points) for form, with_padding in zip(work, held, strict=True)},
        "mb": {form: max(map(temporary_mb, made)) for form, made in zip(work, programs, strict=True)},
    }


def clouds_of_many_sizes(dataset: data_sets.Dataset, count: int) -> list[PointCloud]:
    """Clouds of so many objects (again and again, if there are fewer), from a 32nd of their points on up to all."""
    names = [name for split in dataset.splits.values() for name in split]
    clouds = [data_sets.read_object(dataset, name).cloud for name in names[:count]]
    most = min(min(len(cloud.positions) for cloud in clouds), MOST_POINTS)
    sizes = np.random.default_rng(0).permutation(np.geomspace(max(most // 32, 2), most, count).astype(int))
    return [
        dataclasses.replace(jax.tree.map(lambda x, n=n: x[:n], clouds[i % len(clouds)]), normals=None)
        for i, n in enumerate(sizes)
    ]


def stacked_clouds(clouds: Sequence[PointCloud]) -> PointCloud:
    """Clouds of one size with an axis of objects first."""
    return jax.device_put(jax.tree.map(lambda *x: np.stack(x), *clouds))


if __name__ == "__main__":
    entry_point.run(main, ManyObjects, "studies.many_objects")
