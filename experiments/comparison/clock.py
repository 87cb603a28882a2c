"""Seconds of work: CPU time of all cores where JAX computes on a CPU, other work does not count; else wall time."""

import time
from collections.abc import Callable, Mapping

import jax


def now() -> float:
    """Seconds so far."""
    return time.process_time() if jax.default_backend() == "cpu" else time.perf_counter()


def in_turns(work: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """Seconds of each, one after the other, round by round; the first, which compiles, is left out."""
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds + 1):
        for name, run in work.items():
            start = now()
            jax.block_until_ready(run())
            seconds[name].append(now() - start)
    return {name: taken[1:] for name, taken in seconds.items()}
