"""All that a GPU is asked for, in one command that ends with one table; on a CPU with --quick, a check of itself.

    python -m experiments.speed.gpu [--out runs/gpu] [--quick]

    the paper's network      beside the compiled PyTorch twin, both in bfloat16 (experiments/speed/bench.py)
    the surfel network       frames a second at 512 and 1,024 px, as `spnr render` draws a film; training steps
    many trainings at once   runs of `tiny` and of the surfel network under one `jax.vmap`, and the same ones in a loop

Seconds are those of the clock, on a CPU of the processor, all cores together: other work does not count there.
Memory is what the compiler lays out for a program: its arguments, its results, and what it needs between.
JAX takes the memory of a GPU piece by piece here, so that both sides of the first part fit beside each other.

    OUT/results.json  table.md   OUT/bench the rows of the first part
"""

import dataclasses
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import entry_point
from experiments.comparison import clock, results_folder
from experiments.speed import bench
from experiments.speed.speed_scenes import orbiting, paper_training, random_crops, surfel_training, surfel_volume
from spnr_jax import cli
from spnr_jax.config import SurfelConfig, TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.method import surfel_method
from spnr_jax.scoring.report import Table, number, text
from spnr_jax.surfels.lighting import room_light
from spnr_jax.training import optimisation


@dataclass(frozen=True, kw_only=True)
class OnGPU:
    """Time what a GPU is for; write one table."""

    out: Path = Path("runs/gpu")
    """Folder of the results."""
    points: int = 4096
    """Points of the object that frames show."""
    frames: int = 48
    """Frames of a film."""
    runs: int = 8
    """Trainings at once."""
    rounds: int = 10
    """Turns of what is timed in turns."""
    quick: bool = False
    """A check that everything works, on any device: small networks, two turns."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """A row of the table."""

    what: str
    unit: str
    a_second: float
    beside: float | None = None
    """The same by the other side: the twin, or the loop."""
    megabytes: float | None = None


def main(options: OnGPU) -> None:
    """Measures one part after the other, a line for each row."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    cli.set_up_jax()
    if options.quick:
        options = dataclasses.replace(options, points=128, frames=2, runs=2, rounds=2)
    parts: tuple[Callable[[OnGPU], list[Found]], ...] = (films, surfel_steps, many_trainings, beside_twin)
    rows = []
    for part in parts:
        for row in part(options):
            rows.append(row)
            print(f"{row.what}: {row.a_second:.1f} {row.unit} a second", flush=True)
    notes = [f"{runtime.hardware()}; {runtime.processor()}; jax {jax.__version__}; {time.strftime('%Y-%m-%d')}."]
    found = {"hardware": runtime.hardware(), "rows": [dataclasses.asdict(row) for row in rows]}
    results_folder.write(options.out, found, [table(rows)], notes)


def films(options: OnGPU) -> list[Found]:
    """Frames of an orbit, each of them brought to the host."""
    config = SurfelConfig(widths=(4, 6), top=4) if options.quick else SurfelConfig()
    variables, light = surfel_method.init(jax.random.key(0), config), room_light()
    volume, rows = surfel_volume(options.points), []
    draw = partial(surfel_method.render, variables, volume, config=config, quality="best")
    for size in (32, 64) if options.quick else (512, 1024):
        views = [orbiting(size, 0.1 * frame) for frame in range(options.frames)]

        def film(views: list = views) -> None:
            for frame in draw(views, [light] * len(views)):
                np.asarray(frame.image)

        seconds = least(film, 2)
        rows.append(Found(what=f"surfel network, {size} px", unit="frames", a_second=options.frames / seconds))
    return rows


def surfel_steps(options: OnGPU) -> list[Found]:
    """Training steps of the preset `surfels`, on crops that are on the device."""
    config = surfel_training(options.quick)
    crops = random_crops(config, doublings=1)
    compiled = compile_of(
        partial(optimisation.train_step, config=config), optimisation.jitted_create_state(config), crops
    )
    seconds = least(compiled.run, options.rounds)
    what = f"training of `surfels`, {len(crops.seen)} crops of {crops.seen.shape[1]} px doubled once"
    return [Found(what=what, unit="steps", a_second=1 / seconds, megabytes=compiled.megabytes)]


