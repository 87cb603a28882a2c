"""Dask schedulers with workers, for tests: in this process, and as they are started by hand."""

import json
import os
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import psutil
from distributed import LocalCluster

ROOT = Path(__file__).parents[2]


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


@contextmanager
def scheduler_and_workers(folder, workers):
    """The address of a Dask scheduler and the process that runs its workers, as they are started by hand."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    file = folder / "scheduler.json"
    programs = (
        ["dask_scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)],
        ["dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--nworkers", str(workers), "--no-dashboard"],
    )
    with (folder / "log").open("w") as log:
        started = [
            subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{name}", *options], env=environment, stdout=log, stderr=log
            )
            for name, *options in programs
        ]
        try:
            while not file.exists() or not file.read_text().endswith("}"):
                assert all(process.poll() is None for process in started), (folder / "log").read_text()
                time.sleep(0.05)
            yield json.loads(file.read_text())["address"], psutil.Process(started[1].pid)
        finally:
            for process in reversed(started):
                process.terminate()
            for process in started:
                process.wait(timeout=30)
