"""A long training watched from within: memory and pace stay what they are, and nothing is compiled again.

    python -m experiments.long_run [--steps 2000] [--data DIR] [--out runs/long_run]

The trainer trains `tiny` as `spnr train` does.  A witness wraps five of its functions, changes nothing that they do,
and notes at every row of metrics.jsonl, and when a preview's memory was given back, what the process holds; JAX says
what it compiles.

A stretch is a part of the run in which one program makes every step: without the discriminator, then with it.  It
counts from step 100 on (of 2000), and not before an epoch is over: from then on every object is in memory.

    memory        what is resident after a preview, its memory given back, grows by less than 1 % over a stretch, by its
                  line and by its ends; between two steps it varies by 3 %, with what the allocator keeps
    pace          the line through the milliseconds of a step rises by less than 5 % over a stretch
    handles       threads and open files become fewer than ten more over a stretch
    compilations  each kind of work (a step, a preview, a checkpoint) compiles when it is done for the first time, and
                  never again

    OUT/data  OUT/run  long_run.json  long_run.png
"""

import dataclasses
import itertools
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np
import tyro

from data_gen.make.generate import generate
from data_gen.plan.tasks import GenerateConfig
from experiments.long_run_report import plot, table
from spnr_jax import cli, presets
from spnr_jax.config import TrainConfig
from spnr_jax.devices import allocator, machine
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.training import checkpoint, optimisation, trainer

COMPILED = "/jax/core/compile/backend_compile_duration"  # JAX's name of the event
MOST_MEMORY, MOST_TIME, MOST_HANDLES = 0.01, 0.05, 10  # growth over a stretch: shares, and a number
FEWEST = 8  # rows of either kind in a stretch that is judged


@dataclass(frozen=True, kw_only=True)
class LongRun:
    """Train for long, and say whether memory, compilations and pace stay what they are."""

    steps: int = 2000
    """Training steps."""
    data: Path | None = None
    """Folder of a data set of 64 px (default: OUT/data, generated)."""
    out: Path = Path("runs/long_run")
    """Folder of the run and the results."""
    objects: int = 48
    """Procedural objects to generate."""
    adversarial_start: float | None = None
    """Share of the steps without the discriminator (default: the preset's); 0 makes the run one stretch."""
    seed: int = 0
    """Seed of data and training."""

    def __post_init__(self) -> None:
        if self.steps < 20:
            raise ValueError(f"--steps: expected 20 or more, got {self.steps}")


class Witness:
    """What a training does to its process: samples at every row, and compilations with their causes."""

    def __init__(self) -> None:
        """Nothing seen yet."""
        self.samples: list[dict[str, Any]] = []
        self.compilations: list[dict[str, Any]] = []
        self._calls: Counter[str] = Counter()
        self._causes = ["loop"]
        self._previewed: int | None = None  # the step of a preview whose memory is not given back yet

    @contextmanager
    def watching(self) -> Iterator[None]:
        """While it lasts the trainer is watched."""

        def compiled(event: str, duration_secs: float, **names: str | int) -> None:
            if event == COMPILED:
                self.note(str(names.get("fun_name")), duration_secs)

        with ExitStack() as stack:
            for cause, owner, name in (
                ("step", optimisation, "jitted_train_step"),
                ("preview", trainer, "preview"),
                ("checkpoint", checkpoint, "save"),
                ("row", trainer.MetricsLog, "write"),
                ("memory", allocator, "give_back"),
            ):
                stack.enter_context(mock.patch.object(owner, name, self.watched(cause, getattr(owner, name))))
            jax.monitoring.register_event_duration_secs_listener(compiled)
            stack.callback(jax.monitoring.unregister_event_duration_listener, compiled)
            yield

    def watched(self, cause: str, work: Callable) -> Callable:
        """The same work, which is named as the cause of what is compiled meanwhile."""

        def call(*arguments: Any, **options: Any) -> Any:
            self._causes.append(f"{cause} with discriminator" if options.get("adversarial") else cause)
            self._calls[self._causes[-1]] += 1
            try:
                result = work(*arguments, **options)
            finally:
                self._causes.pop()
            if cause == "row" and "ms_per_step" not in (row := arguments[1]):
                self._previewed = row["step"]
            elif cause == "row":
                self.samples.append({"step": row["step"], **holdings(), "ms_per_step": row["ms_per_step"]})
            elif cause == "memory" and self._previewed is not None:
                self.samples.append({"step": self._previewed, **holdings(), "ms_per_step": None})
                self._previewed = None
            return result

        return call

    def note(self, function: str, seconds: float) -> None:
        """Counts one compilation."""
        cause = self._causes[-1]
        self.compilations.append(
            {
                "cause": cause,
                "call": self._calls[cause],
                "step": sum(count for name, count in self._calls.items() if name.startswith("step")),
                "function": function,
                "seconds": round(seconds, 3),
            }
        )


