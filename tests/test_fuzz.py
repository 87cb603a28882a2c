"""Damaged files are read or refused, whatever the damage: a share of what experiments/fuzz.py tries, and its watch."""

import ast
import json
import os
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments import fuzz, fuzz_mutations, fuzz_report
from experiments.fuzz_readers import READERS
from experiments.fuzz_worker import DECOY, attempt, make_input, write_input
from spnr_jax.config import from_dict, to_dict
from spnr_jax.presets import tiny
from spnr_jax.viewer import session, viewpoint

ROOT = Path(__file__).parents[1]
INPUTS = 16  # of each reader; number 0 is a valid file
SOURCES = sorted(path for folder in ("spnr_jax", "data_gen", "experiments") for path in (ROOT / folder).rglob("*.py"))
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.parametrize("name", [name for name in READERS if name != "lpips"])
def test_damaged_files_are_read_or_refused_with_one_line_and_nothing_else_is_touched(name, tmp_path, monkeypatch):
    folder = tmp_path / "input"
    folder.mkdir()
    (tmp_path / DECOY).write_bytes(b"nobody reads this")
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    seeds, there, outcomes = READERS[name].seeds(), {}, []
    for number in range(INPUTS):
        opened, files = make_input(seeds, 0, name, number)
        write_input(folder, files, there)
        there = files
        outcome, _, reason = attempt(READERS[name], folder, opened)
        assert outcome != "failed", f"input {number}: {reason}"
        outcomes.append(outcome)
    assert outcomes[0] == "read"
    assert name == "metrics" or "refused" in outcomes


def test_the_same_seed_makes_the_same_damage_and_another_seed_another():
    seeds = READERS["obj"].seeds()
    assert make_input(seeds, 0, "obj", 5) == make_input(seeds, 0, "obj", 5)
    assert make_input(seeds, 0, "obj", 5) != make_input(seeds, 1, "obj", 5)


@pytest.mark.parametrize("name", ["glb", "npz", "npy", "obj", "packed"])
def test_containers_are_closed_as_they_were_opened(name):
    openers = (fuzz_mutations.open_glb, fuzz_mutations.open_zip, fuzz_mutations.open_npy, fuzz_mutations.open_png)
    opened = 0
    for files in READERS[name].seeds():
        for content in files.values():
            for opener in (*openers, fuzz_mutations.open_map):
                if (found := opener(content)) is not None:
                    parts, close = found
                    again = opener(close(parts))
                    assert again is not None
                    assert again[0] == parts
                    opened += 1
    assert opened


# The process that reads


def run_fakes(folder: Path, name: str, inputs: int = 4) -> fuzz.Result:
    options = fuzz.Fuzz(out=folder, inputs=inputs, reader=(name,), module="fuzz_fakes")
    fuzz.finish(options, name, fuzz.load(options, name))
    return fuzz.load(options, name)


@pytest.fixture
def fakes(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", f"{ROOT / 'tests'}{os.pathsep}{ROOT}")
    monkeypatch.setattr(fuzz, "SECONDS", 1.0)
    monkeypatch.setattr(fuzz, "GRACE", 0.5)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("crash", "the process ended with -6"), ("hang", "silent for 2 seconds"), ("memory", "MemoryError"),
        ("traceback", "KeyError: 'a'"), ("write", "writes .*outside"), ("peek", f"reads .*{DECOY}"),
        ("program", "subprocess.Popen"), ("pickle", "pickle.find_class"), ("warn", "warns: UserWarning"),
    ],
)  # fmt: skip
def test_whatever_an_input_does_to_its_process_is_seen_kept_and_the_run_goes_on(name, reason, tmp_path, fakes):
    result = run_fakes(tmp_path, name)
    assert (result.done, result.failed, result.refused, result.read) == (4, 1, 1, 2)
    (kept,) = (tmp_path / "failures").iterdir()
    assert kept.name == f"{name}-2"
    assert (kept / "input" / "a.txt").is_file()
    said = (kept / "reason.txt").read_text()
    assert re.search(reason, said), said


def test_a_stopped_run_goes_on_and_another_seed_is_refused(tmp_path, fakes):
    assert run_fakes(tmp_path, "traceback", inputs=3).failed == 1
    again = run_fakes(tmp_path, "traceback")  # a new process, which begins behind the failure
    assert (again.done, again.failed) == (4, 1)
    with pytest.raises(ValueError, match="seed 0, --seed is 1"):
        fuzz.load(fuzz.Fuzz(out=tmp_path, seed=1), "traceback")


def test_the_table_has_a_row_a_reader_and_their_sum():
    results = [fuzz.Result(name=name, seed=0, done=10, read=4, refused=6, peak_mb=5.0) for name in "ab"]
    lines = fuzz_report.table(results).splitlines()
    assert lines[2].startswith("| a | 10 | 4 | 6 | 0 |")
    assert lines[-1].startswith("| 2 readers | 20 | 8 | 12 | 0 |")
    assert fuzz_report.plot(results).startswith(b"\x89PNG")


# Code in files


def calls(path: Path) -> list[tuple[str, ast.Call]]:
    """(dotted name, call) of every call in a file."""
    return [
        (ast.unparse(node.func), node) for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)
    ]


def keyword(call: ast.Call, name: str):
    return next((ast.literal_eval(k.value) for k in call.keywords if k.arg == name), None)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: "/".join(path.relative_to(ROOT).parts))
def test_no_source_runs_code_that_a_file_may_hold(path):
    for name, call in calls(path):
        last = name.rsplit(".", 1)[-1]
        where = f"{path.name}:{call.lineno} {name}"
        assert name not in ("eval", "exec", "__import__"), where
        assert last not in ("Unpickler", "loads") or name == "json.loads", where
        assert not name.startswith(("pickle.", "cloudpickle.", "dill.", "shelve.", "marshal.")), where
        assert not (last == "load" and name.startswith("yaml")), where
        assert keyword(call, "allow_pickle") in (None, False), where
        if name in ("np.load", "numpy.load", "np.lib.format.read_array"):
            assert keyword(call, "allow_pickle") is False, where
        if name == "torch.load":
            assert keyword(call, "weights_only") is True, where


# Values of any kind


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.sampled_from(sorted(to_dict(tiny())["model"])), json_values)
def test_any_value_of_a_config_makes_a_config_of_right_types_or_a_valueerror(name, value):
    values = json.loads(json.dumps(to_dict(tiny())))
    before = values["model"][name]
    values["model"][name] = value
    try:
        config = from_dict(values)
    except (ValueError, TypeError, AttributeError):  # what read_config turns into one line
        return
    hash(config)
    if isinstance(before, int) and not isinstance(before, bool):
        assert isinstance(value, int)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(json_values, json_values, json_values)
def test_a_camera_message_of_any_values_is_a_view_or_none(wxyz, position, number):
    assert viewpoint.from_browser(wxyz, position, number, number, number) is None or np.isfinite(position).all()
    assert viewpoint.from_browser([1, 0, 0, 0], position, 0.5, 10, 10) is None or np.isfinite(position).all()
    assert session.numbers(wxyz, 2) is None or np.isfinite(wxyz).all()
