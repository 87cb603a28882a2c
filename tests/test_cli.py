"""`spnr`: what a person can mend is one line on stderr and exit code 2, never a traceback; help costs no JAX."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from support import command_line, tiny_dataset, tiny_untrained

import spnr_jax
from spnr_jax import cli, presets
from spnr_jax.kernels.records import Volume
from spnr_jax.method.model import Model
from spnr_jax.surfels.sides import spiral
from spnr_jax.tools import pictures

exit_code = partial(command_line.exit_code, cli)


@pytest.fixture(autouse=True)
def shrunken(monkeypatch):
    """The preset `tiny` is the tests' network."""
    monkeypatch.setitem(presets.PRESETS, "tiny", lambda: tiny_untrained.CONFIG)


@pytest.fixture
def data():
    return tiny_dataset.dataset().folder


@pytest.fixture
def run():
    return tiny_untrained.run()


FILES = {
    "empty.ply": b"",
    "point.xyz": b"1 2 3\n",
    "three.xyz": b"1 2 3\n2 2 3\n1 3 3\n",
    "ball.xyz": "\n".join(f"{x} {y} {z}" for x, y, z in spiral(2000)).encode(),
}
TRAIN, BASELINES, LIT = "train data new", "--methods experiments.baselines --preset", "render missing.ply"
UNLIT = f"{LIT} --run RUN"
REFUSED = [  # command, what its line says
    (f"{TRAIN} --num-step 3", "Perhaps you meant: --num-steps"),
    ("train", "Folder of the data set"),
    ("fly", "train, evaluate, render"),
    ("render a.ply --run r --views many", "--views"),
    (f"{TRAIN} --preset tny", "--preset tny: there are abo, "),
    (f"{TRAIN} --preset", "--preset needs a value"),
    (f"{TRAIN} --methods", "--methods needs a value"),
    (f"{TRAIN} {BASELINES} npbg_tiny --radius 0.2", "--radius"),
    (f"{TRAIN} --volume-resolution 9", "volume_resolution 9 cannot be halved 1 times; use a multiple of 2"),
    ("train missing new", "run `spnr-data generate missing`"),
    ("evaluate missing RUN", "spnr-data generate"),
    ("evaluate UNTESTED RUN", "the test split is empty; score --split train, or generate the data set anew"),
    ("evaluate DATA .", "not a run folder (config.json is missing); train one with `spnr train DATA"),
    ("evaluate DATA DATA", "a data set, where a run folder is expected"),
    ("train DATA DATA", "a data set, where a run folder is expected"),
    ("render empty.ply --run RUN", "empty.ply: the file is empty"),
    ("render point.xyz --run RUN", "holds 1 point in 1 place: no object can be drawn"),
    ("render three.xyz --run RUN --out point.xyz", "point.xyz is a file, not a folder"),
    ("render a.ply b.ply b/a.xyz", "two clouds have one name"),
    ("render . --run RUN", ".: a folder; expected a file of one of"),
    (f"{LIT} --elevation 91", "--elevation: expected -90 to 90, got 91"),
    (f"{LIT} --views -1", "--views: expected 0 or more, got -1"),
    (f"{LIT} --num-points 0", "--num-points: expected 1 or more, got 0"),
    (f"{LIT} --resolution 18", "--resolution must be a multiple of 4 from 16 to 16384, got 18"),
    (f"{LIT} --resolution 100000000", "--resolution must be a multiple of 4 from 16 to 16384, got 1"),
    (f"{LIT} --sun 0 9 --light-yaw 9", "--light-yaw turns the map of --light, which is not given"),
    (f"{LIT} --light ''", "--light: empty"),
    (f"{LIT} --fps 60", "--fps: a .gif shows at most 50 frames a second"),
    (f"{LIT} --seed -1", "seed must be a whole number of at least 0, got -1"),
    ("share ball.xyz --azimuth nan", "--azimuth must be a number of degrees, got nan"),
    (f"{LIT} --clean very", "--clean"),
    ("render ball.xyz --crop -7 -7e-1 -.5 -6 8 8", "none of the 2,000 points, they lie in the box"),
    ("render ball.xyz --object 2", "--object 2: there is 1 cluster"),
    ("render ball.xyz --crop 0 1", "--crop"),
    (f"{LIT} --sun 30 95", "--sun: expected an azimuth and an elevation of -90 to 90 degrees"),
    (f"{LIT} --light-yaw inf", "--light-yaw must be a number of degrees"),
    (f"{LIT} --exposure 21", "--exposure: expected -20 to 20, got 21"),
    (f"{LIT} --light absent.hdr", "absent.hdr: no such file"),
    (f"{LIT} --transparent --background light", "--background light: not together with --transparent"),
    (f"{UNLIT} --light studio", "--light: the network of --run RUN knows the light of its training"),
    (f"{UNLIT} --turn light", "--turn: the network of --run RUN knows the light"),
    (f"{UNLIT} --exposure 1 --sun 0 9", "--sun, --exposure: the network of --run RUN"),
    ("export ball.xyz --splats out.obj", "out.obj"),
    ("export a.ply --splats ./a.ply", "a.ply: the cloud itself; choose another file for its splats"),
    ("export ball.xyz --splats out.ply --most-splats 300001", "--most-splats"),
    ("export ball.xyz", "a file; expected a run folder, or of a cloud `spnr export ball.xyz --splats"),
    ("render ball.xyz --sun 40", "see spnr render --help"),
    ("render ball.xyz --resolution 63.5", "--resolution: expected INT, got '63.5'."),
    (
        "evaluate UNTESTED ball.xyz",
        "ball.xyz: a file; expected a run folder, a file of weights (.npz) or the name surfels",
    ),
    ("evaluate UNTESTED RUN --split train --out ball.xyz", "ball.xyz is a file, not a folder; choose another place"),
    ("export RUN --light studio", "--light is for --splats"),
    ("export RUN --fitting-views 8", "--fitting-views is for --splats"),
    ("export RUN --up z", "--up is for --splats"),
    ("export ball.xyz --splats out.ply --out x", "--out is not for --splats"),
    (f"{LIT} --views 0 --turntable none", "--views 0 --turntable none: nothing is left to draw"),
    (f"{LIT} --outputs", "--outputs"),
    ("train LIT new --preset tiny", "preset tiny learns one light alone; train --preset surfels"),
    ("export nowhere.ply --splats out.ply", "nowhere.ply"),
    ("export RUN", "a network of method paper cannot be exported; only surfels can"),
    ("share ball.xyz --out ball.xyz/page.html", "a file, not a folder"),
    ("share ball.xyz --out page.pdf", "page.pdf"),
    ("share ball.xyz --background light", "--background"),
    ("share ball.xyz --fitting-views 1", "--fitting-views"),
    *((f"view a.ply --reached-at {place}", "--reached-at") for place in ("http://a.b", "''", "u@a", "a.b:99999")),
]


