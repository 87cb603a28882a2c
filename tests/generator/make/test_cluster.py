"""Laws of the engine: a worker's death costs its own task at most, nothing outlives the run, and errors come home."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from itertools import count, islice
from pathlib import Path

import psutil
import pytest
from distributed import LocalCluster
from fsspec.implementations.memory import MemoryFileSystem

from data_gen.make import cluster, objects
from data_gen.make.generate import generate
from data_gen.plan import tasks
from data_gen.render import views
from data_gen.store import check, layout, storage

ROOT = Path(__file__).parents[3]


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


def test_an_error_in_a_worker_is_raised_in_the_parent_and_the_workers_end(tmp_path):
    before = set(psutil.Process().children(recursive=True))
    with pytest.raises(OSError, match="No space"):
        run(tmp_path, [99, 1])
    left = [
        child for child in set(psutil.Process().children(recursive=True)) - before if "spawn_main" in command(child)
    ]
    assert not left


def command(process):
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


def echo(state, task):
    return state, task, os.getpid()


@pytest.fixture(scope="module")
def threaded():
    """A scheduler with one worker thread in this process."""
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0") as scheduler:
        yield scheduler.scheduler_address


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
from data_gen.make import cluster

def sleep(state, task):
    os.write(1, b"%d\\n" % task)  # at once: both tasks write to the same pipe
    time.sleep(60)

if __name__ == "__main__":
    with cluster.connect(None, 2) as client:
        list(cluster.run_tasks(client, sleep, "", [1, 2]))
"""


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


SMALL = {"categories": ("frame", "lamp"), "resolution": 24, "views": 2, "points": 64, "spp": 4, "variant": "scalar_rgb"}


def make(out, objects=3, **options):
    generate(tasks.GenerateConfig(out=out, objects=objects, **{**SMALL, **options}))
    return files(out)


def start(out, *options):
    """The same as `make` in a process of its own, as a user starts it."""
    arguments = [str(out), *options]
    for name, value in SMALL.items():
        arguments += [f"--{name}", *(value if isinstance(value, tuple) else [str(value)])]
    return subprocess.Popen(
        [sys.executable, "-m", "data_gen", "generate", *arguments], cwd=ROOT, stderr=subprocess.PIPE
    )


def files(place):
    """Every file below a place, with its bytes."""
    filesystem, root = storage.open_place(place)
    return {name.removeprefix(root): filesystem.cat_file(name) for name in filesystem.find(root)}


def test_a_cluster_and_an_object_store_give_the_bytes_of_local_processes_and_a_folder(threaded, tmp_path):
    try:
        remote = make("memory://cluster/set", cluster=threaded)
        assert "/objects/frame_000005/object.json" in remote
        MemoryFileSystem.store.pop("/cluster/set/objects/frame_000005/object.json")
        assert make("memory://cluster/set", cluster=threaded) == remote, "an object without object.json is made again"
    finally:
        MemoryFileSystem.store.clear()
        MemoryFileSystem.pseudo_dirs[:] = [""]
    assert make(tmp_path / "set", workers=1) == remote


def test_a_worker_that_does_not_see_a_mesh_file_ends_the_run_with_its_name(threaded, tmp_path):
    unseen = tasks.Task(object_id="thing", path=tmp_path / "other.ply")
    bench = objects.Workbench(
        out=str(tmp_path / "set"), lights=None, view=views.ViewConfig(), num_points=4, seed=0, variant="scalar_rgb"
    )
    with (
        cluster.connect(threaded, 1) as client,
        pytest.raises(ValueError, match=r"other\.ply: worker .* does not see this file"),
    ):
        list(cluster.run_tasks(client, objects.make_and_write, bench, [unseen]))


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


@pytest.mark.slow
def test_workers_of_a_cluster_that_are_killed_at_their_work_lose_nothing(tmp_path):
    expected = make(tmp_path / "local", objects=12)
    with scheduler_and_workers(tmp_path, 2) as (address, nannies):
        parent = start(tmp_path / "set", "--objects", "12", "--cluster", address)
        for number in (1, 3, 5):
            while len(done := layout.completed_objects(tmp_path / "set")) < number:
                assert parent.poll() is None
                time.sleep(0.01)
            times = {name: (tmp_path / "set/objects" / name).stat().st_mtime_ns for name in done}
            victims = [child for child in nannies.children(recursive=True) if "spawn_main" in command(child)]
            victims[number % len(victims)].kill()
        message = parent.communicate(timeout=120)[1].decode()
        assert parent.returncode == 0, message
        assert nannies.is_running()
    assert files(tmp_path / "set") == expected
    assert all((tmp_path / "set/objects" / name).stat().st_mtime_ns == written for name, written in times.items())


@pytest.mark.slow
def test_two_runs_at_once_on_one_folder_end_with_the_bytes_of_one(tmp_path):
    expected = make(tmp_path / "alone", objects=8)
    both = [start(tmp_path / "set", "--objects", "8", "--workers", "2") for _ in range(2)]
    messages = [process.communicate(timeout=120)[1].decode() for process in both]
    assert [process.returncode for process in both] == [0, 0], messages
    assert files(tmp_path / "set") == expected
    assert check.check(tmp_path / "set")
