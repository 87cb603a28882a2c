"""Laws of the engine: a worker's death costs its own task at most, nothing outlives the run, and errors come home."""

import os
import signal
import subprocess
import sys
import time
from itertools import count, islice
from pathlib import Path

import psutil
import pytest
from distributed import LocalCluster
from support.schedulers import in_this_process, is_worker

from spnr_jax.devices import cluster

ROOT = Path(__file__).parents[2]


def double_or_die(state, task):
    """A task: 13 kills its process every time, 7 only the first time, 99 fails."""
    marker = Path(state) / "seven"
    if task == 13 or (task == 7 and not marker.exists()):
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if task == 99:
        raise OSError(28, "No space left on device")
    return 2 * task


def run(state, tasks, num_workers=1):
    with cluster.connect(None, num_workers) as client:
        return dict(cluster.run_tasks(client, double_or_die, str(state), tasks))


def test_a_killed_worker_costs_its_own_task_at_most(tmp_path):
    assert run(tmp_path, [1, 7, 13, 5], 2) == {1: 2, 7: 14, 13: cluster.Died(2), 5: 10}


@pytest.mark.ci
def test_an_error_in_a_worker_is_raised_and_workers_that_end_slowly_cost_no_result(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "GRACE", 1e-6)  # nothing ends so fast, not even when it is killed
    before = set(psutil.Process().children(recursive=True))
    assert run(tmp_path, [1, 2], 2) == {1: 2, 2: 4}
    started = [child for child in set(psutil.Process().children(recursive=True)) - before if is_worker(child)]
    assert not psutil.wait_procs(started, timeout=10)[1]
    with pytest.raises(OSError, match="No space"):
        run(tmp_path, [99, 1])
    assert not [child for child in set(psutil.Process().children(recursive=True)) - before if is_worker(child)]


def echo(state, task):
    return state, task, os.getpid()


@pytest.fixture(scope="module")
def threaded():
    with in_this_process() as address:
        yield address


def test_an_address_is_used_as_it_is_and_workers_stay_when_the_run_ends(threaded):
    for state in ("first", "second"):
        with cluster.connect(threaded, 5) as client:
            assert list(cluster.run_tasks(client, echo, state, [1])) == [(1, (state, 1, os.getpid()))]


def test_tasks_without_end_are_taken_as_they_are_needed(threaded, monkeypatch):
    monkeypatch.setattr(cluster, "WINDOW", 3)
    taken = []

    def endless():
        for number in count():
            taken.append(number)
            yield number

    with cluster.connect(threaded, 1) as client:
        results = cluster.run_tasks(client, echo, "", endless())
        found = {task for task, _ in islice(results, 5)}
        results.close()
    assert len(found) == 5
    assert len(taken) <= 5 + 3


def test_a_worker_that_would_run_several_tasks_at_once_is_refused():
    with (
        LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0") as scheduler,
        cluster.connect(scheduler.scheduler_address, 1) as client,
        pytest.raises(ValueError, match="has 2 threads; start it with --nthreads 1"),
    ):
        list(cluster.run_tasks(client, echo, "", [1]))


@pytest.mark.parametrize(("address", "error"), [("nonsense", ValueError), ("tcp://127.0.0.1:1", OSError)])
def test_an_address_where_nothing_answers_is_named(address, error, monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE", 0.2)
    with pytest.raises(error, match=address), cluster.connect(address, 1):
        pass


SLEEPER = """
import os, time
from spnr_jax.devices import cluster

def sleep(state, task):
    os.write(1, b"%d\\n" % task)  # at once: both tasks write to the same pipe
    time.sleep(60)

if __name__ == "__main__":
    with cluster.connect(None, 2) as client:
        list(cluster.run_tasks(client, sleep, "", [1, 2]))
"""


@pytest.mark.ci
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_a_parent_that_is_interrupted_or_killed(how, tmp_path):
    script = tmp_path / "sleeper.py"
    script.write_text(SLEEPER)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen(
        [sys.executable, script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment,
        start_new_session=True,
    )
    assert sorted([parent.stdout.readline(), parent.stdout.readline()]) == [b"1\n", b"2\n"]
    children = psutil.Process(parent.pid).children(recursive=True)
    assert len(children) >= 2
    start = time.monotonic()
    if how == signal.SIGINT:  # as a terminal does it: every process gets the signal
        os.killpg(parent.pid, how)
    else:
        parent.send_signal(how)
    message = parent.communicate(timeout=20)[1].decode()
    assert message.count("Traceback") == (how == signal.SIGINT), "of the script itself"
    _, alive = psutil.wait_procs(children, timeout=10)
    assert not alive
    assert time.monotonic() - start < 10