def holdings() -> dict[str, float]:
    """Megabytes of resident memory, threads and open files of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines)
    return {
        "memory": int(status["VmRSS"].split()[0]) / 1024,
        "threads": int(status["Threads"]),
        "files": len(os.listdir("/proc/self/fd")),
    }


def main(options: LongRun) -> list[str]:
    """Trains; the laws that were broken."""
    cli.set_up_jax()
    run = options.out / "run"
    if run.exists():
        raise ValueError(f"{run}: holds a run, and one is measured from its first step on; choose another --out")
    if not Path("/proc/self/status").is_file():
        raise ValueError("memory is read from /proc/self/status, which only Linux has")
    dataset = data_sets.open_dataset(options.data or generated(options))
    config = configured(options)
    witness, begin = Witness(), time.monotonic()
    try:
        with witness.watching():
            trainer.train(config, dataset, run, schedule(options.steps))
    finally:  # what was seen of a run that is stopped is not lost
        epoch = -(-len(dataset.splits["train"]) // config.batch_objects)
        parts = stretches(config, max(options.steps // 20, epoch))
        broken = written(options, parts, witness, time.monotonic() - begin) if witness.samples else []
    return broken


def written(options: LongRun, parts: list[tuple[int, int]], witness: Witness, seconds: float) -> list[str]:
    """The laws that were broken; results, table and picture are written."""
    judged = laws(witness, parts)
    results = {
        "steps": options.steps,
        "last step": witness.samples[-1]["step"],
        "hardware": machine.hardware(),
        "date": time.strftime("%Y-%m-%d"),
        "seconds": round(seconds, 1),
        "stretches": parts,
        "laws": judged,
        "compilations": witness.compilations,
        "samples": witness.samples,
    }
    write_whole(options.out / "long_run.json", (json.dumps(results, indent=1) + "\n").encode())
    write_whole(options.out / "long_run.png", plot(results))
    print(table(results))
    return [law["name"] for law in judged if not law["held"]]


def generated(options: LongRun) -> Path:
    """The folder of a data set as the demo makes it, of fewer objects and samples."""
    folder = options.out / "data"
    generate(GenerateConfig(out=folder, objects=options.objects, spp=16, visibility_grid=2, seed=options.seed))
    return folder


def configured(options: LongRun) -> TrainConfig:
    """`tiny` with the steps that were asked for."""
    config = dataclasses.replace(presets.tiny(), num_steps=options.steps, seed=options.seed)
    if options.adversarial_start is None:
        return config
    return dataclasses.replace(
        config, loss=dataclasses.replace(config.loss, adversarial_start=options.adversarial_start)
    )


def schedule(steps: int) -> trainer.Schedule:
    """200 rows, 80 previews, 25 checkpoints: each kind of work is done for the first time before the run counts.

    A checkpoint leaves 0.4 MB behind, of which Orbax's descriptions of files are 0.1 (measured over 30).
    """
    return trainer.Schedule(
        log_every=max(steps // 200, 1), preview_every=max(steps // 80, 10), checkpoint_every=max(steps // 25, 10)
    )


def stretches(config: TrainConfig, settled: int) -> list[tuple[int, int]]:
    """First and last step of each part of the run that one program makes, without the steps until it has settled."""
    bounds = sorted({0, optimisation.first_adversarial_step(config), config.num_steps})
    return [(first + settled, last) for first, last in itertools.pairwise(bounds)]


def laws(witness: Witness, parts: Sequence[tuple[int, int]]) -> list[dict[str, Any]]:
    """Each law with what was found and whether it held; a stretch of too few rows is not judged."""
    found = []
    for first, last in parts:
        inside = [row for row in witness.samples if first <= row["step"] <= last]
        timed = columns([row for row in inside if row["ms_per_step"] is not None])
        quiet = columns([row for row in inside if row["ms_per_step"] is None])
        if min(len(timed["step"]), len(quiet["step"])) < FEWEST:
            continue
        more = {name: median_rise(quiet[name]) for name in ("memory", "threads", "files")}
        resident = max(drift(quiet["step"], quiet["memory"]), more.pop("memory") / np.median(quiet["memory"]))
        pace = drift(timed["step"], timed["ms_per_step"])
        texts = {
            "memory": f"{resident:+.2%} of {np.median(quiet['memory']):.0f} MB",
            "pace": f"{pace:+.2%} of {np.median(timed['ms_per_step']):.0f} ms a step",
            "handles": ", ".join(f"{more[name]:+.0f} of {quiet[name][0]:.0f} {name}" for name in more),
        }
        kept = {
            "memory": resident < MOST_MEMORY,
            "pace": pace < MOST_TIME,
            "handles": max(more.values()) < MOST_HANDLES,
        }
        found += [law(name, kept[name], f"steps {first} to {last}: {texts[name]}") for name in texts]
    return [*found, compiled_once(witness.compilations)]


def compiled_once(compilations: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The law of compilations: after the first step only a kind of work that is done for the first time compiles."""
    later = [one for one in compilations if one["step"] > 1]
    again = [one for one in later if one["call"] != 1]
    causes = Counter(one["cause"] for one in later)
    firsts = ", ".join(f"{count} at the first {cause}" for cause, count in causes.items())
    repeated = ", ".join(f"{one['function']} at step {one['step']} ({one['cause']})" for one in again[:4])
    return law("compilations", not again, f"again: {repeated}" if again else f"after step 1: {firsts or 'none'}")


