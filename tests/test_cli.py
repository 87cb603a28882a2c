"""`spnr`: what a person can mend is one line on stderr and exit code 2, never a traceback; help costs no JAX."""

import dataclasses
import functools
import json
import os
import signal
import subprocess
import sys

import pytest
from support import command_line, tiny_dataset, tiny_untrained

from spnr_jax import errors, presets

cli = command_line.unchecked_cli()


@pytest.fixture(autouse=True)
def shrunken(monkeypatch):
    """The preset `tiny` is the tests' network, and nothing is written to the home folder."""
    monkeypatch.setitem(presets.PRESETS, "tiny", lambda: tiny_untrained.CONFIG)
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)


SETTING_UP = """
import sys
import jax
from spnr_jax import cli; from spnr_jax.devices import runtime as memory
memory.keep = lambda: print("kept", end=" ")
cli.run_render = cli.run_evaluate = lambda command: None
for line in sys.argv[1:]:
    jax.config.update("jax_cpu_enable_async_dispatch", True)
    cli.run(cli.parse(line.split()))
    print(jax.config.values["jax_cpu_enable_async_dispatch"], jax.config.values["jax_compilation_cache_dir"])
"""


@pytest.mark.parametrize(("variable", "below"), [("HOME", ".cache/spnr_jax"), ("XDG_CACHE_HOME", "spnr_jax")])
def test_memory_is_kept_where_work_repeats_itself_and_compilations_always(tmp_path, variable, below):
    others = ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME")
    done = subprocess.run(
        [sys.executable, "-c", SETTING_UP, "render x.ply --turntable none", "render x.ply", "evaluate a b"],
        env={k: v for k, v in os.environ.items() if k not in others} | {variable: str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    cache = tmp_path / below
    assert done.stdout.splitlines() == [f"True {cache}", f"kept False {cache}", f"kept False {cache}"]


exit_code = functools.partial(command_line.exit_code, cli)


def refused(capsys, *arguments):
    """The one line of a refused command."""
    capsys.readouterr()
    assert exit_code(*arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("spnr: ")
    assert "Traceback" not in lines[0]
    return lines[0]


@pytest.fixture
def data():
    return tiny_dataset.dataset().folder


@pytest.fixture
def run():
    return tiny_untrained.run()


def test_an_unknown_option_is_refused_with_the_nearest_name(capsys):
    line = refused(capsys, "train", "data", "run", "--num-step", "3")
    assert "--num-step, 3" in line
    assert "Perhaps you meant: --num-steps" in line


def test_a_missing_argument_an_unknown_command_and_a_word_for_a_number_are_refused(capsys):
    assert "Folder of the data set" in refused(capsys, "train")
    assert "train, evaluate, render" in refused(capsys, "fly")
    assert "--views" in refused(capsys, "render", "a.ply", "--run", "r", "--views", "many")


@pytest.mark.parametrize("form", [["--preset", "tny"], ["--preset=tny"], ["--preset"]])
def test_an_unknown_preset_names_the_presets(form, capsys):
    line = refused(capsys, "train", "data", "run", *form)
    assert all(name in line for name in presets.PRESETS)


@pytest.mark.parametrize("form", [["--preset", "small"], ["--preset=small"]])
def test_a_preset_gives_the_defaults_and_options_change_them(form):
    command = cli.parse(["train", "data", "run", *form, "--num-steps", "7", "--field-width", "12"])
    small = presets.small()
    expected = dataclasses.replace(small, num_steps=7, model=dataclasses.replace(small.model, field_width=12))
    assert command.config == expected


def test_the_preset_chooses_the_network_whose_options_there_are(capsys):
    form = ("train", "data", "run", "--methods", "experiments.baselines", "--preset")
    command = cli.parse([*form, "point_nerf_tiny", "--radius", "0.2"])
    tiny = presets.PRESETS["point_nerf_tiny"]()
    assert command.config == dataclasses.replace(tiny, model=dataclasses.replace(tiny.model, radius=0.2))
    assert "--radius" in refused(capsys, *form, "npbg_tiny", "--radius", "0.2")


def test_a_resolution_that_the_unet_cannot_divide_is_refused(capsys):
    line = refused(capsys, "train", "data", "run", "--volume-resolution", "9")
    assert "volume_resolution 9 cannot be halved 1 times; use a multiple of 2" in line
    assert "tyro" not in line


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            "train",
            ["Optimiser steps", "Voxels along each axis", "L1 between image", "Peak learning rate"],
        ),
        ("evaluate", ["Objects to score", "Folder of the run"]),
        ("render", ["Degrees above the horizon", "Frames of the turntable", "upward axis"]),
    ],
)
def test_the_help_of_each_command_explains_its_fields(command, words, capsys):
    assert exit_code(command, "--help") == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert all(word in text for word in words)


