"""How good a network is after so many seconds of training: PSNR of unseen objects over time, seed by seed.

    python -m experiments.studies.time_to_quality --data DIR --out DIR [--presets ...] [--seconds 90] [--only-pace]

The pace of each preset's steps is measured first and kept: `--only-pace` stops there, so that it can be measured while
the machine is idle.  Every run then trains for the steps that fit into the seconds at that pace, its warm-up and decay
over exactly these, and its averaged network is scored a few times on the way.  The seconds of a row are its steps times
their pace: neither compilation nor scoring is in them, nor what else the machine did meanwhile.

    OUT/paces/PRESET.json           seconds of a step, without and with the discriminator
    OUT/curves/PRESET_SEED.json     a run's rows; a finished run is only read
    OUT/results.json  table.md  curves.png
"""

import dataclasses
import time
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from experiments import entry_point
from experiments.comparison import budget, figures, results_folder
from experiments.comparison.trained_networks import test_objects
from experiments.comparison.variants import Preset
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import machine
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.score_tables import Table, number
from spnr_jax.training import adversary, batching, optimisation

Row = dict[str, float]


@dataclass(frozen=True, kw_only=True)
class TimeToQuality:
    """Train presets for so many seconds, and score them on unseen objects on the way."""

    data: Path
    """Folder of the data set; its test split is scored."""
    out: Path = Path("runs/time_to_quality")
    """Folder of the results; the same command goes on there."""
    presets: tuple[Preset, ...] = ("tiny", "plus_tiny")
    """Networks and losses."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of weights, batches and jitter."""
    seconds: float = 90.0
    """Of training steps, for each run."""
    marks: int = 6
    """Times that a run is scored, evenly spaced, the last one after its last step."""
    even_share: float = 1.0
    """Share of the training clouds that are first points of an object, in a data set of `--spread even`."""
    target: float = 24.0
    """PSNR in dB whose time is looked for."""
    objects: int | None = None
    """Test objects, spread over the split (default: all)."""
    only_pace: bool = False
    """Measure the pace of the steps, and stop."""

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise UserError(f"--seeds: expected one or more numbers, none of them twice, got {list(self.seeds)}")
        if not self.seconds > 0:
            raise UserError(f"--seconds: expected more than 0, got {self.seconds:g}")
        at_least(self, 1, "marks")


@dataclass(frozen=True, kw_only=True)
class Pace:
    """Seconds of a step without and with the discriminator, and where they were measured."""

    alone: float
    adversarial: float | None
    hardware: str
    load: float

    def seconds(self, config: TrainConfig, steps: int) -> float:
        """Of so many first steps of a training."""
        judged = max(0, steps - adversary.first_adversarial_step(config))
        return (steps - judged) * self.alone + judged * (self.adversarial or self.alone)


def main(options: TimeToQuality) -> None:
    """Measures paces, trains and scores what is not there yet, writes table and plot."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    asked = {"seconds": options.seconds, "marks": options.marks, "even_share": options.even_share}
    results_folder.claim(options.out, "time_to_quality", asked | {"objects": options.objects}, dataset)
    paces = {name: kept_pace(name, options, dataset) for name in options.presets}
    for name, pace in paces.items():
        print(f"{name}: {1e3 * pace.alone:.0f} ms a step, {steps_of(name, options, pace)} steps", flush=True)
    if options.only_pace:
        return
    curves: dict[str, dict[int, list[Row]]] = {name: {} for name in options.presets}
    for name in options.presets:
        for seed in options.seeds:
            place = options.out / "curves" / f"{name}_{seed}.json"
            curves[name][seed] = results_folder.kept(place, partial(curve, name, seed, options, paces[name], dataset))
    found = {"paces": {name: dataclasses.asdict(pace) for name, pace in paces.items()}, "target": options.target}
    found |= {"curves": {name: {str(seed): rows for seed, rows in runs.items()} for name, runs in curves.items()}}
    notes = [f"{name}: pace measured on {pace.hardware}, load {pace.load}." for name, pace in paces.items()]
    files = {"curves.png": plot(curves, options.target)}
    results_folder.write(options.out, found, [table(curves, options.target)], notes, files)


def kept_pace(preset: str, options: TimeToQuality, dataset: data_sets.Dataset) -> Pace:
    """The pace of a preset's steps, measured if it is not there."""

    def measure() -> dict[str, Any]:
        config, load = config_of(preset, options, 1000), machine.load()
        seconds = {flag: budget.step_seconds(config, dataset, flag) for flag in sorted({False, judged(config)})}
        pace = Pace(alone=seconds[False], adversarial=seconds.get(True), hardware=machine.hardware(), load=load)
        return dataclasses.asdict(pace)

    return Pace(**results_folder.kept(options.out / "paces" / f"{preset}.json", measure))


