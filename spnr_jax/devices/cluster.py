"""Tasks on a Dask scheduler: worker processes of this machine, or those of a cluster, by the same code.

A local worker is a fresh process with one thread (the noise of Mitsuba depends on its thread count) and is killed with
its parent, however that ends. A worker on a cluster is started by others, `dask worker ADDRESS --nthreads 1 --nworkers
N`, with this package installed and with the files and the output under the same paths or URLs.

A worker may be killed at any time: Dask gives its tasks to others. The scheduler cannot tell which of a dead worker's
tasks killed it, so those that it gives up are tried again one at a time; only what kills its worker even then has Died.
"""

import asyncio
import functools
import itertools
import logging
import signal
import sys
import uuid
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker

import dask
from distributed import Client, KilledWorker, LocalCluster, WorkerPlugin, as_completed, get_worker

from spnr_jax.errors import UserError

WINDOW = 4096  # tasks that the scheduler holds at a time; more than any cluster has workers
GRACE = 0.5  # seconds that a local worker has to end by itself
PATIENCE = 10  # seconds that a scheduler has to answer
LOCAL_SCHEDULER = {
    "distributed.scheduler.allowed-failures": 0,  # the second attempt is ours, see above
    "distributed.scheduler.worker-ttl": None,  # compiling a scene can keep a worker silent for minutes
}


@dataclass(frozen=True)
class Died:
    """What became of a task under which so many worker processes died, all that were tried."""

    times: int


class Bench(WorkerPlugin):
    """What every task of one run needs; Dask sends it once to each worker, also to those that join later."""

    def __init__(self, state: object) -> None:
        self.name = f"spnr-{uuid.uuid4()}"
        self.state = state


@contextmanager
def connect(address: str | None, num_workers: int) -> Iterator[Client]:
    """Yield a client of the scheduler at an address; without one, of a new scheduler with local worker processes.

    Local workers are gone when the block ends, with what they had in hand. OSError if nothing answers at the address.
    """
    if address is not None:
        try:
            found = Client(address, name="spnr", timeout=PATIENCE)
        except ValueError as error:
            raise UserError(f"--cluster {address}: expected an address such as tcp://host:8786 ({error})") from None
        with found as client:
            if not client.nthreads():
                print(f"{address} has no workers yet; waiting for some", file=sys.stderr)
            yield client
        return
    with local_cluster(num_workers) as cluster, Client(cluster) as client:
        yield client


@contextmanager
def local_cluster(num_workers: int) -> Iterator[LocalCluster]:
    """Yield a scheduler in this process with worker processes of its own, all gone when the block ends.

    Ctrl-C, which reaches every process of a terminal, is this thread's business alone: the signal is blocked while the
    cluster starts, and so for good in its threads and processes, which inherit that.
    """
    resource_tracker.ensure_running()  # else it starts with the first worker, and unblocks the signal at that
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with dask.config.set(LOCAL_SCHEDULER):
            cluster = LocalCluster(
                n_workers=num_workers,
                threads_per_worker=1,
                memory_limit=None,
                dashboard_address=":0",  # any free port for its status page, so that several runs get along
                silence_logs=logging.CRITICAL,
            )
        try:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)  # a Ctrl-C that has waited is raised here
            yield cluster
        finally:
            logging.getLogger("asyncio").setLevel(logging.CRITICAL)  # what was under way with the workers is lost
            cluster.sync(end_workers, cluster)
            cluster.close()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


async def end_workers(cluster: LocalCluster) -> None:
    """End a local cluster's workers: soon, and not when their tasks are done.

    One that does not end by itself is killed, and a busy machine may take longer than GRACE to clear it away.
    """
    closing = (nanny.close(timeout=GRACE) for nanny in cluster.workers.values())
    for fault in await asyncio.gather(*closing, return_exceptions=True):
        if isinstance(fault, BaseException) and not isinstance(fault, TimeoutError):
            raise fault


def run_tasks(client: Client, function: Callable, state: object, tasks: Iterable) -> Generator[tuple, None, None]:
    """Yield (task, result) as they finish, where result = function(state, task) in a worker, or Died.

    An exception in a worker ends the run and is raised here. Tasks are taken from the iterable as workers need them.
    """
    bench = Bench(state)
    client.register_plugin(bench)
    work = functools.partial(do, function, bench.name)
    suspects, deaths = [], 0
    for task, outcome in in_window(client, work, tasks, WINDOW):
        if isinstance(outcome, Died):
            suspects.append(task)
            deaths = outcome.times
        else:
            yield task, outcome
    for task, outcome in in_window(client, work, suspects, 1):
        yield task, Died(deaths + outcome.times) if isinstance(outcome, Died) else outcome
    client.unregister_worker_plugin(bench.name)


def in_window(client: Client, work: Callable, tasks: Iterable, window: int) -> Generator[tuple, None, None]:
    """Yield (task, work(task) or Died) as they finish, with at most so many tasks in the scheduler's hands."""
    waiting = iter(tasks)
    running = {}

    def submit(task):
        future = client.submit(work, task, pure=False)
        running[future.key] = task
        return future

    finished = as_completed([submit(task) for task in itertools.islice(waiting, window)])
    for future in finished:
        try:
            outcome = future.result()
        except KilledWorker as killed:
            outcome = Died(killed.allowed_failures + 1)
        except CancelledError:
            raise ConnectionError("the scheduler is gone, or has dropped this run") from None
        yield running.pop(future.key), outcome
        for following in itertools.islice(waiting, 1):
            finished.add(submit(following))


def do(function: Callable, bench: str, task):
    """Return function(state, task) in a worker that runs nothing else meanwhile."""
    worker = get_worker()
    if worker.state.nthreads != 1:
        raise UserError(f"worker {worker.address} has {worker.state.nthreads} threads; start it with --nthreads 1")
    plugin = worker.plugins[bench]
    assert isinstance(plugin, Bench)
    return function(plugin.state, task)
