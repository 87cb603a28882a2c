"""A Dask scheduler with a worker in this process, for tests."""

from contextlib import contextmanager

import psutil
from distributed import LocalCluster


@contextmanager
def in_this_process():
    """The address of a scheduler with one worker thread in this process."""
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0") as scheduler:
        yield scheduler.scheduler_address


def is_worker(process):
    """Whether a process is a worker, and alive."""
    try:
        return "spawn_main" in " ".join(process.cmdline())
    except psutil.Error:
        return False
