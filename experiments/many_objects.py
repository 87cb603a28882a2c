"""Whole training runs, and objects, by the handful in one compiled program: vmap beside a Python loop.

    python -m experiments.many_objects --data DIR --out DIR [--runs 8] [--steps 60] [--preset tiny]

Three questions, each answered by running the project's own functions (experiments/many_runs.py names the forms):

    train    do M runs (seeds) in one program equal M single runs: parameters, loss curves?
    pace     how many steps of a run a second does each form make, the forms in turns, on the same data?
    render   the same for encoding and rendering N objects; here the package's own batch axis is a fourth form

    OUT/train_FORM.npz        states and losses, saved every so many steps; a stopped call goes on there
    OUT/pace.json  render.json  results.json  table.md  many_objects.png

The learning rate is no axis of runs: the config, which holds it, is static, so that each value is a program of its own.
"""

import dataclasses
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import claims, many_runs
from experiments.many_objects_report import LABELS, plot, table
from experiments.many_runs import FORMS, Form
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.kernels.records import Camera, PointCloud
from spnr_jax.method import inference
from spnr_jax.presets import PRESETS
from spnr_jax.training import optimisation, run_record

SAVE_EVERY = 20


@dataclass(frozen=True, kw_only=True)
class ManyObjects:
    """Train M seeds, and render N objects, in one compiled program."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results; the same command goes on there."""
    preset: str = "tiny"
    """Network and losses."""
    runs: int = 8
    """Runs that train at once, with the seeds SEED, SEED + 1, ..."""
    steps: int = 60
    """Steps of each run, its warm-up, decay and discriminator over exactly these."""
    objects: int = 16
    """Objects that are encoded and rendered at once, one view each."""
    rounds: int = 6
    """Turns of every form when it is timed."""
    map: bool = True
    """Whether jax.lax.map is tried too; on a CPU it can take many times as long as the other forms together."""
    seed: int = 0
    """First seed."""
    quick: bool = False
    """A check that everything works: two runs of three steps, two objects, one round."""

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise ValueError(f"--preset {self.preset}: expected one of {', '.join(PRESETS)}")
        for name in ("runs", "steps", "objects", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name}: expected 1 or more, got {getattr(self, name)}")

    @property
    def forms(self) -> tuple[Form, ...]:
        """The forms that train."""
        return FORMS if self.map else FORMS[:2]


def main(options: ManyObjects) -> None:
    """Answers what is not answered yet, then writes results, table and curves."""
    cli.set_up_jax()
    if options.quick:
        options = dataclasses.replace(options, runs=2, steps=3, objects=2, rounds=1)
    dataset = data_sets.open_dataset(options.data)
    config = dataclasses.replace(PRESETS[options.preset](), num_steps=options.steps, seed=options.seed)
    names = (*dataset.splits["test"], *dataset.splits["train"])[: options.objects]
    if len(names) < options.objects:
        raise ValueError(f"--objects {options.objects}: {dataset.folder} has {len(names)} to render")
    asked = {
        "preset": options.preset,
        "runs": options.runs,
        "steps": options.steps,
        "objects": options.objects,
        "rounds": options.rounds,
        "map": options.map,
        "seed": options.seed,
        "data": run_record.checksum(dataset),
    }
    claims.claim(options.out / "many_objects.json", asked, "many objects")
    seeds = range(options.seed, options.seed + options.runs)
    start = many_runs.create(config, seeds)
    trained = {form: train(form, options.out, dataset, config, seeds, start) for form in options.forms}
    pace = claims.kept(options.out / "pace.json", partial(measure_pace, options, dataset, config, seeds, start))
    render = claims.kept(
        options.out / "render.json", partial(measure_rendering, options, dataset, config, names, start)
    )
    results = asked | {
        "hardware": machine.hardware(),
        "parameters": sum(x[0].size for x in jax.tree.leaves(start.generator)),
        "batch objects": config.batch_objects,
        "losses": {form: losses.tolist() for form, (_, losses) in trained.items()},
        "apart from the loop": {form: equality(trained, form) for form in options.forms[1:]},
        "pace": pace,
        "render": render,
    }
    write_whole(options.out / "results.json", (json.dumps(results, indent=1, allow_nan=False) + "\n").encode())
    write_whole(options.out / "table.md", table(results).encode())
    write_whole(options.out / "many_objects.png", plot(results))
    print(table(results))
    print(f"wrote results.json, table.md and many_objects.png in {options.out}")


