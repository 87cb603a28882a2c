"""Work in threads beside one another: files are written while the next picture is computed, pictures two at a time."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
MOST_WAITING = 4  # jobs that wait for the thread at a time, each with its arrays


def beside(jobs: Iterator[Callable[[], Result]], most: int = MOST_WAITING) -> Iterator[Result]:
    """Results of the jobs in their order; a thread does each while the next ones are made here.

    What is raised by a job, or while one is made, is raised here; jobs that have not begun are dropped then.
    """
    with ThreadPoolExecutor(1) as thread:
        waiting: deque = deque()
        try:
            for job in jobs:
                waiting.append(thread.submit(job))
                while waiting and (waiting[0].done() or len(waiting) > most):
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            thread.shutdown(cancel_futures=True)


def two_at_a_time(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Results of the work on each item, in their order; two are computed at a time, ahead of the caller.

    The first is computed alone: what it compiles serves the others.  What the work raises is raised here.
    """
    left = iter(items)
    with ThreadPoolExecutor(2) as threads:
        try:
            waiting = deque(threads.submit(work, item) for item in islice(left, 1))
            while waiting:
                result = waiting.popleft().result()
                waiting.extend(threads.submit(work, item) for item in islice(left, 2 - len(waiting)))
                yield result
        finally:
            threads.shutdown(cancel_futures=True)
