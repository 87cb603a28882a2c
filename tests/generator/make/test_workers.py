"""Laws of the workers: a death costs its own task at most, nothing outlives the run, and errors come home."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from itertools import count, islice
from pathlib import Path

import pytest

from data_gen.make.workers import DIED, run_tasks

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


def test_a_killed_worker_costs_its_own_task_at_most_and_an_error_is_raised(tmp_path):
    found = dict(run_tasks(double_or_die, str(tmp_path), [1, 7, 13, 5], 2))
    assert found == {1: 2, 7: 14, 13: DIED, 5: 10}
    with pytest.raises(OSError, match="No space"):
        list(run_tasks(double_or_die, str(tmp_path), [99, 1], 1))
    assert not multiprocessing.active_children()


def test_tasks_without_end_are_taken_as_they_are_needed(tmp_path):
    taken = []
    results = run_tasks(double_or_die, str(tmp_path), (taken.append(i) or i for i in count(100)), 1)
    assert list(islice(results, 5)) == [(i, 2 * i) for i in range(100, 105)]
    results.close()
    assert len(taken) <= 5 + 1
    assert not multiprocessing.active_children()


SLEEPER = """
import os, time
from data_gen.make.workers import run_tasks

def sleep(state, task):
    os.write(1, b"begun\\n")  # at once: both tasks write to the same pipe
    time.sleep(60)

if __name__ == "__main__":
    list(run_tasks(sleep, "", [1, 2], 2))
"""


@pytest.mark.ci
def test_no_worker_outlives_a_parent_that_is_killed(tmp_path):
    """Of one that is interrupted, as a terminal does it: test_same_bytes.py."""
    script = tmp_path / "sleeper.py"
    script.write_text(SLEEPER)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, env=environment)
    assert [parent.stdout.readline() for _ in range(2)] == [b"begun\n"] * 2
    start = time.monotonic()
    parent.kill()
    parent.communicate(timeout=20)  # both workers have closed their end
    assert time.monotonic() - start < 10