def train(
    form: Form,
    out: Path,
    dataset: data_sets.Dataset,
    config: TrainConfig,
    seeds: Sequence[int],
    start: optimisation.TrainState,
) -> tuple[optimisation.TrainState, np.ndarray]:
    """States after the last step and the losses (steps, runs), by one form; goes on where it was stopped."""
    place = out / f"train_{form}.npz"
    states, losses = many_runs.restore(place, start) or (start, np.zeros((0, len(seeds))))
    first = len(losses)
    if first == config.num_steps:
        return states, losses
    found, rows = many_runs.entered_states(form, states), list(losses)
    adversarial_from = optimisation.first_adversarial_step(config)
    steps = {late: many_runs.form_step(form, config, late) for late in (False, True)}
    for step, batch in enumerate(many_runs.batches(dataset, config, seeds, first), start=first):
        found, metrics = steps[step >= adversarial_from](found, many_runs.entered_batch(form, batch))
        rows.append(np.asarray(metrics["loss"], np.float64))
        if not np.isfinite(rows[-1]).all():
            raise ValueError(f"a loss of {LABELS[form]} is not finite at step {step + 1}; try --preset tiny")
        if (step + 1) % SAVE_EVERY == 0 or step + 1 == config.num_steps:
            many_runs.save(place, many_runs.left(form, found), np.array(rows))
            print(f"{LABELS[form]}: step {step + 1} of {config.num_steps}, {len(seeds)} runs", flush=True)
    return many_runs.left(form, found), np.array(rows)


def equality(trained: dict[Form, tuple[optimisation.TrainState, np.ndarray]], form: Form) -> dict[str, float]:
    """How far a form's parameters and losses lie from those of the loop, relative to these."""
    (states, losses), (expected, curve) = trained[form], trained["loop"]
    apart = many_runs.apart(states, expected)
    relative = np.abs(losses - curve) / np.abs(curve)
    return apart | {"first loss": float(relative[0].max()), "losses": float(relative.max())}


def measure_pace(
    options: ManyObjects,
    dataset: data_sets.Dataset,
    config: TrainConfig,
    seeds: Sequence[int],
    start: optimisation.TrainState,
) -> dict[str, dict[str, list[float]]]:
    """Seconds of a step of all runs by each form, turn by turn, without and with the discriminator."""
    batch = next(many_runs.batches(dataset, config, seeds, 0))
    phases = {"without discriminator": False}
    if optimisation.first_adversarial_step(config) < config.num_steps:
        phases["with discriminator"] = True
    found = {}
    for phase, adversarial in phases.items():
        turns = {}
        for form in options.forms:
            step, piece = many_runs.form_step(form, config, adversarial), many_runs.entered_batch(form, batch)
            turns[form] = partial(turn, step, [many_runs.entered_states(form, start)], piece)
        found[phase] = in_turns(turns, options.rounds)
        print(f"timed {phase}", flush=True)
    return found


def turn(step: many_runs.Step, states: list[Any], batch: Any) -> object:
    """One step; the states are kept in their list."""
    states[0], metrics = step(states[0], batch)
    return states[0], metrics


def in_turns(work: Mapping[Any, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """Seconds of each piece of work in every round; the first calls, which compile, do not count."""
    for one in work.values():
        jax.block_until_ready(one())
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds):
        for name, one in work.items():
            begin = time.perf_counter()
            jax.block_until_ready(one())
            seconds[name].append(round(time.perf_counter() - begin, 6))
    return seconds


def measure_rendering(
    options: ManyObjects,
    dataset: data_sets.Dataset,
    config: TrainConfig,
    names: Sequence[str],
    start: optimisation.TrainState,
) -> dict[str, Any]:
    """Seconds to encode and render one view of every object by each form, and how far the images lie apart."""
    variables = optimisation.averaged_variables(many_runs.unstack(start)[0])
    items = [data_sets.read_object(dataset, name) for name in names]
    data_sets.check_resolution(items[0], config)
    inputs = [
        (data_sets.test_cloud(item, config), jax.tree.map(lambda x: np.asarray(x)[:1], item.camera)) for item in items
    ]
    cloud, camera = jax.device_put(jax.tree.map(lambda *x: np.stack(x), *inputs))

    def one(cloud: PointCloud, camera: Camera) -> jax.Array:
        cloud, camera = jax.tree.map(lambda x: x[None], (cloud, camera))
        return whole(cloud, camera)[0]

    def whole(cloud: PointCloud, camera: Camera) -> jax.Array:
        scene = inference.encode(variables, cloud, config=config.model)
        return inference.render(variables, scene, camera, config=config.model).image

    single, many, batched = jax.jit(one), jax.jit(jax.vmap(one)), jax.jit(whole)
    mapped = jax.jit(lambda cloud, camera: jax.lax.map(lambda x: one(*x), (cloud, camera)))
    pieces = [jax.tree.map(lambda x, i=i: x[i], (cloud, camera)) for i in range(len(names))]
    work = {
        "loop": lambda: jnp.stack([single(*piece) for piece in pieces]),
        "vmap": lambda: many(cloud, camera),
        "map": lambda: mapped(cloud, camera),
        "batch": lambda: batched(cloud, camera),
    }
    expected = np.asarray(work["loop"]())
    apart = {form: float(np.abs(np.asarray(images()) - expected).max()) for form, images in work.items()}
    seconds = in_turns(work, options.rounds)
    print("timed rendering", flush=True)
    return {"seconds": seconds, "largest difference of a pixel": apart}


if __name__ == "__main__":
    run = partial(tyro.cli, ManyObjects, prog="python -m experiments.many_objects")
    sys.exit(cli.guarded(lambda: main(run()), "many_objects"))
