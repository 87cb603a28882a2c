"""What a process asks of its machine: threads, workers, memory that stays, kept programs; what the machine is.

glibc's allocator is asked for speed and so that memory does not grow; other C libraries are left alone.  Nothing here
imports JAX before it is called: `keep_programs` comes before that.

A worker is a fresh process with one thread (the noise of Mitsuba depends on its thread count), which has one task at a
time.  It is killed with its parent, however that ends.  A worker may be killed at any time, by LLVM or for want of
memory: this costs its own task alone, which is tried again when the others are done, with no other beside it.
"""

import ctypes
import multiprocessing
import os
import platform
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice
from multiprocessing import connection, resource_tracker
from pathlib import Path
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

# --- threads ----------------------------------------------------------------------------------------------------------


def run_ahead(jobs: Iterable[Callable[[], Result]], threads: int = 1, most: int = 1) -> Iterator[Result]:
    """Results of the jobs in their order; threads do `most` of them ahead, while others are made or used here.

    What is raised by a job, or while one is made, is raised here; jobs that have not begun are dropped then.
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
    """Results of the work on each item, in their order; the first is computed alone: what it compiles serves others."""
    jobs = (partial(work, item) for item in items)
    yield from (job() for job in islice(jobs, 1))
    yield from run_ahead(jobs, threads=2)


# --- worker processes -------------------------------------------------------------------------------------------------


DIED = "the process that worked on it died twice; out of memory?"
PROCESSES = multiprocessing.get_context("spawn")


def run_tasks(
    function: Callable[[Any, Any], Any], state: Any, tasks: Iterable, num_workers: int
) -> Generator[tuple[Any, Any], None, None]:
    """Yields (task, result) as they finish, where result = function(state, task) in a worker, or DIED.

    An exception in a worker ends the run and is raised here.  Tasks are taken from the iterable as workers need them.
    Workers are gone when the generator is closed, with what they had in hand.
    """
    suspects = []
    for task, result in _run_once(function, state, tasks, num_workers):
        if result is DIED:
            suspects.append(task)
        else:
            yield task, result
    yield from _run_once(function, state, suspects, 1)


def _run_once(function: Callable, state: Any, tasks: Iterable, num_workers: int) -> Iterator[tuple[Any, Any]]:
    """`run_tasks`, in which one death of its worker is enough for DIED."""
    waiting, busy, processes = iter(tasks), dict[Any, Any](), list[Any]()
    try:
        for task in islice(waiting, num_workers):
            busy[_start(function, state, task, processes)] = task
        while busy:
            ready: list[Any] = connection.wait(list(busy))
            for pipe in ready:
                task = busy.pop(pipe)
                try:
                    result, error = pipe.recv()
                except (EOFError, OSError):
                    result, error = DIED, None
                if error is not None:
                    raise error
                for following in islice(waiting, 1):
                    if result is DIED:
                        pipe = _start(function, state, following, processes)
                    else:
                        _send(pipe, following)
                    busy[pipe] = following
                yield task, result
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.join()


def _start(function: Callable, state: Any, task: Any, processes: list) -> connection.Connection:
    """The pipe to a new worker, which has begun with a task."""
    ours, theirs = PROCESSES.Pipe()
    processes.append(PROCESSES.Process(target=_work, args=(theirs, function, state), daemon=True))
    with _ready_for_children():
        processes[-1].start()
    theirs.close()  # so that the pipe ends with the worker
    _send(ours, task)
    return ours


def _send(pipe: connection.Connection, task: Any) -> None:
    """Gives a worker its next task; of one that died meanwhile the pipe says so when it is read."""
    with suppress(BrokenPipeError):
        pipe.send(task)


@contextmanager
def _ready_for_children() -> Iterator[None]:
    """What is started meanwhile has one thread, and never sees Ctrl-C, which reaches every process of a terminal."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    resource_tracker.ensure_running()  # else it starts with the first worker, and unblocks the signal at that
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)  # a Ctrl-C that has waited is raised here


