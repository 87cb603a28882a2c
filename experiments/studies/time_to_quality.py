"""How good a network is after so many seconds of the processor: scores of unseen objects over the time of training.

    python -m experiments.studies.time_to_quality --data DIR --out DIR [--presets ...] [--seconds 90] [--only-pace]

The pace of each preset's steps is measured first and kept: `--only-pace` stops there.  Every run then trains for the
steps that fit into the seconds at that pace, its warm-up and decay over exactly these, and its averaged network is
scored a few times on the way, the last time on all test objects.  Seconds are those of the processor, all threads
together, that the steps took: neither compilation nor scoring nor other work on the machine is in them.  A stopped
study goes on from the last checkpoint; several may share a folder, if each trains its own presets.

    OUT/paces/PRESET.json           processor seconds of a step, without and with the discriminator
    OUT/runs/PRESET_SEED/           the run folder
    OUT/marks/PRESET_SEED/STEP.json scores of each object, and seconds; STEP.npz pictures of a few objects
    OUT/results.json  table.md  curves_GROUP.png  sheet.png
"""

import dataclasses
import itertools
import json
import time
from bisect import bisect_right
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import entry_point
from experiments.comparison import budget, results_folder
from experiments.comparison.object_scores import color_scores, of_cloud, score_objects
from experiments.comparison.trained_networks import test_objects
from experiments.studies import time_to_quality_report as report
from experiments.studies.time_to_quality_report import Marks
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import machine
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import to_uint8
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.summary import Scores
from spnr_jax.training import adversary, optimisation, run_record, trainer
from spnr_jax.training.weights import read_trained


@dataclass(frozen=True, kw_only=True)
class TimeToQuality:
    """Train presets for so many seconds of the processor, and score them on unseen objects on the way."""

    data: Path
    """Folder of the data set; its test split is scored."""
    out: Path = Path("runs/time_to_quality")
    """Folder of the results; the same command goes on there."""
    presets: tuple[str, ...] = ("tiny", "plus_tiny")
    """Networks and losses: names of `spnr train --preset`."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of weights, batches and jitter."""
    seconds: float = 180.0
    """Of the processor in training steps, for each run."""
    marks: int = 6
    """Times that a run is scored, evenly spaced, the last one after its last step."""
    even_share: float = 1.0
    """Share of the training clouds that are first points of an object, in a data set of `--spread even`."""
    target: float = 24.0
    """PSNR in dB whose time is looked for."""
    objects: int | None = None
    """Test objects scored on the way, spread over the split; after the last step all are (default: all)."""
    shown: int = 8
    """Of these, objects whose pictures are kept."""
    init: Path | None = None
    """Run folder or file of weights that trainings go on from, with a fresh optimiser (default: random weights)."""
    only_pace: bool = False
    """Measure the pace of the steps, and stop."""

    def __post_init__(self) -> None:
        if unknown := [name for name in self.presets if name not in PRESETS]:
            raise UserError(f"--presets: there is no {unknown[0]}; the presets are {', '.join(PRESETS)}")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise UserError(f"--seeds: expected one or more numbers, none of them twice, got {list(self.seeds)}")
        if not self.seconds > 0:
            raise UserError(f"--seconds: expected more than 0, got {self.seconds:g}")
        at_least(self, 1, "marks", "shown")


@dataclass(frozen=True, kw_only=True)
class Pace:
    """Processor seconds of a step without and with the discriminator, and where they were measured."""

    alone: float
    adversarial: float | None
    hardware: str
    load: float

    def seconds(self, config: TrainConfig, steps: int) -> float:
        """Of so many first steps of a training."""
        judged = max(0, steps - adversary.first_adversarial_step(config))
        return (steps - judged) * self.alone + judged * (self.adversarial or self.alone)


