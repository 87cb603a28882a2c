"""A data set is the same whichever workers make it, and whatever becomes of them meanwhile."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from fsspec.implementations.memory import MemoryFileSystem
from support.schedulers import in_this_process, is_worker, scheduler_and_workers

from data_gen.make import objects
from data_gen.make.generate import generate
from data_gen.plan import tasks
from data_gen.render import views
from data_gen.store import check, layout, storage
from spnr_jax.devices import cluster

pytestmark = pytest.mark.ci  # it renders several data sets

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def threaded():
    with in_this_process() as address:
        yield address


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
            victims = [child for child in nannies.children(recursive=True) if is_worker(child)]
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