@pytest.mark.parametrize(("command", "expected"), REFUSED, ids=[f"{i} {row[0]}" for i, row in enumerate(REFUSED)])
def test_what_cannot_be_done_is_one_line_and_code_2_and_writes_nothing(
    command, expected, tmp_path, monkeypatch, capsys, data, run
):
    for name in command.split():
        if name in FILES:
            (tmp_path / name).write_bytes(FILES[name])
    if "UNTESTED" in command:
        tiny_dataset.write_dataset(tmp_path / "UNTESTED", {"train": tiny_dataset.NAMES, "val": (), "test": ()})
    if "LIT" in command.split():
        folder = tiny_dataset.write_dataset(tmp_path / "LIT", {"train": tiny_dataset.NAMES, "val": (), "test": ()})
        settings = json.loads((folder / "dataset.json").read_text()) | {"environment_map": {"kinds": []}}
        (folder / "dataset.json").write_text(json.dumps(settings))
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    places = {"RUN": run, "DATA": data, "''": ""}
    assert exit_code(*(places.get(word, word) for word in command.split())) == 2
    *notes, line = capsys.readouterr().err.splitlines()  # on what is assumed about a cloud
    assert all(".xyz: " in note for note in notes)
    assert line.startswith("spnr: ")
    assert expected.replace("RUN", str(run)) in line
    assert not {"Traceback", "tyro", *(["missing.ply"] if command.startswith(LIT) else [])} & set(line.split())
    assert sorted(tmp_path.rglob("*")) == before


