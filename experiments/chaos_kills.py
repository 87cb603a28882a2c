"""A training that is killed again and again beside one that is not: nothing may be lost, doubled or changed.

The moments are planned: their steps spread evenly at random over the training, and each aims at a phase, at a random
moment of it.  Where a kill fell is what the process said last, not what was aimed at; the next one aims at the phase
that has the fewest of its share.
"""

import dataclasses
import shutil
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments import chaos_child
from experiments.chaos_child import Aim, Ended, Event, Phase
from spnr_jax.training import checkpoint, trainer

STEPS_A_KILL, FEWEST_STEPS = 4, 40
CHECKPOINT_EVERY, LOG_EVERY = 8, 2
SHARES: dict[Phase, float] = {"step": 0.35, "checkpoint": 0.35, "log": 0.2, "start": 0.1}
NETWORK = (  # few weights; the discriminator takes part from the first step, so that its state counts too
    "--point-widths 8 --point-features 4 --volume-resolution 8 --base-width 4 --num-stages 1 --num-groups 2"
    " --field-width 8 --num-features 5 --direction-frequencies 1 --num-coarse 4 --num-fine 4 --render-resolution 24"
    " --image-resolution 24 --discriminator-width 8 --adversarial-start 0 --r1-gamma 0 --lr-generator 1e-2"
    " --warmup-steps 2 --batch-objects 2 --min-points 8 --max-points 32 --test-points 24"
)


@dataclass(frozen=True, kw_only=True)
class Training:
    """The command that is killed: data set, steps, and where its compiled programs stay."""

    data: Path
    num_steps: int
    cache: Path
    checkpoint_every: int = CHECKPOINT_EVERY

    def arguments(self, run: Path) -> list[str]:
        """What follows `spnr`."""
        schedule = f"--log-every {LOG_EVERY} --checkpoint-every {self.checkpoint_every} --preview-every 1000000"
        return ["train", str(self.data), str(run), *f"{NETWORK} --num-steps {self.num_steps} {schedule}".split()]

    def run(self, run: Path, **options) -> Ended:
        """The command in a process of its own (`chaos_child.run`); what it says stands in RUN.txt."""
        return chaos_child.run(self.arguments(run), self.cache, run.with_name(f"{run.name}.txt"), **options)


@dataclass(frozen=True, kw_only=True)
class Kill:
    """Where a kill fell: phase and steps done, the step that it had begun from, and what lay in the run folder.

    `unfinished` is whether a checkpoint was half written; `doomed_rows` were logged after the newest checkpoint.
    """

    number: int
    aimed: Phase
    phase: Phase
    begun: int
    step: int
    unfinished: bool
    doomed_rows: int
    seconds: float


def killed(training: Training, run: Path, count: int, seed: int, whole: Ended) -> Iterator[tuple[Kill, Ended]]:
    """Kills the training `count` times at random moments; the next call of the command ends it."""
    shutil.rmtree(run, ignore_errors=True)
    rng = np.random.default_rng(seed)
    moments = np.sort(rng.uniform(0, training.num_steps - training.checkpoint_every, count))
    usual = durations(whole.events)
    hits = dict.fromkeys(chaos_child.PHASES, 0)
    for number, moment in enumerate(moments, start=1):
        aimed = max(SHARES, key=lambda phase: SHARES[phase] * number - hits[phase])
        ended = training.run(run, aim=aim_at(aimed, moment, rng.uniform(0, usual[aimed])))
        if ended.code != -9:
            raise ValueError(f"{run}: kill {number} came too late: {ended.said}; choose fewer --kills")
        kill = post_mortem(run, number, aimed, ended)
        hits[kill.phase] += 1
        if kill.phase != "start":  # without the compilation, which the first training waited for
            usual["start"] = min(usual["start"], durations(ended.events)["start"])
        yield kill, ended


def aim_at(phase: Phase, moment: float, delay: float) -> Aim:
    """Aims so long after a phase begins that so many steps were done before; the start begins with the process."""
    return lambda event: delay if event.phase == phase and (phase == "start" or event.step >= moment) else None


def durations(events: list[Event]) -> dict[Phase, float]:
    """Seconds of each phase of a training: the median, since the first time of each may have compiled something."""
    found: dict[Phase, list[float]] = {phase: [] for phase in chaos_child.PHASES}
    for event, after in zip(events, events[1:], strict=False):
        found[event.phase].append(after.seconds - event.seconds)
    return {phase: statistics.median(seconds) for phase, seconds in found.items() if seconds}


def post_mortem(run: Path, number: int, aimed: Phase, ended: Ended) -> Kill:
    """What the process said last, and what it left."""
    folder = run / "checkpoints"
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    newest = max((int(name) for name in names if name.isdigit()), default=0)
    last = ended.events[-1] if ended.events else Event(0.0, "start", 0)
    return Kill(
        number=number,
        aimed=aimed,
        phase=last.phase,
        begun=newest if (first := first_step(ended)) is None else first,
        step=last.step or newest,
        unfinished=any(not name.isdigit() for name in names),
        doomed_rows=sum(row["step"] > newest for row in trainer.read_rows(run)),
        seconds=round(ended.seconds, 2),
    )


def first_step(ended: Ended) -> int | None:
    """The step that a training went on from, None if it made none."""
    return next((event.step - 1 for event in ended.events if event.batch is not None), None)


def compare(run: Path, whole: Path, trials: list[Ended], reference: Ended) -> dict[str, bool]:
    """What is the same, bit by bit, in a training that was killed and in one that was not."""
    (config, state), (expected_config, expected) = checkpoint.load_run(run), checkpoint.load_run(whole)
    seen: dict[int, set[str]] = {}
    for event in (event for trial in trials for event in trial.events if event.batch):
        seen.setdefault(event.step, set()).add(event.batch or "")
    order = {event.step: {event.batch} for event in reference.events if event.batch}
    fields = {f.name for f in dataclasses.fields(state)}
    optimisers = {name for name in fields if name.endswith("_optimizer")}
    return {
        "config": config == expected_config,
        "parameters and statistics": same(state, expected, fields - optimisers),
        "optimiser state": same(state, expected, optimisers),
        "data of every step": seen == order,
        "metrics file, row by row": rows(run) == rows(whole),
    }


def same(state, expected, names: set[str]) -> bool:
    """Whether these parts of two states of one config have the same bits."""
    return all(
        chaos_child.checksum(getattr(state, name)) == chaos_child.checksum(getattr(expected, name)) for name in names
    )


def rows(run: Path) -> list[dict]:
    """The metrics file without the time that a step took, the one entry that a clock decides."""
    return [{k: v for k, v in row.items() if k != "ms_per_step"} for row in trainer.read_rows(run)]


def progress(begin: float, done: int, count: int) -> str:
    """How fast and how long still."""
    pace = (time.monotonic() - begin) / done
    return f"{pace:.1f} s each, {pace * (count - done) / 60:.1f} min left"
