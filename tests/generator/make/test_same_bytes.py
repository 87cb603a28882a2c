"""A data set is the same whatever makes it, and whatever becomes of that meanwhile."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.command_line import spnr_data
from support.folders import contents

from data_gen.store import check, layout

pytestmark = pytest.mark.ci  # it renders several data sets

ROOT = Path(__file__).parents[3]
SMALL = "--objects 8 --categories frame lamp --resolution 24 --views 2 --points 64 --spp 4"


def options(out):
    return [str(out), *SMALL.split()]


def make(out, *more):
    assert spnr_data("generate", *options(out), "--variant", "scalar_rgb", *more) == 0
    return contents(out)


def start(out, *more):
    """The same as `make` in a process of its own, as a user starts it."""
    command = [sys.executable, "-m", "data_gen", "generate", *options(out), "--variant", "scalar_rgb", *more]
    return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, start_new_session=True)


def wait_for(out, number, process):
    """The names of the objects that are done, once they are so many."""
    while len(done := layout.list_completed(out)) < number:
        assert process.poll() is None
        time.sleep(0.01)
    return done


def with_two_workers_that_are_stopped_and_go_on(folder):
    out = folder / "set"
    process = start(out, "--workers", "2")
    wait_for(out, 1, process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does it: every process gets the signal
    message = process.communicate(timeout=30)[1].decode()
    assert process.returncode == 130, message
    assert "Traceback" not in message
    assert "stopped" in message.splitlines()[-1]
    assert layout.list_completed(out)
    assert not list((out / "objects").glob(layout.UNFINISHED + "*"))
    assert not (out / "splits").exists()
    make(out, "--workers", 2)
    times = {path: path.stat().st_mtime_ns for path in (out / "objects").rglob("*")}
    made = make(out)
    assert {path: path.stat().st_mtime_ns for path in (out / "objects").rglob("*")} == times, "nothing is left to do"
    return made


def by_two_runs_at_once(folder):
    both = [start(folder / "set", "--workers", "2") for _ in range(2)]
    messages = [process.communicate(timeout=120)[1].decode() for process in both]
    assert [process.returncode for process in both] == [0, 0], messages
    assert check.check(folder / "set")
    return contents(folder / "set")


@pytest.fixture(scope="module")
def expected(tmp_path_factory, generate_here):
    """The data set of one undisturbed process."""
    out = tmp_path_factory.mktemp("alone") / "set"
    assert generate_here(*options(out)) == 0
    return contents(out)


@pytest.mark.parametrize(
    "way",
    [with_two_workers_that_are_stopped_and_go_on, pytest.param(by_two_runs_at_once, marks=pytest.mark.slow)],
)
def test_the_bytes_are_the_same(way, expected, tmp_path):
    assert way(tmp_path) == expected
