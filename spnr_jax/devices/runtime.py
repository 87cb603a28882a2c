"""What a process asks of its machine: threads, memory reuse, cached programs; and what the machine is.

glibc's allocator is tuned for speed and so that memory does not grow; other C libraries are left alone.  Nothing here
imports JAX before it is called: `cache_programs` comes before that.
"""

import ctypes
import os
import platform
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

# --- threads ----------------------------------------------------------------------------------------------------------


def run_ahead(jobs: Iterable[Callable[[], Result]], threads: int = 1, most: int = 1) -> Iterator[Result]:
    """Results of the jobs in their order; threads run up to `most` of them ahead.

    An exception in a job, or while one is made, is raised here; jobs that have not started are then dropped.
    """
    pool, waiting = ThreadPoolExecutor(threads), deque[Future]()
    try:
        for job in jobs:
            waiting.append(pool.submit(job))
            if len(waiting) > most:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def two_at_a_time(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Results of the work on each item, in order; the first runs alone, so that the others reuse what it compiles."""
    jobs = (partial(work, item) for item in items)
    yield from (job() for job in islice(jobs, 1))
    yield from run_ahead(jobs, threads=2)


# --- memory -----------------------------------------------------------------------------------------------------------


TRIM_THRESHOLD, MMAP_MAX, ARENA_MAX = -1, -4, -8  # M_... of malloc.h


def reuse_memory() -> None:
    """Makes JAX on a CPU reuse the heap of the previous step (mallopt), without page faults; call it before JAX runs.

    Otherwise the system maps and clears a step's temporary memory each time, which takes a fifth of the step.  JAX then
    computes in the calling thread: arenas of other threads hold at most 64 MB.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    call_libc("mallopt", MMAP_MAX, 0)
    call_libc("mallopt", TRIM_THRESHOLD, 2**31 - 1)  # freed memory stays until `trim_memory`


def limit_arenas() -> None:
    """Makes threads that start from now on share as many arenas as there are cores.

    Each batch, row and checkpoint is made by new threads; with an arena for each, freed memory would stay scattered
    over all of them.  With fewer arenas than cores, the threads of one step would wait for each other.
    """
    call_libc("mallopt", ARENA_MAX, os.cpu_count() or 1)


def trim_memory() -> None:
    """Returns freed memory to the system; otherwise glibc keeps 130 MB after Orbax saves, and more each time."""
    call_libc("malloc_trim", 0)


def call_libc(name: str, *arguments: int) -> None:
    """Calls a function of glibc; does nothing with another C library."""
    with suppress(OSError, AttributeError):
        getattr(ctypes.CDLL("libc.so.6"), name)(*arguments)


# --- programs on the disk ---------------------------------------------------------------------------------------------


SHORTEST = 0.1  # seconds of compilation from which a program is cached
# XLA options for an outermost jit: long programs compile in one to two thirds of the time, and run as fast
QUICK = {"xla_cpu_use_fusion_emitters": False}
QUICKEST = QUICK | {"xla_backend_optimization_level": 1}

ENTRY = re.compile("-[0-9a-f]{64}-cache$")  # file names of JAX's entries
CHECK_MARK = "looked-at"  # file whose modification time tells which entries were checked: all older ones


def cache_programs() -> None:
    """Lets a second run skip XLA's compilation; JAX_COMPILATION_CACHE_DIR moves the cache, or disables it if empty."""
    hide_false_alarms()
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(caches / "spnr_jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
    if cache := jax.config.values["jax_compilation_cache_dir"]:
        with suppress(OSError):  # there is none yet, or it is not ours to mend
            remove_broken(Path(cache))


def hide_false_alarms() -> None:
    """Hides errors that XLA logs on some processors for each program that it reads, though nothing is wrong.

    openxla/xla#44565.  Call it before JAX is imported; TF_CPP_MIN_LOG_LEVEL=2 shows them.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def remove_broken(cache: Path) -> None:
    """Removes truncated entries of processes that were killed while writing.

    JAX would warn of them and compile in every run, because it does not overwrite entries.  Only entries written since
    the last check are read.
    """
    from jax._src.compilation_cache import decompress_executable  # there is no public way to read an entry

    begin, mark = time.time_ns(), cache / CHECK_MARK
    last = mark.stat().st_mtime_ns if mark.exists() else 0
    for entry in os.scandir(cache):
        if ENTRY.search(entry.name) and entry.stat().st_mtime_ns >= last:
            try:
                decompress_executable(Path(entry.path).read_bytes())
            except OSError:  # another process removed it, or it is another user's
                continue
            except Exception:  # of whichever library unpacks them
                Path(entry.path).unlink(missing_ok=True)
    mark.touch()
    os.utime(mark, ns=(begin, begin))


# --- the machine ------------------------------------------------------------------------------------------------------


CPUINFO = Path("/proc/cpuinfo")


def describe_hardware() -> str:
    """The device that JAX uses."""
    import jax

    device = jax.devices()[0]
    if device.platform != "cpu":
        return f"{jax.device_count()} x {device.device_kind}"
    lines = CPUINFO.read_text().splitlines() if CPUINFO.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{cores} cores of {(names or [platform.machine()])[0]}"


def measure_load() -> float:
    """Load average of the machine over the last minute, other users included."""
    return round(os.getloadavg()[0], 1)