def main(options: TimeToQuality) -> None:
    """Measures paces, trains and scores what is not there yet, writes table and plots."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    asked = {name: getattr(options, name) for name in ("seconds", "marks", "even_share", "objects", "shown")}
    before = {} if options.init is None else {"init": str(options.init)}
    results_folder.claim(options.out, "time_to_quality", asked | before, dataset)
    paces = {name: kept_pace(name, options, dataset) for name in options.presets}
    for name, pace in paces.items():
        print(f"{name}: {1e3 * pace.alone:.0f} ms a step, {steps_of(name, options, pace)} steps", flush=True)
    if options.only_pace:
        return
    curves: dict[str, dict[int, list[Marks]]] = {name: {} for name in options.presets}
    for name, seed in itertools.product(options.presets, options.seeds):
        curves[name][seed] = curve(name, seed, options, paces[name], dataset)
    notes = [f"{name}: pace measured on {pace.hardware}, load {pace.load}." for name, pace in paces.items()]
    found = {"paces": {name: dataclasses.asdict(pace) for name, pace in paces.items()}, "target": options.target}
    found |= {"curves": {name: {str(seed): rows for seed, rows in runs.items()} for name, runs in curves.items()}}
    folders = {name: options.out / "marks" / f"{name}_{options.seeds[0]}" for name in options.presets}
    files = report.pictures(curves, options.target) | report.sheets(curves, folders)
    results_folder.write(options.out, found, report.tables(curves, options.target), notes, files)


def kept_pace(preset: str, options: TimeToQuality, dataset: data_sets.Dataset) -> Pace:
    """The pace of a preset's steps, measured if it is not there."""

    def measure() -> dict[str, Any]:
        config, load = config_of(preset, options, 1000), machine.load()
        judged = adversary.first_adversarial_step(config) < config.num_steps
        seconds = {flag: budget.step_seconds(config, dataset, flag, time.process_time) for flag in {False, judged}}
        pace = Pace(alone=seconds[False], adversarial=seconds.get(True), hardware=machine.hardware(), load=load)
        return dataclasses.asdict(pace)

    return Pace(**results_folder.kept(options.out / "paces" / f"{preset}.json", measure))


def config_of(preset: str, options: TimeToQuality, steps: int, seed: int = 0) -> TrainConfig:
    """The preset with so many steps, on clouds as the test objects have them."""
    return dataclasses.replace(PRESETS[preset](), num_steps=steps, seed=seed, even_share=options.even_share)


def steps_of(preset: str, options: TimeToQuality, pace: Pace) -> int:
    """The most steps that fit into the seconds, at least one a mark."""
    longer = range(options.marks + 1, options.marks + int(options.seconds / pace.alone) + 2)
    return options.marks + bisect_right(
        longer, options.seconds, key=lambda steps: pace.seconds(config_of(preset, options, steps), steps)
    )


def curve(preset: str, seed: int, options: TimeToQuality, pace: Pace, dataset: data_sets.Dataset) -> list[Marks]:
    """The scores of one run at each mark; it is trained as far as it is not."""
    config = config_of(preset, options, steps_of(preset, options, pace), seed)
    run, folder = (options.out / part / f"{preset}_{seed}" for part in ("runs", "marks"))
    every = -(-config.num_steps // options.marks)
    marks = [min(every * (i + 1), config.num_steps) for i in range(options.marks)]

    def saved(phase: str, step: int, state: Any) -> None:
        place = folder / f"{step:07d}.json"
        if phase == "saved" and step in marks and not place.is_file():
            row = results_folder.kept(place, partial(mark, state, config, options, dataset, run, place))
            print(f"{preset}, seed {seed}: {report.line(row)}", flush=True)

    schedule = trainer.Schedule(preview_every=every, checkpoint_every=every)
    init = None if options.init is None else read_trained(options.init)
    state = trainer.train(config, dataset, run, schedule, init=init, on_event=saved)
    saved("saved", config.num_steps, state)  # if an earlier call was stopped between the last step and its scores
    jax.clear_caches()
    return [json.loads(place.read_text()) for place in sorted(folder.glob("*.json"))]


def mark(
    state: optimisation.TrainState,
    config: TrainConfig,
    options: TimeToQuality,
    dataset: data_sets.Dataset,
    run: Path,
    place: Path,
) -> Marks:
    """Scores of the averaged network, and what its training took so far; its pictures are kept beside."""
    step, method = int(state.step), config.model.method
    shown = test_objects(dataset, options.objects)
    names = test_objects(dataset, None) if step == config.num_steps else shown
    to_show, strips = evaluation.spread(shown, options.shown), list[np.ndarray]()

    def more(item: data_sets.ObjectData, pictures: evaluation.Pictures) -> Scores:
        reference, image = data_sets.on_white(item.images), np.asarray(pictures.image)
        if item.name in to_show:
            strips.extend(to_uint8(picture[0]) for picture in (reference, image))
        return color_scores(item, reference, image)

    network = of_cloud(evaluation.network(optimisation.averaged_variables(state), config), config)
    scored = score_objects({method: network}, config, dataset, names, 0, None, more)
    scores = {
        name: {metric: of[method][metric].tolist() for metric in report.METRICS if metric in of[method]}
        for name, of in scored.scores.items()
    }
    results_folder.kept(place.with_suffix(".npz"), lambda: strips)
    return {"step": step, "seconds": training_seconds(run), "shown": list(to_show), "scores": scores}


def training_seconds(run: Path) -> float:
    """Processor seconds of a run's steps over all calls: not compilation, previews, saving and scoring."""
    return round(sum(start["processor_seconds"].get("steps", 0.0) for start in run_record.read_starts(run)), 2)


if __name__ == "__main__":
    entry_point.run(main, TimeToQuality, "studies.time_to_quality")
