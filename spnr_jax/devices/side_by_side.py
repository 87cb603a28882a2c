"""Work in a thread beside the one that draws: files are written while the next picture is computed."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

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