def test_help_loads_nothing_heavy():
    program = (
        "import sys; from spnr_jax.cli import main\n"
        "try: main(['train', '--help'])\n"
        "except SystemExit: print(*(m for m in sys.modules if '.' not in m), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(done.stderr.split())
    assert "tyro" in loaded
    assert not loaded & {"jax", "flax", "orbax", "matplotlib", "mitsuba", "trimesh", "torch", "tensorboardX", "numpy"}


def test_a_missing_data_folder_is_refused(capsys, tmp_path, run):
    missing = tmp_path / "nothing"
    for arguments in (("train", missing, tmp_path / "run"), ("evaluate", missing, run)):
        line = refused(capsys, *arguments)
        assert str(missing) in line
        assert "spnr-data generate" in line
    assert not (tmp_path / "run").exists()


def test_an_empty_test_split_is_refused_with_both_ways_out(capsys, tmp_path, run):
    data = tiny_dataset.write_dataset(tmp_path / "data", {"train": tiny_dataset.NAMES, "val": (), "test": ()})
    line = refused(capsys, "evaluate", data, run)
    assert "the test split is empty" in line
    assert "--split train" in line
    assert "--test-objects" in line
    assert not (run / "report.html").exists()


def test_a_run_folder_that_is_none_is_refused(capsys, data, tmp_path):
    (tmp_path / "one.xyz").write_text("0 0 0\n")
    for arguments in (("evaluate", data, tmp_path), ("render", tmp_path / "one.xyz", "--run", tmp_path)):
        assert "not a run folder" in refused(capsys, *arguments)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("empty.ply", b"", "empty"),
        ("no_points.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
         b"property float z\nend_header\n", "0 points"),
        ("nan.xyz", b"nan 0 0\nnan 1 1\n", "NaN"),
        ("noise.glb", b"\x00\x01\x02", "noise.glb"),
        ("noise.npz", b"PK\x03\x04 no zip", "noise.npz"),
        ("words.xyz", b"a cloud\nof words\n", "words.xyz"),
        ("cloud.doc", b"0 0 0\n", "unknown kind"),
    ],
)  # fmt: skip
def test_a_cloud_that_cannot_be_rendered_is_refused(name, content, reason, capsys, tmp_path, run):
    (tmp_path / name).write_bytes(content)
    line = refused(capsys, "render", tmp_path / name, "--run", run, "--out", tmp_path / "out")
    assert reason in line
    assert name in line
    assert not (tmp_path / "out").exists()


def test_an_output_folder_that_is_a_file_is_refused(capsys, tmp_path, run):
    (tmp_path / "one.xyz").write_text("0 0 0\n")
    (tmp_path / "taken").write_text("")
    line = refused(capsys, "render", tmp_path / "one.xyz", "--run", run, "--out", tmp_path / "taken")
    assert str(tmp_path / "taken") in line


def test_a_cloud_of_three_points_renders_and_one_of_one_point_is_refused(capsys, tmp_path, run):
    (tmp_path / "point.xyz").write_text("1 2 3\n")
    assert exit_code("render", tmp_path / "point.xyz", "--run", run, "--out", tmp_path / "none") == 2
    assert "holds 1 points in 1 place: no object can be drawn" in capsys.readouterr().err
    (tmp_path / "one.xyz").write_text("1 2 3\n2 2 3\n1 3 3\n")
    out = tmp_path / "out"
    arguments = ("--run", run, "--out", out, "--views", 1, "--frames", 2, "--resolution", 24)
    assert exit_code("render", tmp_path / "one.xyz", *arguments) == 0
    assert {path.name for path in out.iterdir()} == {
        "one_000.png", "one_000_depth.png", "one_000_depth.npy", "one_000_depth_16bit.png", "one_000_opacity.png",
        "one_turntable.gif", "one_cameras.json",
    }  # fmt: skip
    captured = capsys.readouterr()
    assert f"wrote {out / 'one_turntable.gif'}" in captured.out
    for name in ("base_color", "roughness", "metallic"):
        assert f"one.xyz: no {name} in the file" in captured.err


