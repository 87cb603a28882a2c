"""Damaged files are read or refused with one line, whatever the damage; nothing else is touched.

    make fuzz              10,000 inputs for every reader, and a table    (FUZZ="-k glb")

An input is read (finite values of the right shapes and types) or refused as the commands print it with exit code 2.
Anything else fails: another exception, a warning, more than 10 seconds, more than a GiB of memory, a file outside its
folder, a program, a connection, a pickle.  Hypothesis draws the damage and shrinks what fails.  A ZIP archive is
opened, one of its members damaged, and closed again with right checksums, so that the damage reaches what reads it.
"""

import contextlib
import io
import os
import pickle
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from pathlib import Path
from random import Random

import numpy as np
import pytest
from file_readers import READERS, Files
from hypothesis import HealthCheck, given, settings, strategies as st
from watched import limited_memory, watched

from spnr_jax.errors import one_line

ROOT = Path(__file__).parents[2]
INPUTS = int(os.environ.get("FUZZ_INPUTS", "16"))  # of each reader
SECONDS = 10.0  # of the processor that an input may take
LONGEST_REASON = 1000  # characters of a line that a person should read
IN_CHILD = "FUZZ_CHILD" in os.environ
DECOY = "secret.bin"  # lies beside the folder of an input; no reader may open it
WORDS = [
    *(f"../{DECOY}", f"a/../../{DECOY}", f"%2e%2e/{DECOY}", "/etc/passwd", "file:///etc/passwd", "http://localhost/a"),
    *("C:\\a", "\0", "..", "", "x" * 5000, "\U0001f600", "data:;base64,%%", "[" * 100_000, "null", "{}", "[]", '"a"'),
    *("0", "-1", "1", "255", "256", "65536", "2147483647", "-2147483648", "4294967295", "9223372036854775807", "1e308"),
    *("-1e308", "1e-320", "1e39", "nan", "inf", "-inf", "9" * 400, "9" * 5000, "0x10", "1_0", "1.5", "true"),
]
EXTREMES = [0, 1, -1, 127, 255, 32767, 65535, 2**31 - 1, 2**32 - 1, 2**63 - 1, -(2**31)]
FLOATS = [float("nan"), float("inf"), 1e38, -1.0]
HEADER = 400  # bytes in which half of the damage is done: that is where the counts are
TOKEN = re.compile(rb"[\w.+-]+")


def mutated(files: Files, rng: Random) -> Files:
    """The files with 1 to 4 pieces of damage, mostly in the first file; now and then one is missing."""
    damaged, names = dict(files), list(files)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        name = names[0] if rng.randrange(5) < 3 else rng.choice(names)
        if rng.randrange(32) == 13:
            damaged.pop(name, None)
        elif name in damaged:
            damaged[name] = damage(damaged[name], rng)
    return damaged


def damage(data: bytes, rng: Random) -> bytes:
    """The bytes damaged once: in a member of an archive, in a number or word of a text, or anywhere."""
    if data[:2] == b"PK" and rng.randrange(5) < 4:
        with contextlib.suppress(Exception):  # damaged before: there is nothing to open
            return _in_archive(data, rng)
    text = data[:HEADER].isascii() and rng.randrange(10) < 7
    place = rng.randrange(max(1, min(len(data), HEADER) if rng.randrange(2) else len(data)))
    if text and (token := TOKEN.search(data, place)):
        return data[: token.start()] + rng.choice(WORDS).encode() + data[token.end() :]
    size, kind = 2 ** rng.randrange(10), rng.randrange(6)
    if kind == 0:
        return data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)] if data else []) + data[place + 1 :]
    if kind == 1:
        return data[:place] + (b"" if rng.randrange(2) else data[place + size :])
    if kind == 2:  # a piece from elsewhere, or one byte, many times
        start = rng.randrange(max(1, len(data)))
        piece = data[start : start + size] if rng.randrange(2) else bytes([rng.randrange(256)])
        return data[:place] + piece * rng.choice((1, 2, 500)) + data[place:]
    order = rng.choice("<>")
    if kind == 3:
        new = struct.pack(order + rng.choice("fd"), rng.choice(FLOATS))
    else:
        code = rng.choice("BHIQ")
        new = struct.pack(order + code, rng.choice(EXTREMES) % 256 ** struct.calcsize(code))
    return data[:place] + new + data[place + len(new) :]


def _in_archive(data: bytes, rng: Random) -> bytes:
    """A ZIP archive with one member damaged."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name, stream = rng.choice(list(members)), io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, damage(content, rng) if member == name else content)
    return stream.getvalue()


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