SETTING_UP = """
import sys
import jax
from spnr_jax import cli; from spnr_jax.devices import runtime
runtime.call_libc = lambda name, *_: print(name, end=" ")
cli.RUN = dict.fromkeys(cli.RUN, lambda command: None)
for line in sys.argv[1:]:
    jax.config.update("jax_cpu_enable_async_dispatch", True)
    cli.run(cli.parse(line.split()))
    print(jax.config.values["jax_cpu_enable_async_dispatch"], jax.config.values["jax_compilation_cache_dir"])
"""


@pytest.mark.parametrize(("variable", "below"), [("HOME", ".cache/spnr_jax"), ("XDG_CACHE_HOME", "spnr_jax")])
def test_memory_is_kept_where_work_repeats_itself_and_compilations_always(tmp_path, variable, below):
    others = ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME")
    said = subprocess.check_output(
        [sys.executable, "-c", SETTING_UP, "view x.ply", "render x.ply", "evaluate a b"],
        env={k: v for k, v in os.environ.items() if k not in others} | {variable: str(tmp_path)},
        text=True,
    )
    cache = tmp_path / below
    kept = f"mallopt mallopt False {cache}"
    assert said.splitlines() == [f"True {cache}", kept, kept]


@pytest.mark.parametrize("form", [["--preset", "small"], ["--preset=small"]])
def test_a_preset_gives_the_defaults_and_options_change_them(form):
    command = cli.parse(["train", "data", "run", *form, "--num-steps", "7", "--field-width", "12"])
    small = presets.small()
    expected = dataclasses.replace(small, num_steps=7, model=dataclasses.replace(small.model, field_width=12))
    assert command.config == expected


def test_the_preset_chooses_the_network_whose_options_there_are():
    command = cli.parse([*f"{TRAIN} {BASELINES} point_nerf_tiny".split(), "--radius", "0.2"])
    tiny = presets.PRESETS["point_nerf_tiny"]()
    assert command.config == dataclasses.replace(tiny, model=dataclasses.replace(tiny.model, radius=0.2))


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--version"])
    assert not stop.value.code
    assert capsys.readouterr().out.startswith(f"spnr_jax {spnr_jax.__version__}, jax ")


