"""A bug of ours is told apart from a broken file, and a stop is obeyed whatever becomes of it."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spnr_jax import errors


def raised_in(module, code):
    """The error of a piece of code that stands in a module of this name."""
    with pytest.raises((NameError, AttributeError, ValueError)) as caught:
        exec(compile(code, module, "exec"), {"__name__": module, "json": json})
    return caught.value


@pytest.mark.parametrize(
    ("module", "code", "bug"),
    [
        ("spnr_jax.formats.row_files", "absent", True),
        ("data_gen.store.check", "def f():\n    print(x)\n    x = 1\nf()", True),
        ("spnr_jax.formats.row_files", "json.absent", True),
        ("spnr_jax.formats.row_files", "json.loads('[]').items()", False),  # the file holds a list
        ("spnr_jax.formats.row_files", "json.loads('{')", False),
        ("trimesh.exchange.ply", "absent", False),  # a library's way to say that a file is broken
        ("trimesh.exchange.ply", "json.absent", False),
    ],
)
def test_a_name_that_there_is_not_is_a_bug_in_our_code_alone(module, code, bug):
    assert errors.is_bug(raised_in(module, code)) is bug


def test_errors_of_many_lines_become_one():
    assert errors.one_line(ValueError("this\n  and\nthat")) == "this and that"
    assert errors.one_line(OSError(28, "No space left on device")) == "disk: No space left on device"
    assert errors.one_line(OSError(13, "Permission denied", "a/b")) == "a/b: Permission denied"


@pytest.mark.parametrize(("module", "words"), [(np, "Unable to allocate"), (jnp, "RESOURCE_EXHAUSTED")])
def test_a_want_of_memory_is_one_line(capsys, module, words):
    assert errors.guard(lambda: module.ones(2**46), "spnr") == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith(f"spnr: not enough memory ({words}")


def test_another_error_of_a_library_keeps_its_call_stack():
    removed = jnp.ones(2)
    removed.delete()
    with pytest.raises(RuntimeError, match="deleted"):
        errors.guard(lambda: jax.block_until_ready(removed), "spnr")


ODD_NAME = """
from spnr_jax import errors
name = b"caf\\xe9-\\xff.ply".decode("utf-8", "surrogateescape") + "\\u732b"
errors.guard(lambda: print(name), "spnr")
"""


def test_a_name_that_the_terminal_cannot_print_stops_nothing():
    ascii_only = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", ODD_NAME], env=ascii_only, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "caf\\udce9-\\udcff.ply\\u732b\n"


STOPPED = """
import gc, os, signal, sys, threading, time
from spnr_jax import errors

def interrupt(*_):
    os.kill(os.getpid(), signal.SIGINT)

def dropped():  # as JAX's callback of the garbage collector does
    gc.callbacks.append(interrupt)
    gc.collect()
    gc.callbacks.clear()
    time.sleep(20)

def caught():
    for _ in range(3):
        try:
            interrupt()
            time.sleep(20)
        except KeyboardInterrupt:
            pass
    time.sleep(20)

def changed():
    try:
        interrupt()
    except KeyboardInterrupt as stop:
        raise RuntimeError("INTERNAL: KeyboardInterrupt") from stop

def tidied():
    try:
        interrupt()
    finally:
        time.sleep(5 * errors.AGAIN)
        print("tidied")

def closed():
    def lines():
        try:
            yield
        finally:
            time.sleep(5 * errors.AGAIN)
            print("tidied")

    for _ in lines():
        interrupt()

def computing():  # Python's end waits for JAX, or crashes
    import jax, jax.numpy as jnp
    jax.jit(lambda x: jax.lax.fori_loop(0, 10**6, lambda i, y: jnp.tanh(y @ y), x))(jnp.ones((400, 400)))
    interrupt()

begin = time.monotonic()
code = errors.guard(globals()[sys.argv[1]], "spnr")
assert time.monotonic() - begin < 15
errors.leave(code)
"""


@pytest.mark.parametrize("way", ["dropped", "caught", "changed", "tidied", "closed", "computing"])
def test_a_stop_is_obeyed_whatever_becomes_of_it_on_its_way(way):
    done = subprocess.run([sys.executable, "-c", STOPPED, way], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (130, "spnr: stopped\n")
    assert done.stdout == ("tidied\n" if way in ("tidied", "closed") else "")


ENDING = """
import atexit, os, signal, time
from spnr_jax import errors
atexit.register(time.sleep, 20)
atexit.register(os.kill, os.getpid(), signal.SIGINT)
errors.leave(errors.guard(lambda: print("done"), "spnr"))
"""


def test_a_stop_after_the_work_is_done_ends_python_without_a_word():
    done = subprocess.run([sys.executable, "-c", ENDING], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def test_output_that_was_closed_before_the_start_is_no_error():
    program = "from spnr_jax import errors; errors.leave(errors.guard(lambda: print('done'), 'spnr'))"
    command = f'"{sys.executable}" -c "{program}" >&-'
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_stop_while_a_command_is_imported_is_one_line(tmp_path):
    (tmp_path / "slow.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nprint('imported')")
    program = (
        "import sys; from spnr_jax import errors; sys.path.append(sys.argv[1]); errors.start_command('slow', 'spnr')"
    )
    done = subprocess.run([sys.executable, "-c", program, tmp_path], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "spnr: stopped\n")
