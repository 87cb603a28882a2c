"""A side of the benchmark in a process of its own, asked for one turn at a time: without JAX, which the twin lacks.

The child makes its function, runs it until it is warm, and then waits for lines on stdin; each names the seconds of a
turn and is answered by one line of JSON.  Between turns it must not spin: every answer says how much processor time
passed while it waited (a few ms at most with the defaults of OpenMP and XLA, so none is changed).  Peak memory is that
of the turns; what making the function took (a compiler takes more than the function) is given back before.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any

from experiments.comparison.peak_memory import forget_peak, peak_mb
from spnr_jax.devices import allocator
from spnr_jax.errors import UserError

FEWEST = 3  # timed runs of a turn


class Worker:
    """The parent's end of a child: `facts` is what it said of itself, `turn` asks it to work."""

    def __init__(self, name: str, process: subprocess.Popen, errors: IO[str]) -> None:
        """Waits until the child is ready; ValueError with its last words if it stops."""
        self._name, self._process, self._errors = name, process, errors
        self.facts = self._answer()

    def turn(self, seconds: float) -> dict[str, Any]:
        """{"ms": each run's, "peak_mb", "idle_cpu_s": processor time since the last turn}."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # the missing answer says why
            self._process.stdin.write(f"{seconds}\n")
            self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            code = self._process.wait()
            self._errors.seek(0)
            words = self._errors.read().strip().splitlines() or ["it said nothing"]
            raise UserError(f"{self._name} stopped with code {code}: {words[-1]}")
        return json.loads(line)


@contextmanager
def worker(module: str, spec: dict) -> Iterator[Worker]:
    """The child `python -m module SPEC`, ready to be asked; it ends with the block."""
    # no persistent compilation cache: its hits would be taken for the compiler's time
    settings = {"JAX_PLATFORMS": spec.get("platform", "cpu"), "JAX_ENABLE_COMPILATION_CACHE": "false"}
    settings["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # of a GPU's memory: both sides live on it
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            [sys.executable, "-m", module, json.dumps(spec)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=os.environ | settings | {"OMP_NUM_THREADS": str(spec["threads"])},
        ) as process,
    ):
        try:
            yield Worker(f"{module} ({spec['preset']}, {spec['mode']})", process, errors)
        finally:
            process.kill()


def serve(make: Callable[[dict], tuple[Callable[[], object], dict]]) -> None:
    """The child's end: `make` turns the spec into (function to time, facts), the rest is said above."""
    spec = json.loads(sys.argv[1])
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a library prints is no answer
    sys.stdout = sys.stderr  # unbuffered: it stands before an error's last words
    allocator.keep()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: spec["threads"]])
    start = time.perf_counter()
    run, facts = make(spec)
    forget_peak()
    print(json.dumps(facts | {"start_s": round(time.perf_counter() - start, 1)}), file=answers)
    rested = time.process_time()
    for line in sys.stdin:
        idle = time.process_time() - rested
        answer = {"ms": turn(run, float(line)), "peak_mb": peak_mb(), "idle_cpu_s": round(idle, 4)}
        rested = time.process_time()
        print(json.dumps(answer), file=answers)


def turn(run: Callable[[], object], seconds: float) -> list[float]:
    """Milliseconds of each run until so many seconds are full; one run before them refills the caches."""
    run()
    taken: list[float] = []
    while len(taken) < FEWEST or sum(taken) < 1e3 * seconds:
        start = time.perf_counter()
        run()
        taken.append(round(1e3 * (time.perf_counter() - start), 3))
    return taken
