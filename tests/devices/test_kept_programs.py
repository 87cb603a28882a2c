"""Programs on the disk: the same numbers without tracing, made again where anything they depend on is another."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spnr_jax.devices import kept_programs
from spnr_jax.devices.kept_programs import ENDING, kept

traced = []


def scaled(x, y, *, times):
    traced.append(times)
    return {"sum": times * (x + y["a"])}


@pytest.fixture
def program(tmp_path):
    """The function, jitted anew and kept in a folder; whoever asks again finds nothing in memory."""
    traced.clear()

    def again(folder=tmp_path):
        kept_programs.keep_in(folder)
        return kept(jax.jit(scaled, static_argnames="times"), static=("times",))

    yield again
    kept_programs.keep_in(None)


X = np.arange(6, dtype=np.float32).reshape(2, 3)


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"*{ENDING}"))


def test_a_second_process_gets_the_same_numbers_without_tracing(program, tmp_path):
    first = program()(X, {"a": X}, times=3)
    assert traced == [3]
    assert len(files(tmp_path)) == 1
    again = program()
    np.testing.assert_array_equal(again(X, {"a": X}, times=3)["sum"], first["sum"])
    np.testing.assert_array_equal(again(jnp.asarray(X), {"a": X}, times=3)["sum"], 6 * X)
    assert traced == [3]


@pytest.mark.parametrize(
    ("x", "times"),
    [(X, 2), (X[:1], 3), (X.astype(np.int32), 3), (1.0, 3)],
    ids=["static", "shape", "type", "weak type"],
)
def test_what_a_program_depends_on_tells_it_apart(program, tmp_path, x, times):
    program()(X, {"a": X}, times=3)
    drawn = program()
    with jax.numpy_rank_promotion("allow"):
        np.testing.assert_array_equal(drawn(x, {"a": x}, times=times)["sum"], times * (x + np.asarray(x)))
    assert len(files(tmp_path)) == 2
    np.testing.assert_array_equal(drawn(X, {"a": X}, times=3)["sum"], 6 * X)


def test_a_program_of_other_code_is_another(program, tmp_path, monkeypatch):
    program()(X, {"a": X}, times=3)
    monkeypatch.setattr(kept_programs, "_here", lambda: "another version")
    program()(X, {"a": X}, times=3)
    assert len(files(tmp_path)) == 2


@pytest.mark.parametrize("content", [b"", b"no program"])
def test_a_broken_file_is_made_again(program, tmp_path, content):
    first = program()(X, {"a": X}, times=3)
    (path,) = files(tmp_path)
    whole = path.read_bytes()
    for broken in (content, whole[: len(whole) // 2]):
        path.write_bytes(broken)
        np.testing.assert_array_equal(program()(X, {"a": X}, times=3)["sum"], first["sum"])
        assert path.stat().st_size > 1000
    assert len(list(tmp_path.iterdir())) == 1


def test_a_folder_that_cannot_be_made_costs_no_picture(program, tmp_path):
    (tmp_path / "file").write_text("")
    drawn = program(tmp_path / "file" / "folder")
    np.testing.assert_array_equal(drawn(X, {"a": X}, times=3)["sum"], 6 * X)


def test_a_program_that_cannot_be_written_down_is_run_all_the_same(program, tmp_path):
    def refuse(made):
        raise jax.errors.JaxRuntimeError("UNIMPLEMENTED")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kept_programs.serialize_executable, "serialize", refuse)
        np.testing.assert_array_equal(program()(X, {"a": X}, times=3)["sum"], 6 * X)
    assert not files(tmp_path)


def test_without_a_folder_or_within_another_program_nothing_is_kept(program, tmp_path):
    drawn = program()
    np.testing.assert_allclose(jax.grad(lambda x: drawn(x, {"a": x}, times=3)["sum"].sum())(X), 6)
    program(None)(X, {"a": X}, times=3)
    assert not files(tmp_path)


def test_the_oldest_programs_make_room(program, tmp_path, monkeypatch):
    monkeypatch.setattr(kept_programs, "MOST", 2)
    drawn = program()
    for times in range(4):
        drawn(X, {"a": X}, times=times)
    assert len(files(tmp_path)) == 2


CHILD = """
import sys, jax, numpy as np
from pathlib import Path
from spnr_jax.devices import kept_programs
kept_programs.keep_in(Path(sys.argv[1]))
jax.config.update("jax_compilation_cache_dir", sys.argv[1] + "/jax")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
def work(x):
    print("traced", end=" ")
    return np.float32(2) * x[::2].sum() + jax.numpy.sin(x)
if sys.argv[2] == "jax":  # whose cache has it then
    jax.jit(work)(np.arange(8.0, dtype=np.float32))
print(kept_programs.kept(jax.jit(work))(np.arange(8.0, dtype=np.float32)).tolist())
"""


def test_processes_share_programs_that_jax_has_in_its_own_cache(tmp_path):
    def child(mode: str) -> str:
        command = [sys.executable, "-c", CHILD, str(tmp_path), mode]
        return subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2]).stdout

    first, second = child("jax"), child("own")
    assert "traced" in first
    assert "traced" not in second
    assert first.split("traced")[-1].strip() == second.strip()
