"""Damaged files are read or refused with one line, whatever the damage; nothing else is touched.

    make fuzz              10,000 inputs for every reader, and a table    (FUZZ="-k glb")

An input is read (finite values of the right shapes and types) or refused as the commands print it with exit code 2.
Anything else fails: another exception, a warning, more than 10 seconds, more than a GiB of memory, a file outside its
folder, a program, a connection, a pickle.  Hypothesis draws the damage and shrinks what fails.
"""

import contextlib
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from damage import DECOY, Files, mutated
from file_readers import READERS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from watched import limited_memory, watched

from spnr_jax.errors import one_line

ROOT = Path(__file__).parents[2]
INPUTS = int(os.environ.get("FUZZ_INPUTS", "16"))  # of each reader
SECONDS = 10.0  # of the processor that an input may take
LONGEST_REASON = 1000  # characters of a line that a person should read
IN_CHILD = "FUZZ_CHILD" in os.environ


@pytest.fixture(scope="module")
def table():
    """Outcomes by reader, printed at the end."""
    rows: dict[str, Counter] = {}
    yield rows
    for name, row in rows.items():
        print(f"\n{name}: {row['read']} read, {row['refused']} refused, slowest {row['slowest']:.2f} s", end="")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where an input lies; a file that nobody may read lies beside it."""
    (tmp_path / DECOY).write_bytes(b"nobody reads this")
    (tmp_path / "input").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "input"))
    return tmp_path / "input"


def write_input(folder: Path, files: Files) -> None:
    """The folder with these files alone."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def attempt(read, folder: Path, main: str) -> str:
    """Whether the files in a folder were read or refused; AssertionError for anything else."""
    start = time.process_time()
    with (
        limited_memory(),
        watched(folder) as broken,
        warnings.catch_warnings(record=True) as said,
        contextlib.redirect_stdout(sys.stderr),
    ):
        warnings.simplefilter("always")
        try:
            read(folder, main)
            outcome, line = "read", "read"
            where = [f"{one.category.__name__} {one.message}, {one.filename}:{one.lineno}" for one in said]
            assert not said, f"warns: {where[0]}"
        except (ValueError, OSError) as error:  # what the commands turn into one line and exit code 2
            outcome, line = "refused", one_line(error)
        except BaseException as error:
            raise AssertionError(traceback.format_exc()[-6000:]) from error
    assert not broken, f"touches what is not its own: {broken}"
    assert 3 < len(line) <= LONGEST_REASON, line
    assert time.process_time() - start < SECONDS
    return outcome


def fuzzed(name: str, folder: Path) -> Counter:
    """Outcomes of all inputs of a reader."""
    (seeds_of, read), counts = READERS[name], Counter()
    seeds = seeds_of()
    for files in seeds:  # a valid file is read; and loads what is loaded on demand
        write_input(folder, files)
        read(folder, next(iter(files)))

    @settings(max_examples=INPUTS, deadline=None, derandomize=INPUTS == 16, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(range(len(seeds))), st.randoms(use_true_random=False))
    def law(number, rng):
        write_input(folder, mutated(seeds[number], rng))
        begin = time.perf_counter()
        counts[attempt(read, folder, next(iter(seeds[number])))] += 1
        counts["slowest"] = max(counts["slowest"], time.perf_counter() - begin)

    law()
    return counts


@pytest.mark.parametrize("name", [name for name in READERS if (name == "laz") == IN_CHILD])
def test_damaged_files_are_read_or_refused_with_one_line_and_nothing_else_is_touched(name, folder, table):
    table[name] = fuzzed(name, folder)
    assert name == "metrics" or table[name]["refused"]


@pytest.mark.ci
@pytest.mark.skipif(IN_CHILD, reason="this is the child")
def test_damaged_laz_files_end_no_process():
    """The library that unpacks .laz can abort its process: they are read in a child."""
    command = [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", __file__, "-k", "touched and laz"]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"FUZZ_CHILD": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    print("\n" + next(line for line in done.stdout.splitlines() if "laz: " in line), end="")


MISDEEDS = {
    "memory": (lambda folder: np.empty(2**32), "MemoryError"),
    "call stack": (lambda folder: {}["a"], "KeyError: 'a'"),
    "warning": (lambda folder: warnings.warn("a", stacklevel=1), "UserWarning"),
    "write": (lambda folder: (folder.parent / "outside").write_text("a"), "writes .*outside"),
    "peek": (lambda folder: (folder.parent / DECOY).read_bytes(), f"reads .*{DECOY}"),
    "program": (lambda folder: subprocess.run([sys.executable, "-c", ""], check=True), "subprocess.Popen"),
    "pickle": (lambda folder: pickle.loads(pickle.dumps(Path)), "pickle.find_class"),
}


@pytest.mark.parametrize("name", MISDEEDS)
def test_whatever_a_reader_does_that_it_must_not_is_seen(name, folder):
    misdeed, words = MISDEEDS[name]
    with pytest.raises(AssertionError, match=words):
        attempt(lambda place, main: misdeed(place), folder, "a")