def columns(rows: Sequence[dict[str, float]]) -> dict[str, np.ndarray]:
    """The rows' entries as arrays by their names."""
    return {name: np.array([row[name] for row in rows], float) for name in ("step", *holdings(), "ms_per_step")}


def law(name: str, held: bool | np.bool_, found: str) -> dict[str, Any]:
    """A law's entry."""
    return {"name": name, "held": bool(held), "found": found}


def median_rise(values: np.ndarray) -> float:
    """By how much the median of the last three values exceeds that of the first three."""
    return float(np.median(values[-3:]) - np.median(values[:3]))


def drift(steps: np.ndarray, values: np.ndarray) -> float:
    """Rise of the line through the values from the first to the last step, as a share of their median.

    Its slope is the median of the slopes of all pairs (Theil and Sen), which single rows do not move.
    """
    i, j = np.triu_indices(len(steps), 1)
    slope = np.median((values[j] - values[i]) / (steps[j] - steps[i]))
    return float(slope * (steps[-1] - steps[0]) / np.median(values))


if __name__ == "__main__":
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    broken: list[str] = []
    asked = partial(tyro.cli, LongRun, prog="python -m experiments.long_run")
    code = cli.guarded(lambda: broken.extend(main(asked())), "long_run")
    sys.exit(code or int(bool(broken)))
