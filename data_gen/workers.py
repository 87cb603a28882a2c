"""A pool of processes that survives the death of its workers and says which task killed them.

The standard pools either hang or give up as a whole when a worker is killed (out of memory, a crash in native code).
Here each worker has its own pipe and one task at a time, so the parent knows whose task died: it is tried once more in
a fresh process and reported as `Died` if that one dies, too. A worker ends when its parent does, however that ends.
"""

import multiprocessing
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait

ATTEMPTS = 2


@dataclass(frozen=True)
class Died:
    """What became of a task whose worker process died under it, every time."""

    exitcode: int | None


@dataclass(kw_only=True)
class Worker:
    """A process, the parent's end of its pipe, and the task it has in hand."""

    process: multiprocessing.process.BaseProcess
    pipe: Connection
    task: object = None
    attempt: int = 0
    idle: bool = True


def run_tasks(
    function: Callable, tasks: Iterable, num_workers: int, setup: Callable, context: tuple
) -> Generator[tuple, None, None]:
    """Yield (task, result) as they finish, where result = function(setup(*context), task) in a worker, or Died.

    An exception in a worker ends the run and is raised here. Leaving the iterator early kills the workers at once.
    """
    waiting = deque((task, 1) for task in tasks)
    workers = [start_worker(function, setup, context) for _ in range(min(num_workers, len(waiting)))]
    try:
        while waiting or any(not worker.idle for worker in workers):
            for worker in workers:
                if worker.idle and waiting:
                    give(worker, *waiting.popleft())
            ready = wait([worker.pipe for worker in workers if not worker.idle])
            for place, worker in enumerate(workers):
                if worker.pipe not in ready:
                    continue
                try:
                    outcome, error = worker.pipe.recv()
                except (EOFError, ConnectionResetError):  # the process is gone, and its end of the pipe with it
                    worker.process.join()
                    workers[place] = start_worker(function, setup, context)
                    if worker.attempt < ATTEMPTS:
                        waiting.appendleft((worker.task, worker.attempt + 1))
                    else:
                        yield worker.task, Died(worker.process.exitcode)
                    continue
                if error is not None:
                    raise error
                worker.idle = True
                yield worker.task, outcome
    finally:
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.join()


def start_worker(function: Callable, setup: Callable, context: tuple) -> Worker:
    """Return a fresh worker process; spawned, not forked, because the renderer starts threads."""
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=work, args=(theirs, function, setup, context), daemon=True)
    with ctrl_c_ignored():  # inherited: Ctrl-C reaches every process of a terminal, and is the parent's business
        process.start()
    theirs.close()  # else the pipe would stay open, and silent, after the worker's death
    return Worker(process=process, pipe=ours)


@contextmanager
def ctrl_c_ignored() -> Iterator[None]:
    """Ignore SIGINT for a moment (only the main thread can)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def give(worker: Worker, task, attempt: int) -> None:
    """Hand a task to an idle worker; one that has died meanwhile is noticed when its answer is read."""
    worker.task, worker.attempt, worker.idle = task, attempt, False
    try:
        worker.pipe.send(task)
    except BrokenPipeError:
        return


def work(pipe: Connection, function: Callable, setup: Callable, context: tuple) -> None:
    """Do the tasks that come through the pipe until it closes."""
    state, error = None, None
    try:
        state = setup(*context)
    except Exception as raised:
        error = raised
    while True:
        try:
            task = pipe.recv()
        except EOFError:
            return
        outcome = None
        try:
            if error is None:
                outcome = function(state, task)
        except Exception as raised:
            error = raised
        pipe.send((outcome, error))