def judged(config: TrainConfig) -> bool:
    """Whether some steps of the training have a discriminator."""
    return adversary.first_adversarial_step(config) < config.num_steps


def config_of(preset: str, options: TimeToQuality, steps: int, seed: int = 0) -> TrainConfig:
    """The preset with so many steps, on clouds as the test objects have them."""
    return dataclasses.replace(PRESETS[preset](), num_steps=steps, seed=seed, even_share=options.even_share)


def steps_of(preset: str, options: TimeToQuality, pace: Pace) -> int:
    """The most steps that fit into the seconds, at least one a mark."""
    longer = range(options.marks + 1, options.marks + int(options.seconds / pace.alone) + 2)
    return options.marks + bisect_right(
        longer, options.seconds, key=lambda steps: pace.seconds(config_of(preset, options, steps), steps)
    )


def curve(preset: str, seed: int, options: TimeToQuality, pace: Pace, dataset: data_sets.Dataset) -> list[Row]:
    """The scores of one run at each mark."""
    config = config_of(preset, options, steps_of(preset, options, pace), seed)
    names = test_objects(dataset, options.objects)
    marks = {round(config.num_steps * (i + 1) / options.marks) for i in range(options.marks)}
    state, rows = optimisation.jitted_create_state(config), []
    first_judged, start = adversary.first_adversarial_step(config), time.monotonic()
    with closing(batching.batches(dataset, config, 0)) as batches:
        for step, batch in enumerate(batches):
            state, metrics = optimisation.jitted_train_step(
                state, jax.device_put(batch), config=config, adversarial=step >= first_judged
            )
            if step + 1 in marks:
                jax.block_until_ready(metrics)
                scores = score(optimisation.averaged_variables(state), config, dataset, names)
                rows.append({"step": step + 1, "seconds": round(pace.seconds(config, step + 1), 2), **scores})
                spent = time.monotonic() - start
                print(f"{preset}, seed {seed}: {rows[-1]} ({spent:.0f} s of this machine)", flush=True)
    return rows


def score(variables: dict, config: TrainConfig, dataset: data_sets.Dataset, names: Sequence[str]) -> Row:
    """Means over the objects of the means over their views."""
    methods = {"network": evaluation.network(variables, config)}
    results = evaluation.evaluate_objects(methods, config, dataset, tuple(names))
    scores = [result.scores["network"] for result in results]
    return {metric: float(np.mean([one[metric].mean() for one in scores])) for metric in ("psnr", "flip", "iou")}


def reached(rows: Sequence[Row], target: float) -> float | None:
    """Seconds at which a curve crosses the target, on a line between its rows; None if it never does."""
    for before, after in zip([{"seconds": 0.0, "psnr": -np.inf}, *rows], rows, strict=False):
        if after["psnr"] >= target:
            if not np.isfinite(before["psnr"]):
                return after["seconds"]
            share = (target - before["psnr"]) / (after["psnr"] - before["psnr"])
            return before["seconds"] + share * (after["seconds"] - before["seconds"])
    return None


def table(curves: Mapping[str, Mapping[int, Sequence[Row]]], target: float) -> Table:
    """A line for each run: its steps, its last scores, and when it reached the target."""
    rows = []
    for name, runs in curves.items():
        for seed, marks in runs.items():
            last = marks[-1]
            cells = [number(last["step"], 0), number(last["seconds"], 0)]
            cells += [number(last["psnr"], 2), number(last["flip"], 3), number(last["iou"], 3)]
            rows.append((f"{name}, seed {seed}", (*cells, number(reached(marks, target), 0, missing="not reached"))))
    heads = ("steps", "seconds", "PSNR, dB", "FLIP", "opacity IoU", f"{target:g} dB after, s")
    return Table(title="Unseen objects after a training of so many seconds", heads=heads, rows=tuple(rows))


@figures.drawing
def plot(curves: Mapping[str, Mapping[int, Sequence[Row]]], target: float) -> Figure:
    """PSNR over minutes: a colour for each preset, a line for each seed."""
    figure = Figure(figsize=(6.4, 3.6))
    axes = figure.subplots()
    for (name, runs), color in zip(curves.items(), figures.COLORS, strict=False):
        for number_of, rows in enumerate(runs.values()):
            minutes, psnr = ([row["seconds"] / 60 for row in rows], [row["psnr"] for row in rows])
            axes.plot(minutes, psnr, "o-", color=color, markersize=3.5, label=None if number_of else name)
    axes.axhline(target, color=figures.INK_COLOR, linestyle="--", linewidth=1, label=f"{target:g} dB")
    axes.set_xlim(left=0)
    axes.set_xlabel("minutes of training steps")
    axes.set_ylabel("PSNR of unseen objects, dB")
    axes.legend()
    return figure


if __name__ == "__main__":
    entry_point.run(main, TimeToQuality, "studies.time_to_quality")