def test_train_evaluate_and_render_write_a_run_its_scores_and_a_picture_of_the_newest_whole_checkpoint(
    capsys, tmp_path, data
):
    run = tmp_path / "run"
    assert exit_code("train", data, run, "--log-every", 2, "--checkpoint-every", 4) == 0
    assert f"spnr evaluate {data} {run}" in capsys.readouterr().out
    assert exit_code("evaluate", data, run, "--gallery", 1, "--out", tmp_path / "scores") == 0
    for path in (run / "checkpoints" / "6").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    (tmp_path / "one.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n0 0 1\n")
    arguments = ("--run", run, "--out", tmp_path, "--views", 1, "--turntable", "none", "--resolution", 24)
    assert exit_code("render", tmp_path / "one.xyz", *arguments) == 0
    captured = capsys.readouterr()
    assert "3 objects of the test split, unseen in training\n" in captured.out
    assert "trying the one before" in captured.out + captured.err
    assert (tmp_path / "one_000.png").is_file()
    metrics = json.loads((tmp_path / "scores" / "metrics.json").read_text())
    assert set(metrics["seconds"]) == {"evaluate", "total"}
    assert metrics["methods"]["paper"]["objects"] == len(tiny_dataset.SPLITS["test"])
    assert (tmp_path / "scores" / "report.html").is_file()


def test_a_stop_is_exit_code_130_and_says_so(capsys):
    def stopped():
        raise KeyboardInterrupt

    assert cli.guarded(stopped, "spnr") == 130
    assert capsys.readouterr().err == "spnr: stopped\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_error_of_the_program_keeps_its_traceback():
    def broken():
        raise AssertionError("a bug")

    with pytest.raises(AssertionError, match="a bug"):
        cli.guarded(broken, "spnr")


def test_an_error_shows_its_call_stack_for_debug_alone_and_its_line_in_any_case(capsys, monkeypatch):
    def refused():
        raise errors.UserError("no such thing")

    for debug in (False, True):
        assert cli.guarded(refused, "spnr", debug) == 2
        said = capsys.readouterr().err
        assert ("in refused" in said) is debug
        assert said.endswith("spnr: no such thing\n")
    monkeypatch.delenv("SPNR_DEBUG", raising=False)
    assert exit_code("render", "absent.ply", "--debug") == 2
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert "absent.ply" in said.splitlines()[-1]
    assert exit_code("render", "absent.ply") == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    monkeypatch.setenv("SPNR_DEBUG", "1")
    assert exit_code("render", "absent.ply") == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["spnr_jax.cli train --help", "data_gen generate --help"])
def test_output_that_nothing_reads_is_one_line_and_no_call_stack(command):
    read, write = os.pipe()
    os.close(read)
    try:
        ended = subprocess.run(
            [sys.executable, "-m", *command.split()], stdout=write, stderr=subprocess.PIPE, text=True, check=False
        )
    finally:
        os.close(write)
    assert ended.returncode == 2
    assert ended.stderr.endswith("stopped, as what read the output was closed\n")
    assert len(ended.stderr.splitlines()) == 1


def test_errors_of_many_lines_become_one():
    assert errors.one_line(ValueError("this\n  and\nthat")) == "this and that"
    assert errors.one_line(OSError(28, "No space left on device")) == "disk: No space left on device"
    assert errors.one_line(OSError(13, "Permission denied", "a/b")) == "a/b: Permission denied"


@pytest.mark.parametrize("command", ["render", "view"])
def test_scans_are_cleaned_unless_it_is_said_otherwise(command, capsys):
    assert cli.parse([command, "a.ply"]).clean == "auto"
    for value in ("off", "strong"):
        assert cli.parse([command, "a.ply", "--clean", value]).clean == value
    assert "--clean" in refused(capsys, command, "a.ply", "--clean", "very")