def _work(tasks: connection.Connection, function: Callable, state: Any) -> None:
    """The worker."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError):
        while True:
            task = tasks.recv()
            try:
                tasks.send((function(state, task), None))
            except Exception as error:  # noqa: BLE001 - raised in the parent
                error.add_note(traceback.format_exc())
                tasks.send((None, error))


def _end_with_parent() -> None:
    """Ends this process when its parent is gone."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


# --- memory -----------------------------------------------------------------------------------------------------------


TRIM_THRESHOLD, MMAP_MAX, ARENA_MAX = -1, -4, -8  # M_... of malloc.h


def keep_arrays() -> None:
    """Makes JAX on a CPU reuse the heap of the step before (mallopt), without page faults; call it before JAX computes.

    Else the system fetches and clears a step's temporary memory each time, a fifth of the step.  JAX computes in the
    thread that calls it then: other threads' arenas hold 64 MB at most, whatever glibc is asked.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    keep()


def keep() -> None:
    """Has memory that is freed stay in the process until it is given back."""
    _ask(lambda libc: libc.mallopt(MMAP_MAX, 0))
    _ask(lambda libc: libc.mallopt(TRIM_THRESHOLD, 2**31 - 1))


def few_arenas() -> None:
    """Has the threads that begin from now on share arenas, as many as there are cores.

    Each batch, row and checkpoint is made by other threads than the one before; with an arena for each, what they free
    stays scattered over all of them.  With fewer arenas than cores the threads of one step would wait for each other.
    """
    _ask(lambda libc: libc.mallopt(ARENA_MAX, os.cpu_count() or 1))


def give_back() -> None:
    """Has freed memory go back to the system: of Orbax's glibc keeps 130 MB, and 1 MB more after each save."""
    _ask(lambda libc: libc.malloc_trim(0))


def _ask(what: Callable[[ctypes.CDLL], int]) -> None:
    try:
        what(ctypes.CDLL("libc.so.6"))
    except (OSError, AttributeError):
        return  # another C library


# --- programs on the disk ---------------------------------------------------------------------------------------------


SHORTEST = 0.1  # seconds of compilation from which on a program is kept
# options of XLA for an outermost jit: a third to two thirds off the compilation of long programs, which run as long
QUICK = {"xla_cpu_use_fusion_emitters": False}
QUICKEST = QUICK | {"xla_backend_optimization_level": 1}

LOOKED_AT = "looked-at"  # file whose time says up to when entries are known to be whole


def folder() -> Path:
    """Where this package keeps what can be made again, of this user."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "spnr_jax"


def keep_programs() -> None:
    """Lets a second run skip XLA's compilation; JAX_COMPILATION_CACHE_DIR moves the cache.

    On some processors XLA logs two long errors for each program that it reads, though nothing is wrong with it
    (openxla/xla#44565).  Where JAX is not imported yet they stay off the terminal; TF_CPP_MIN_LOG_LEVEL=2 shows them.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
    with suppress(OSError):  # there is none yet, or it is not ours to mend
        remove_broken(Path(jax.config.values["jax_compilation_cache_dir"]))


def remove_broken(cache: Path) -> None:
    """Removes entries that are cut off, as a process leaves them that was killed while it wrote.

    JAX would warn of them and compile in every run, for it does not write over what is there.  Only what was written
    since the last look is read.
    """
    from jax._src.compilation_cache import decompress_executable  # there is no public way to read an entry

    begin, mark = time.time_ns(), cache / LOOKED_AT
    last = mark.stat().st_mtime_ns if mark.exists() else 0
    for entry in os.scandir(cache):
        if entry.name.endswith("-cache") and entry.stat().st_mtime_ns >= last:
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


def hardware() -> str:
    """The device that JAX uses, in words."""
    import jax

    device = jax.devices()[0]
    if device.platform != "cpu":
        return f"{jax.device_count()} x {device.device_kind}"
    lines = CPUINFO.read_text().splitlines() if CPUINFO.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{len(os.sched_getaffinity(0))} cores of {(names or [platform.machine()])[0]}"


def load() -> float:
    """Threads that ran or waited to run on this machine, mean of the last minute: those of others, too."""
    return round(os.getloadavg()[0], 1)