def many_trainings(options: OnGPU) -> list[Found]:
    """Steps of a run, of all runs under one vmap, beside those of a loop over the same step."""
    config = bench.our_config("tiny", "train_l1", 2)
    if options.quick:
        model = paper_training(grid=8, base=8, stages=1, samples=4, render=12).model
        config = dataclasses.replace(config, model=model, batch_objects=1, min_points=64, max_points=64)
    tiny = partial(optimisation.train_step, config=config, adversarial=False)
    surfels = dataclasses.replace(surfel_training(options.quick), batch_objects=2)
    crops = random_crops(surfels, doublings=1)
    over_crops = partial(optimisation.train_step, config=surfels)
    return [
        at_once(options, "`tiny`", tiny, config, bench.our_batch(config)),
        at_once(options, f"`surfels`, 2 crops of {crops.seen.shape[1]} px,", over_crops, surfels, crops),
    ]


def at_once(options: OnGPU, name: str, step: Callable, config: TrainConfig, batch: Any) -> Found:
    """A step of all runs under one vmap beside a loop, in turns."""
    runs = options.runs
    states = [optimisation.jitted_create_state(config, jnp.uint32(seed)) for seed in range(runs)]
    batches = jax.tree.map(lambda x: jnp.stack([x] * runs), batch)
    one = compile_of(step, states[0], batch)
    together = compile_of(jax.vmap(step), jax.tree.map(lambda *x: jnp.stack(x), *states), batches)

    def loop() -> list:
        return [one.run() for _ in range(runs)]

    pairs = [(least(together.run), least(loop)) for _ in range(options.rounds)]
    by_vmap, by_loop = np.median(pairs, axis=0)
    what = f"{runs} trainings of {name} at once"
    rates = {"a_second": runs / by_vmap, "beside": runs / by_loop}
    return Found(what=what, unit="steps of a run", megabytes=together.megabytes, **rates)


def beside_twin(options: OnGPU) -> list[Found]:
    """Rows of the benchmark in bfloat16 on this device; ours alone without torch."""
    asked = bench.Options(out=options.out / "bench", variants=("compiled",), bf16=True, rounds=options.rounds)
    if options.quick:
        asked = dataclasses.replace(asked, presets=("tiny",), modes=("render",), seconds=0.1)
    rows = bench.rows_of(asked)
    return [
        Found(
            what=f"paper's network `{row['preset']}` in bfloat16, {row['mode']}",
            unit="objects",
            a_second=1e3 * row["batch"] / row["ours_ms"],
            beside=row["twin_ms"] and 1e3 * row["batch"] / row["twin_ms"],
        )
        for row in rows
    ]


@dataclass(frozen=True, kw_only=True)
class Compiled:
    """A program with its arguments, and the memory that it takes."""

    run: Callable[[], object]
    megabytes: float


def compile_of(function: Callable, *arguments: Any) -> Compiled:
    """The function compiled for these arguments."""
    program = jax.jit(function).lower(*arguments).compile()
    sizes: Any = program.memory_analysis()
    whole = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return Compiled(run=lambda: program(*arguments), megabytes=whole / 2**20)


def least(run: Callable[[], object], times: int = 1) -> float:
    """Seconds of the fastest of so many runs, after one that compiles or fills the caches."""
    return min(clock.in_turns({"": run}, times)[""])


def table(rows: list[Found]) -> Table:
    """A line for each row."""
    heads = ("a second", "of", "by the twin or the loop", "times that", "MB")
    lines = []
    for row in rows:
        ratio = None if row.beside is None else row.a_second / row.beside
        compared = number(row.beside, 2, missing="-"), number(ratio, 2, missing="-")
        cells = (number(row.a_second, 2), text(row.unit), *compared, number(row.megabytes, 0, missing="-"))
        lines.append((row.what, cells))
    return Table(title="What a GPU is for", heads=heads, rows=tuple(lines))


if __name__ == "__main__":
    entry_point.run(main, OnGPU, "speed.gpu")
