"""Nothing is lost: a training that is killed a hundred times, and every other fault that a disk or a person can make.

    python -m experiments.chaos --out DIR [--kills 100] [--seed 0]

A very small network trains with the real command in processes of their own (experiments/chaos_child.py).  One training
is killed with SIGKILL at random moments, in steps, while checkpoints and log lines are written and while it starts
(experiments/chaos_kills.py), and has to end with the bits of one that was left alone.  Then come the faults of
experiments/chaos_faults.py, each on a copy of a run.

    OUT/data                       the data set, if --data names none
    OUT/whole  killed              both trainings; the kills, once done, are only read
    OUT/results.json  kills.csv    every kill, every fault
    OUT/chaos.md  chaos.png        the tables; where in the training each kill fell
"""

import dataclasses
import json
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro

from experiments import chaos_faults, chaos_kills, chaos_report
from experiments.chaos_kills import Kill, Training
from spnr_jax import cli
from spnr_jax.devices.machine import hardware
from spnr_jax.formats.images import write_whole


@dataclass(frozen=True, kw_only=True)
class Chaos:
    """Kill a training at random moments and let disks fill, and see that nothing is lost."""

    out: Path
    """Folder of the results."""
    kills: int = 100
    """Kills of one training."""
    seed: int = 0
    """Seed of the moments."""
    data: Path | None = None
    """Data set of 24 x 24 pixels with 2 objects or more (default: a generated one)."""
    faults: bool = True
    """Also the other faults, one minute or two."""

    def __post_init__(self) -> None:
        if self.kills < 1:
            raise ValueError(f"--kills: expected 1 or more, got {self.kills}")


def main(options: Chaos) -> None:
    """Does both, says how far it is, writes the results; ValueError if something was lost."""
    options.out.mkdir(parents=True, exist_ok=True)
    training = Training(
        data=options.data or generated(options.out / "data"),
        num_steps=max(chaos_kills.FEWEST_STEPS, chaos_kills.STEPS_A_KILL * options.kills),
        cache=(options.out / "compiled").absolute(),
    )
    results = {
        "hardware": hardware(),
        "steps": training.num_steps,
        "checkpoint_every": training.checkpoint_every,
        "log_every": chaos_kills.LOG_EVERY,
        "faults": [],
    } | kept_kills(options, training)
    if options.faults:
        for fault in chaos_faults.survived(training, options.out / "faults", options.out / "whole"):
            print(f"{fault.name}: {fault.verdict}, {fault.seconds:.0f} s: {fault.line}", flush=True)
            results["faults"].append(dataclasses.asdict(fault))
    chaos_report.write(options.out, results)
    line, whole = chaos_report.verdict(results)
    print(line)
    if not whole:
        raise ValueError(f"something was lost; {options.out / 'chaos.md'} says what")


def generated(folder: Path) -> Path:
    """The folder with a data set of a few small objects."""
    if not (folder / "dataset.json").is_file():
        print("generating a data set of 8 objects, about 10 s", flush=True)
        options = "--objects 8 --resolution 24 --views 3 --spp 1 --points 64"
        command = [sys.executable, "-m", "data_gen", "generate", str(folder), *options.split()]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return folder


def kept_kills(options: Chaos, training: Training) -> dict:
    """Every kill and what is the same in both trainings, from disk if they were made before."""
    place = options.out / "kills.json"
    asked = {"kills asked": options.kills, "seed": options.seed}
    if place.is_file() and (found := json.loads(place.read_text())).items() >= asked.items():
        return found
    whole, killed = options.out / "whole", options.out / "killed"
    shutil.rmtree(whole, ignore_errors=True)
    print(f"training {training.num_steps} steps without a fault", flush=True)
    reference = training.run(whole)
    if reference.code:
        raise ValueError(f"{whole}: the training without faults ended with code {reference.code}: {reference.said}")
    begin, kills, trials = time.monotonic(), [], []
    for kill, ended in chaos_kills.killed(training, killed, options.kills, options.seed, reference):
        kills.append(kill)
        trials.append(ended)
        print(f"{describe(kill, options.kills)}; {chaos_kills.progress(begin, kill.number, options.kills)}", flush=True)
    trials.append(training.run(killed))
    found = asked | {
        "kills": [dataclasses.asdict(kill) for kill in kills],
        "same": chaos_kills.compare(killed, whole, trials, reference),
        "ended": trials[-1].code,
        "last begun": chaos_kills.first_step(trials[-1]),
        "seconds": round(time.monotonic() - begin, 1),
    }
    write_whole(place, (json.dumps(found, indent=1) + "\n").encode())
    return found


def describe(kill: Kill, count: int) -> str:
    """One line about a kill."""
    return f"kill {kill.number} of {count}: {kill.phase}, step {kill.step} (from {kill.begun}), {kill.seconds:.1f} s"


if __name__ == "__main__":
    run = partial(tyro.cli, Chaos, prog="python -m experiments.chaos")
    sys.exit(cli.guarded(lambda: main(run()), "chaos"))
