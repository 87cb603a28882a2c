"""Every experiment runs from its data to its tables in a tiny setting, and called again makes nothing anew."""

import dataclasses
import importlib
import json
import math
import re
import shutil
import sys
import typing
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from support import tiny_dataset, tiny_surfels
from support.tiny_baselines import SHRUNKEN, SIZE
from support.tiny_untrained import CONFIG as L1_ONLY

from data_gen.render import views
from data_gen.store import layout
from experiments import entry_point
from experiments.comparison import contenders, poisson
from experiments.comparison.variants import Budget
from experiments.packaged import demo, recipe
from experiments.paper import fig2, fig3, table1
from experiments.speed import bench
from experiments.studies import inverse, relighting, sharpness, speed_accuracy
from spnr_jax import presets
from spnr_jax.config import SurfelConfig
from spnr_jax.formats import data_sets
from spnr_jax.method import surfel_method
from spnr_jax.scoring import evaluation
from spnr_jax.training import weights

ROOT = Path(entry_point.__file__).parent
COMMANDS = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in ROOT.rglob("*.py")
    if "entry_point.run(" in path.read_text() and path.parent != ROOT
)
SPLITS = {"train": (), "val": (), "test": ("ball_000000",)}
VARIANTS = {"train": ("ball_000000", "ball_000000--1", "ball_000001")}
SOLVER = importlib.util.find_spec("pymeshlab") is not None
CLOCKED = {"ms_per_view", "training_seconds", "load", "date", "seconds", "costs", "losses", "tasks"}


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    """Networks and surfaces shrunken."""
    for name, shrunken in (SHRUNKEN | {"tiny": L1_ONLY}).items():
        monkeypatch.setitem(presets.PRESETS, name, lambda shrunken=shrunken: shrunken)
    for name, surface in poisson.SURFACES.items():  # depth 12 takes seconds for a ball of few points
        monkeypatch.setitem(poisson.SURFACES, name, dataclasses.replace(surface, depth=5))
    monkeypatch.setattr(sharpness, "KNOWN_SIZE", 48)
    monkeypatch.setattr(fig3, "all_methods", lambda _: {"Ours": contenders.Method(draw=draw_grey)})
    monkeypatch.setattr(weights, "packaged_file", tiny_surfels.shipped)
    monkeypatch.setattr(surfel_method, "densify_sparse", lambda variables, cloud, *_: cloud)  # it takes long to trace
    monkeypatch.setattr(evaluation, "choose_radius", lambda *_: 1.5)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A ball lit view by view as by `--lights`, balls with settings of the generator, and some with colour variants."""
    folder = tmp_path_factory.mktemp("data")
    lit = tiny_dataset.write_dataset(folder / "lit", SPLITS, tiny_surfels.SIZE)
    lights = np.random.default_rng(0).random((tiny_dataset.VIEWS, 32, 64, 3), np.float32)
    (lit / "objects" / "ball_000000" / "lights.npz").write_bytes(layout.encode_lights(lights))
    described = json.loads((lit / "dataset.json").read_text())
    described["environment_map"] = {"kinds": [{"name": "maps", "sha256": {"sky_1k.hdr": "0"}}]}
    (lit / "dataset.json").write_text(json.dumps(described))
    painted = folder / "painted"
    shutil.copytree(tiny_dataset.dataset().folder, painted)
    described = {
        "schema_version": layout.SCHEMA_VERSION,
        "settings": vars(views.ViewConfig(resolution=SIZE, spp=4, views=tiny_dataset.VIEWS, max_depth=2)),
        "environment_map": {"name": "procedural room", "sha256": None},
    }
    (painted / "dataset.json").write_text(layout.json_text(described))
    varied = tiny_dataset.write_dataset(folder / "varied", tiny_dataset.SPLITS | VARIANTS)
    return SimpleNamespace(lit=lit, painted=painted, varied=varied, run=lambda: str(tiny_surfels.untrained()))


def draw_grey(_, item):
    """Every pixel of the object, grey and at one depth, of points without normals, as in all comparisons."""
    assert item.cloud.normals is None
    acc = item.images[..., 3] / np.float32(255)
    image = np.repeat(np.where(acc > 0, 0.5, 1)[..., None], 3, axis=-1)
    return evaluation.Pictures(image=image, acc=acc, depth=np.full(acc.shape, 2.5, np.float32))


def check_sharpness(found):
    assert len(found["objects"]) == 2  # network and discs
    assert all(scores["encode"] > 0 for (scores,) in found["objects"].values())


def check_relighting(found):
    assert list(found["objects"]) == [f"sky_1k, 32, {method}" for method in relighting.METHODS]


def check_speed_accuracy(found):
    assert {row["group"] for row in found["rows"]} == {"level", "fewer pixels"}
    assert all(5 < row["psnr"] < 60 and row["ms_view"] > 0 for row in found["rows"])


def check_fig3(found):
    for ours in found["scores"]["Ours"]:
        assert 0 < ours["median"] < 1
        assert ours["missed"] == 0


def check_fig1(found):
    assert (found["compared"], found["pretrain"]) == ("l1_100", 4)


def check_fig2(found):
    assert {name: row["training_objects"] for name, row in found["methods"].items()} == {"without": 2, "with": 3}
    means = [found["methods"][name]["psnr"] for name in ("with", "without")]
    assert found["differences"]["without"]["psnr"]["mean"] == pytest.approx(means[0] - means[1], abs=1e-5)


def check_inverse(found):
    for task, of in found["tasks"].items():
        assert of["overflow"] == 0, task
        assert np.sum(of["losses"][-1]) < np.sum(of["losses"][0]), task
    assert set(found["gradients"]) == set(inverse.Unknowns._fields)
    for name, pairs in found["gradients"].items():
        for gradient, difference in pairs:
            assert abs(difference) > 1e-4
            assert gradient == pytest.approx(difference, rel=1e-2), name


RUNS = {  # name -> its options, the pictures that it writes, and what is known of its results
    "studies.sharpness": (
        lambda data: {"data": data.lit, "runs": (data.run(),), "counts": (32,)},
        ("gallery.png", "ball_000000.png"),
        check_sharpness,
    ),
    "studies.relighting": (
        lambda data: {"data": (data.lit,), "run": data.run(), "counts": (32,), "views": 2},
        ("gallery.png",),
        check_relighting,
    ),
    "studies.speed_accuracy": (
        lambda data: {
            **{"data": data.lit, "runs": (data.run(),), "sizes": (48,), "counts": (32,)},
            **{"objects": 1, "views": 1, "quick": True},
        },
        ("front.png",),
        check_speed_accuracy,
    ),
    "paper.fig3": (
        lambda data: {"data": data.painted, "runs": (), "points": 32, "quick": True},
        ("fig3_depth.png",),
        check_fig3,
    ),
    "paper.fig1": (
        lambda data: {
            **{"data": data.painted, "l1_weights": (100.0,), "pretrain": 4},
            "budget": Budget(quick=True, shown=1),
        },
        ("gallery.png",),
        check_fig1,
    ),
    "paper.fig2": (
        lambda data: {"data": data.varied, "budget": Budget(quick=True)},
        ("variants.png", "gallery.png"),
        check_fig2,
    ),
    "studies.inverse": (lambda data: {"quick": True}, ("inverse.png",), check_inverse),
}


SLOW = pytest.mark.slow  # its gradient alone takes a minute to compile


@pytest.mark.ci
@pytest.mark.parametrize("name", [pytest.param(x, marks=SLOW if x == "studies.inverse" else ()) for x in RUNS])
def test_a_command_ends_with_finite_numbers_and_pictures_and_goes_on_where_it_was(name, data, tmp_path):
    options, pictures, check = RUNS[name]
    found, out = run_twice(name, tmp_path / "out", **options(data))
    for picture in pictures:
        assert (out / picture).read_bytes().startswith(b"\x89PNG")
    check(found)


ONCE = ("studies.inverse", "paper.fig1")  # one keeps nothing, the other goes on as fig2 does


def run_twice(name, out, **options):
    """The results of an experiment; everything in them is a finite number, and the same when it is called again."""
    main, kind = main_of(name)
    main(kind(out=out, **options))
    first, files = read(out), made(out)
    assert (out / "table.md").read_text().count("|") > 10
    assert all(math.isfinite(x) for x in jax.tree.leaves(first) if isinstance(x, float | int))
    if name not in ONCE:
        main(kind(out=out, **options))
        assert made(out) == files
        assert without_clock(read(out)) == without_clock(first)
    return first, out


def main_of(name):
    main = importlib.import_module(f"experiments.{name}").main
    return main, next(iter(typing.get_type_hints(main).values()))


def read(out):
    return json.loads((out / "results.json").read_text())


def made(out):
    """What stands in the folders below, and when it was made; a run notes each of its starts."""
    return {p: p.stat().st_mtime_ns for p in out.glob("*/**/*") if p.is_file() and p.name != "run.json"}


def without_clock(found):
    if isinstance(found, dict):
        return {name: without_clock(value) for name, value in found.items() if name not in CLOCKED}
    return found


@pytest.mark.ci
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_explains_its_options(name, monkeypatch, capsys):
    main, options = main_of(name)
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as ended:
        entry_point.run(main, options, name)
    assert ended.value.code == 0
    assert "--out" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--no-such-option", "3"], ["--out"], []])
def test_a_wrong_option_of_a_command_is_one_line_and_code_2(arguments, monkeypatch, capsys):
    main, options = main_of(name := "studies.sharpness")
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended:
        entry_point.run(main, options, name)
    assert ended.value.code == 2
    assert re.fullmatch(rf"sharpness: .*python -m experiments\.{name} --help\s*\n", capsys.readouterr().err)


DATA = {"data": Path("d"), "out": Path("o")}


@pytest.mark.parametrize(
    ("study", "name", "value", "got"),
    [
        (partial(inverse.InverseStudy, **DATA), "steps", 0, "0"),
        (partial(sharpness.SharpnessStudy, **DATA), "counts", (), "nothing"),
        (partial(sharpness.SharpnessStudy, **DATA), "resolution", 0, "0"),
        (partial(relighting.RelightingStudy, **DATA), "views", -1, "-1"),
        (partial(speed_accuracy.SpeedAccuracy, **DATA), "sizes", (64, 0), "64 0"),
        (partial(fig3.Fig3, **DATA, runs=()), "points", 0, "0"),
        (Budget, "objects", 0, "0"),
        (recipe.Recipe, "share", math.inf, "inf"),
        (recipe.Recipe, "share", math.nan, "nan"),
    ],
)
def test_numbers_that_an_experiment_cannot_use_are_refused_by_name(study, name, value, got):
    with pytest.raises(ValueError, match=f"^--{name}: expected .*, got {got}$"):
        study(**{name: value})


@pytest.mark.parametrize(
    ("study", "name"),
    [(relighting.RelightingStudy, "data"), (sharpness.SharpnessStudy, "runs"), (table1.Table1, "methods")],
)
def test_an_experiment_on_nothing_is_refused_by_name(study, name):
    with pytest.raises(ValueError, match=f"^--{name}: name at least one"):
        study(**DATA | {name: ()})


@pytest.mark.ci
@pytest.mark.parametrize("left_out", [("point_nerf", "points2nerf"), pytest.param((), marks=pytest.mark.slow)])
def test_table_1_has_the_scores_of_the_evaluation_of_its_runs(left_out, data, tmp_path):
    possible = (name for name in table1.ROWS if SOLVER or not name.startswith("poisson"))
    rows = tuple(name for name in possible if name not in left_out)
    asked = {"data": data.painted, "budget": "quick", "methods": rows, "variant": "scalar_rgb"}
    found, out = run_twice("paper.table1", tmp_path / "out", **asked)
    assert set(found["methods"]) == set(rows)
    first = found["compared"]
    alone = evaluation.evaluate(out / "runs" / first, data_sets.open_dataset(data.painted)).summary
    for method in (first, *evaluation.TRIVIAL):
        assert found["methods"][method] == alone["methods"][method]
        assert method == first or found["differences"][method] == alone[f"{first}_minus"][method]
    assert (out / "gallery.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.ci
def test_what_a_command_cannot_do_is_refused_by_name(data, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="no light of their own"):
        relighting.name_of(tiny_surfels.dataset())
    given = {"data": (data.lit, data.painted), "out": tmp_path / "new", "run": data.run(), "counts": (32,)}
    with pytest.raises(ValueError, match="data sets of the same test objects"):
        relighting.main(relighting.RelightingStudy(**given))
    given = {"data": data.painted, "out": tmp_path / "new", "budget": Budget(quick=True)}
    with pytest.raises(ValueError, match="spnr-data generate DIR --colour-variants 5"):
        fig2.main(fig2.Fig2(**given))
    sky = shutil.copytree(data.painted, tmp_path / "sky")
    described = json.loads((sky / "dataset.json").read_text()) | {"environment_map": {"name": "sky.hdr"}}
    (sky / "dataset.json").write_text(json.dumps(described))
    drawn = {"data": sky, "out": tmp_path / "new", "runs": (data.run(),), "counts": (32,)}
    for study in (sharpness.SharpnessStudy, speed_accuracy.SpeedAccuracy):
        with pytest.raises(ValueError, match=r"lit by sky\.hdr"):
            sys.modules[study.__module__].main(study(**drawn))
    (sky / "splits" / "test.txt").write_text("")
    with pytest.raises(ValueError, match="the test split is empty"):
        inverse.main(inverse.InverseStudy(data=sky, out=tmp_path / "new", quick=True))
    assert not (tmp_path / "new").exists()
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    asked = {"data": data.painted, "budget": "quick", "variant": "scalar_rgb"}
    table1.main(table1.Table1(out=tmp_path / "out", methods=("poisson", "white"), **asked))
    found = read(tmp_path / "out")
    assert list(found["methods"]) == ["white"]
    assert "pip install" in found["missing"]["poisson"]
    with pytest.raises(ValueError, match="none can be made here, not run"):
        table1.main(table1.Table1(out=tmp_path / "alone", methods=("poisson",), **asked))


# --- the demo, and commands that measure speed ------------------------------------------------------------------------


@pytest.mark.ci
def test_the_demo_writes_its_report_and_a_second_call_reuses_everything(data, tmp_path, monkeypatch, capsys):
    small = SurfelConfig(image_resolution=tiny_dataset.SIZE, widths=(4, 6), top=4)
    ours = dataclasses.replace(tiny_surfels.CONFIG, preset="surfels_tiny", model=small)
    monkeypatch.setattr(presets, "tiny", lambda: L1_ONLY)
    monkeypatch.setattr(presets, "surfels_tiny", lambda: ours)

    def generate(asked):
        if not asked.out.exists():
            shutil.copytree(data.painted, asked.out)
            described = json.loads((asked.out / "dataset.json").read_text())
            described["settings"]["spread"] = asked.spread
            (asked.out / "dataset.json").write_text(json.dumps(described))

    monkeypatch.setattr(demo, "generate", generate)
    out = tmp_path / "out"
    found, checkpoints = [], []
    for _ in range(2):
        demo.main(demo.Demo(out=out, steps=3))
        found.append(json.loads((out / "metrics.json").read_text()))
        checkpoints.append({path: path.stat().st_mtime_ns for path in out.glob("*/checkpoints/**/*")})
    first, second = found
    assert list(first["methods"]) == ["ours", "paper", "white", "splat", "nearest"]
    assert set(first["ours_minus"]) == {"paper", "white", "splat", "nearest"}
    assert [first["settings"]["networks"][name]["steps"] for name in ("ours", "paper")] == [3, 3]
    parts = sum(seconds for name, seconds in first["seconds"].items() if name != "total")
    assert first["seconds"]["total"] == pytest.approx(parts, abs=0.3)
    assert all(name in (out / "report.html").read_text() for name in tiny_dataset.SPLITS["test"])
    assert str(out / "report.html") in capsys.readouterr().out
    assert {path.relative_to(out).parts[0] for path in checkpoints[0]} == {"ours", "paper"}
    assert checkpoints[0] == checkpoints[1]
    assert second["methods"] == first["methods"]
    assert second["seconds"]["train"] == first["seconds"]["train"]


def test_seconds_add_up_over_calls_and_idle_ones_add_nothing(tmp_path, monkeypatch):
    clock = iter([0.0, 30.0, 100.0, 112.0, 200.0, 203.0, 300.0, 320.0])
    monkeypatch.setattr(demo, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    place = tmp_path / "seconds.json"
    for expected in (30.0, 42.0, 42.0):
        demo.Seconds(place).measure("train", lambda: None)
        assert json.loads(place.read_text()) == {"train": expected}
    with pytest.raises(KeyboardInterrupt):  # work that was stopped counts
        demo.Seconds(place).measure("train", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    assert json.loads(place.read_text()) == {"train": 62.0}


@pytest.mark.ci
def test_without_torch_one_line_says_so_and_ours_is_timed_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench.importlib.util, "find_spec", lambda name: None)
    options = bench.Options(out=tmp_path, presets=("tiny",), modes=("encode",), rounds=2, seconds=0.01)
    (row,) = bench.rows_of(options)
    assert row["ours_ms"] > 0
    assert row["ratio"] is None
    assert "ours is timed alone" in capsys.readouterr().out
    assert bench.rows_of(options) == [row]  # nothing is measured again
