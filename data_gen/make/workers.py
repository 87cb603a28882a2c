"""Worker processes for the renderings of a data set.

A worker is a fresh process with one thread (Mitsuba's noise depends on the number of threads), which has one task at a
time.  It is killed with its parent, however that ends.  A worker may be killed at any time, by LLVM or for lack of
memory: only its own task is lost, which is tried again when the others are done, with no other beside it.
"""

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from multiprocessing import connection, resource_tracker
from typing import Any

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
    """The pipe to a new worker, which has begun with a task.

    It has one thread, and ignores Ctrl-C, which reaches all processes of a terminal.
    """
    ours, theirs = PROCESSES.Pipe()
    processes.append(PROCESSES.Process(target=_work, args=(theirs, function, state), daemon=True))
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    resource_tracker.ensure_running()  # else it starts with the first worker, and unblocks the signal at that
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        processes[-1].start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)  # a Ctrl-C that has waited is raised here
    theirs.close()  # so that the pipe ends with the worker
    _send(ours, task)
    return ours


def _send(pipe: connection.Connection, task: Any) -> None:
    """Gives a worker its next task; if it died meanwhile, reading the pipe shows that."""
    with suppress(BrokenPipeError):
        pipe.send(task)


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