def test_help_explains_the_fields_of_a_config_and_loads_nothing_heavy():
    program = (
        "import sys; from spnr_jax.cli import main\n"
        "try: main(['train', '--help'])\n"
        "except SystemExit: print(*(m for m in sys.modules if '.' not in m), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(done.stderr.split())
    assert "tyro" in loaded
    assert not loaded & {"jax", "flax", "orbax", "matplotlib", "mitsuba", "trimesh", "torch", "tensorboardX", "numpy"}
    assert "--volume-resolution" in done.stdout


@pytest.mark.parametrize(
    ("line", "package", "extra"),
    [
        ("view a.ply", "viser", "viewer"),
        ("train data run", "tensorboardX", "train"),
        ("evaluate data run", "flip_evaluator", "train"),
    ],
)
def test_a_command_without_its_package_says_in_one_line_what_to_install(capsys, monkeypatch, line, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    assert exit_code(*line.split()) == 2
    needs = f"needs the package {package.replace('_', '-')}; pip install 'spnr-jax[{extra}]'"
    assert capsys.readouterr().err == f"spnr: spnr {line.split()[0]} {needs}\n"


def test_clouds_of_three_points_render_and_one_that_cannot_be_is_named_and_left_out(capsys, tmp_path, run):
    clouds, out = [tmp_path / name for name in ("one.xyz", "bad.xyz", "two.xyz")], tmp_path / "out"
    for cloud, name in zip(clouds, ("three.xyz", "point.xyz", "three.xyz"), strict=True):
        cloud.write_bytes(FILES[name])
    arguments = ("--run", run, "--out", out, "--views", 1, "--frames", 2, "--resolution", 24)
    assert exit_code("render", clouds[0], clouds[2], *arguments, "--turntable", "none") == 0
    assert {"one_000.png", "two_000.png"} <= {path.name for path in out.iterdir()}
    shutil.rmtree(out)
    assert exit_code("render", *clouds[:2], *arguments) == 2
    assert {path.name for path in out.iterdir()} == {
        "one_000.png", "one_000_depth.png", "one_000_depth.npy", "one_000_opacity.png", "one_turntable.gif",
        "one_cameras.json",
    }  # fmt: skip
    captured = capsys.readouterr()
    assert f"wrote {out / 'one_turntable.gif'}" in captured.out
    for name in ("base_color", "roughness", "metallic"):
        assert f"one.xyz: no {name} in the file" in captured.err
    left_out, last = captured.err.splitlines()[-2:]
    assert left_out.startswith(f"left out {clouds[1]}: ")
    assert last == "spnr: 1 of 2 clouds cannot be drawn"


def test_a_cloud_gets_learned_points_unless_they_are_declined(tmp_path, monkeypatch, run):
    asked, volume = [], Volume(scene=None, centre=np.zeros(3, np.float32), scale=np.ones((), np.float32))
    monkeypatch.setattr(Model, "encode", lambda model, cloud, densify: asked.append(densify) or volume)
    monkeypatch.setattr(pictures, "draw_all", lambda *_: iter([]))
    (tmp_path / "ball.xyz").write_bytes(FILES["ball.xyz"])
    for option in ((), ("--no-densify",)):
        assert exit_code("render", tmp_path / "ball.xyz", "--run", run, "--out", tmp_path, *option) == 0
    assert asked == [True, False]


@pytest.mark.ci
def test_train_evaluate_and_render_write_a_run_its_scores_and_a_picture(capsys, tmp_path, data):
    run = tmp_path / "run"
    assert exit_code("train", data, run, "--log-every", 2, "--checkpoint-every", 4) == 0
    assert f"spnr evaluate {data} {run}" in capsys.readouterr().out
    assert exit_code("evaluate", data, run, "--gallery", 1, "--out", tmp_path / "scores") == 0
    np.savetxt(tmp_path / "one.xyz", np.eye(4)[:, :3])
    arguments = ("--run", run, "--out", tmp_path, "--views", 1, "--turntable", "none", "--resolution", 24)
    assert exit_code("render", tmp_path / "one.xyz", *arguments) == 0
    assert "3 objects of the test split\n" in capsys.readouterr().out
    assert (tmp_path / "one_000.png").is_file()
    metrics = json.loads((tmp_path / "scores" / "metrics.json").read_text())
    assert set(metrics["seconds"]) == {"evaluate", "total"}
    assert metrics["methods"]["paper"]["objects"] == len(tiny_dataset.SPLITS["test"])
    assert (tmp_path / "scores" / "report.html").is_file()


def test_an_error_shows_its_call_stack_for_debug_alone_and_its_line_in_any_case(capsys, monkeypatch):
    monkeypatch.delenv("SPNR_DEBUG", raising=False)
    for option, variable, shown in (("--debug", "", True), ("", "", False), ("", "1", True), ("", "0", False)):
        monkeypatch.setenv("SPNR_DEBUG", variable)
        assert exit_code("render", "absent.ply", *option.split()) == 2
        said = capsys.readouterr().err.splitlines()
        assert ("Traceback" in said[0], len(said) > 1) == (shown, shown)
        assert said[-1].startswith("spnr: absent.ply")


def test_output_that_nothing_reads_is_one_line_and_no_call_stack():
    read, write = os.pipe()
    os.close(read)
    try:
        program = [sys.executable, "-m", "spnr_jax.cli", "train", "--help"]
        ended = subprocess.run(program, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    finally:
        os.close(write)
    assert ended.returncode == 2
    assert ended.stderr.endswith("stopped, as what read the output was closed\n")
    assert len(ended.stderr.splitlines()) == 1
