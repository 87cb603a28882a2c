"""What a process asks of its machine: threads, arenas that they share, memory that stays or goes back, programs."""

import ctypes
import os
import subprocess
import sys
import threading
from functools import partial
from types import SimpleNamespace

import pytest

from spnr_jax.devices import runtime
from spnr_jax.devices.runtime import run_ahead, two_at_a_time


def test_jobs_are_done_by_another_thread_in_their_order_few_ahead_of_the_caller():
    caller, made = threading.get_ident(), []

    def jobs():
        for i in range(20):
            made.append(i)
            yield partial(lambda i: (i, threading.get_ident() == caller), i)

    results = run_ahead(jobs(), most=3)
    assert next(results) == (0, False)
    assert made == [0, 1, 2, 3]
    assert list(results) == [(i, False) for i in range(1, 20)]


def test_an_error_of_a_job_or_of_their_maker_is_raised():
    def broken():
        yield int
        raise ValueError("this one")

    with pytest.raises(ValueError, match="this one"):
        list(run_ahead(broken()))
    with pytest.raises(ValueError, match="invalid literal"):
        list(run_ahead(iter([int, partial(int, "word"), int])))


def test_of_work_for_two_threads_the_first_is_done_alone_and_two_meet_at_most():
    both, running, most = threading.Barrier(2, timeout=10), [], []

    def work(i):
        running.append(i)
        most.append((i, len(running)))
        if i in (1, 2):
            both.wait()
        running.remove(i)
        return i

    assert list(two_at_a_time(work, range(6))) == list(range(6))
    assert most[0] == (0, 1)
    assert max(count for _, count in most) == 2
    assert list(two_at_a_time(int, [])) == []


def test_the_c_library_is_asked_to_keep_freed_memory_to_give_it_back_and_for_as_many_arenas_as_cores(monkeypatch):
    asked = []
    glibc = SimpleNamespace(
        malloc_trim=lambda *of: asked.append(("malloc_trim", *of)), mallopt=lambda *of: asked.append(("mallopt", *of))
    )
    monkeypatch.setattr(ctypes, "CDLL", lambda name: glibc if name == "libc.so.6" else None)
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    runtime.reuse_memory()
    runtime.limit_arenas()
    runtime.trim_memory()
    kept = [("mallopt", runtime.MMAP_MAX, 0), ("mallopt", runtime.TRIM_THRESHOLD, 2**31 - 1)]
    assert asked == [*kept, ("mallopt", runtime.ARENA_MAX, 3), ("malloc_trim", 0)]
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    runtime.limit_arenas()  # another C library is left alone


PROGRAM = """
import os, pathlib, sys
from spnr_jax.devices import runtime
os.environ["JAX_COMPILATION_CACHE_DIR"] = sys.argv[1]
seen = []
for cut in (True, False, False):
    runtime.cache_programs()
    import jax
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.clear_caches()
    assert jax.jit(lambda x: 2 * x)(1.0) == 2
    seen.append({entry.name: entry.read_bytes() for entry in pathlib.Path(sys.argv[1]).glob("*[0-9a-f]-cache")})
    for name, content in seen[-1].items() if cut else ():
        pathlib.Path(sys.argv[1], name).write_bytes(content[: len(content) // 2])
whole, mended, kept = seen
assert whole and whole.keys() == mended.keys() and mended == kept
assert all(len(mended[name]) > 0.9 * len(whole[name]) for name in whole)
"""


def test_a_cut_off_entry_is_made_anew_once_and_without_a_word(tmp_path):
    (tmp_path / "my-cache").write_text("not JAX's")
    command = [sys.executable, "-W", "error", "-c", PROGRAM, tmp_path]
    alone = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}  # JAX set it here
    done = subprocess.run(command, env=alone, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    assert (tmp_path / "my-cache").read_text() == "not JAX's"


UNCACHED = """
import numpy as np
from spnr_jax.devices.programs import CachedProgram
from spnr_jax.devices.runtime import cache_programs
cache_programs()
assert CachedProgram(lambda x: 2 * x)(np.ones(3))[0] == 2
"""


def test_an_empty_folder_of_the_cache_means_none_and_the_current_folder_is_left_alone(tmp_path):
    (tmp_path / "my-cache").write_text("mine")
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": ""}
    subprocess.run([sys.executable, "-c", UNCACHED], cwd=tmp_path, env=environment, check=True, timeout=120)
    assert [place.name for place in tmp_path.iterdir()] == ["my-cache"]
