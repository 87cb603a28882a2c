"""A training in a process of its own, which says what it is doing and can be killed at any moment of it.

A fork server, which has imported everything and touched no device, starts each process in milliseconds.
"""

import dataclasses
import hashlib
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from spnr_jax.training import checkpoint, trainer

LIMIT = 300.0  # seconds without an event after which a process hangs
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["spnr_jax.training.trainer", "spnr_jax.cli", "orbax.checkpoint.v1", "tensorboardX"])
QUICK_COMPILATION = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
CHECKPOINT_EVERY = 8
OPTIONS = (  # few weights; the discriminator takes part from the first step, so that its state counts too
    "--point-widths 8 --point-features 4 --volume-resolution 8 --base-width 4 --num-stages 1 --num-groups 2"
    " --field-width 8 --num-features 5 --direction-frequencies 1 --num-coarse 4 --num-fine 4 --render-resolution 24"
    " --image-resolution 24 --discriminator-width 8 --adversarial-start 0 --r1-gamma 0 --lr-generator 1e-2"
    " --warmup-steps 2 --batch-objects 2 --min-points 8 --max-points 32 --test-points 24"
    f" --log-every 2 --checkpoint-every {CHECKPOINT_EVERY} --preview-every 1000000"
)


class Event(NamedTuple):
    """Seconds on the machine's clock, the phase that begins, steps done so far, and of a step its batch's checksum."""

    seconds: float
    phase: str
    step: int
    batch: str | None = None


@dataclass(frozen=True, kw_only=True)
class Ended:
    """A process that is over: its events, exit code (minus the signal that ended it), output."""

    events: list[Event]
    code: int
    output: str


@dataclass(frozen=True, kw_only=True)
class Training:
    """The command `spnr train`: data set, steps, and where its compiled programs stay."""

    data: Path
    num_steps: int
    cache: Path

    def arguments(self, run: Path) -> list[str]:
        """What follows `spnr`."""
        return ["train", str(self.data), str(run), *OPTIONS.split(), "--num-steps", str(self.num_steps)]

    def run(self, run: Path, aim: Callable[[Event], float | None] = lambda event: None) -> Ended:
        """The training in a process that is killed so many seconds after the event for which `aim` names them.

        It begins nothing else before: the kill falls into the phase that was aimed at, or at its end.
        """
        os.environ.setdefault("XLA_FLAGS", QUICK_COMPILATION)  # the server hands it on
        ours, theirs = SERVER.Pipe()
        output = run.with_name(f"{run.name}.txt")
        process = SERVER.Process(target=_child, args=(self.arguments(run), self.cache, output, theirs))
        process.start()
        theirs.close()  # so that the pipe ends with the process
        events: list[Event] = []
        while ours.poll(LIMIT):
            try:
                events.append(ours.recv())
                delay = aim(events[-1])
                ours.send("go on")  # it waits for that: with the next event until it was killed
            except (EOFError, OSError):
                break
            if delay is not None:
                time.sleep(delay)
                process.kill()
                break
        else:
            process.kill()
            raise AssertionError(f"the training hung for {LIMIT:.0f} s after {events[-1:]}")
        process.join()
        return Ended(events=events, code=process.exitcode, output=output.read_text(errors="replace"))


def _child(arguments: list[str], cache: Path, output: Path, events: Connection) -> None:
    """The process: what it says goes to a file."""
    with output.open("wb") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    from tqdm import tqdm

    from spnr_jax import cli
    from spnr_jax.formats import data_sets

    tqdm.set_lock(threading.RLock())  # its own is a semaphore between processes, which a killed one would leave behind
    jax.config.update("jax_compilation_cache_dir", str(cache))

    def tell(phase: str, step: int, what: object) -> None:
        events.send(Event(time.monotonic(), phase, step, checksum(what) if phase == "step" else None))
        events.recv()

    def train() -> None:
        command = cli.parse(arguments)
        dataset = data_sets.open_dataset(command.data)
        trainer.train(command.config, dataset, command.run, command.schedule, on_event=tell)
        print("trained")

    tell("start", 0, None)
    sys.exit(cli.guard(train, "spnr"))


def checksum(tree: object) -> str:
    """Of the bits of all arrays of a tree."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        raw = jax.random.key_data(leaf) if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        digest.update(np.asarray(raw).tobytes())
    return digest.hexdigest()[:16]


def batches(*trials: Ended) -> dict[int, set[str | None]]:
    """Checksums of all batches that were seen by step."""
    seen: dict[int, set[str | None]] = {}
    for event in (event for trial in trials for event in trial.events if event.phase == "step"):
        seen.setdefault(event.step, set()).add(event.batch)
    return seen


def rows(run: Path) -> list[dict]:
    """The metrics file without the time that a step took, the one entry that a clock decides."""
    return [{k: v for k, v in row.items() if k != "ms_per_step"} for row in trainer.read_rows(run)]


def different(run: Path, whole: Path) -> list[str]:
    """Which parts of two runs' newest states do not have the same bits."""
    (config, state), (expected_config, expected) = checkpoint.load_run(run), checkpoint.load_run(whole)
    names = [field.name for field in dataclasses.fields(state)]
    found = [name for name in names if checksum(getattr(state, name)) != checksum(getattr(expected, name))]
    return found if config == expected_config else ["config", *found]


def checkpoint_steps(run: Path) -> list[int]:
    """Steps of a run's checkpoints, newest first."""
    names = [path.name for path in (run / "checkpoints").iterdir()] if (run / "checkpoints").is_dir() else []
    return sorted((int(name) for name in names if name.isdigit()), reverse=True)
