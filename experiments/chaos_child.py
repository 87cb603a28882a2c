"""`spnr train` in a process of its own that can be killed, with a witness that says what it is doing.

A fork server, which has imported everything and touched no device, starts each process in milliseconds instead of
seconds.  What runs in it is the command itself.  The witness wraps five functions and sends an Event through a pipe
whenever one of them begins or ends; it changes nothing that they do.  The last event that was sent is where a killed
process was.
"""

import hashlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, NamedTuple

Phase = Literal["start", "step", "log", "checkpoint", "preview"]
PHASES: tuple[Phase, ...] = ("start", "step", "log", "checkpoint", "preview")
LIMIT = 300.0  # seconds without an event after which a process hangs

SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(
    ["spnr_jax.training.trainer", "spnr_jax.cli", "orbax.checkpoint.v1", "grain", "tensorboardX", __name__]
)
# least optimisation: nothing but rounding depends on it, and a start waits for the compiler and the tracer alone
QUICK_COMPILATION = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"


class Event(NamedTuple):
    """Seconds on the machine's clock, the phase that begins, steps done so far, and of a step its batch's checksum."""

    seconds: float
    phase: Phase
    step: int
    batch: str | None = None


@dataclass(frozen=True, kw_only=True)
class Ended:
    """A process that is over: its events, exit code (minus the signal that killed it), output, and its duration.

    `seconds_to_end` are those from the signal, if one was sent, to the end.
    """

    events: list[Event]
    code: int
    output: str
    seconds: float
    seconds_to_end: float | None

    @property
    def said(self) -> str:
        """What it said last."""
        return (self.output.strip().splitlines() or [""])[-1]


Aim = Callable[[Event], float | None]  # seconds from this event until the signal, None if it is not yet time


def run(
    arguments: list[str], cache: Path, output: Path, aim: Aim = lambda event: None, number: int = signal.SIGKILL
) -> Ended:
    """`spnr ARGUMENTS`, with the signal when `aim` says so; its compiled programs stay in the folder `cache`."""
    os.environ.setdefault("XLA_FLAGS", QUICK_COMPILATION)  # the server hands it on
    receiver, sender = SERVER.Pipe(duplex=False)
    process = SERVER.Process(target=_child, args=(arguments, cache, output, sender))
    begin, sent, events = time.monotonic(), None, []
    process.start()
    sender.close()  # so that the pipe ends with the process
    while receiver.poll(LIMIT):
        try:
            events.append(receiver.recv())
        except (EOFError, OSError):
            break
        if process.pid and sent is None and (delay := aim(events[-1])) is not None:
            time.sleep(delay)
            os.kill(process.pid, number)
            sent = time.monotonic()
    else:
        process.kill()
        raise ValueError(f"{output}: the training hung for {LIMIT:.0f} s after {events[-1] if events else 'its start'}")
    process.join()
    end = time.monotonic()
    assert process.exitcode is not None, "it has ended"
    return Ended(
        events=events,
        code=process.exitcode,
        output=output.read_text(errors="replace"),
        seconds=end - begin,
        seconds_to_end=None if sent is None else end - sent,
    )


def _child(arguments: list[str], cache: Path, output: Path, events: Connection) -> None:
    """The process: what it says goes to a file."""
    with output.open("wb") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    import jax
    from tqdm import tqdm

    from spnr_jax import cli

    tqdm.set_lock(threading.RLock())  # its own is a semaphore between processes, which a killed one would leave behind
    jax.config.update("jax_compilation_cache_dir", str(cache))
    _watch(events)
    cli.main(arguments)


def _watch(events: Connection) -> None:
    """Lets the functions that train say when they begin and end."""
    from spnr_jax.training import checkpoint, optimisation, trainer

    now = 0  # steps done

    def tell(phase: Phase, batch: str | None = None) -> None:
        events.send(Event(time.monotonic(), phase, now, batch))

    def watched(phase: Phase, work: Callable) -> Callable:
        def call(*arguments: Any) -> Any:
            tell(phase)
            result = work(*arguments)
            tell("step")
            return result

        return call

    def watched_step(work: Callable) -> Callable:
        def call(state: Any, batch: Any, **options: Any) -> Any:
            nonlocal now
            done, said = int(state.step), checksum(batch)
            result = work(state, batch, **options)
            now = done + 1
            tell("step", said)
            return result

        return call

    tell("start")
    for owner, name, watch in (
        (optimisation, "jitted_train_step", watched_step),
        (checkpoint, "save", partial(watched, "checkpoint")),
        (trainer, "preview", partial(watched, "preview")),
        (trainer.MetricsLog, "write", partial(watched, "log")),
    ):
        setattr(owner, name, watch(getattr(owner, name)))


def checksum(tree: Any) -> str:
    """Of the bits of all arrays of a tree."""
    import jax
    import numpy as np

    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        raw = jax.random.key_data(leaf) if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        digest.update(np.asarray(raw).tobytes())
    return digest.hexdigest()[:16]
