"""Every experiment runs from its data to its tables in a tiny setting, and called again makes nothing anew."""

import dataclasses
import importlib.util
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from support import stand_ins, tiny_dataset, tiny_surfels
from support.handmade import ball
from support.tiny_baselines import SHRUNKEN, SIZE
from support.tiny_runs import L1_ONLY

from data_gen.render import views
from data_gen.store import layout
from experiments.comparison import poisson, trained_networks
from experiments.comparison.variants import Budget
from experiments.paper import fig1, fig2, fig3, table1
from experiments.studies import ablations, point_count, relighting, scans, sharpness, speed_accuracy
from spnr_jax import cli, presets
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.scoring import evaluation

pytestmark = pytest.mark.ci  # some train networks
SPLITS = {"train": (), "val": (), "test": ("ball_000000",)}
VARIANTS = {"train": ("ball_000000", "ball_000000--1", "ball_000001")}
SOLVER = importlib.util.find_spec("pymeshlab") is not None
CLOCKED = {"ms_per_step", "ms_per_view", "training_seconds", "load", "date"}


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    """Networks and surfaces shrunken, no cache on disk, the meshes that the tiny data set's pictures show."""
    for name, shrunken in (SHRUNKEN | {"tiny": L1_ONLY}).items():
        monkeypatch.setitem(presets.PRESETS, name, lambda shrunken=shrunken: shrunken)
    for name, surface in poisson.SURFACES.items():  # depth 12 takes seconds for a ball of few points
        monkeypatch.setitem(poisson.SURFACES, name, dataclasses.replace(surface, depth=5))
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)
    for module in (fig3, point_count):
        monkeypatch.setattr(module, "mesh_of", lambda *_: Asset(parts=(ball(radius=tiny_dataset.RADIUS, rows=64),)))


@pytest.fixture
def balls(tmp_path):
    """One ball of 48 pixels, each view in a light of its own, as `spnr-data generate --lights` writes it."""
    folder = tiny_dataset.write_dataset(tmp_path / "balls", SPLITS, tiny_surfels.SIZE)
    lights = np.random.default_rng(0).random((tiny_dataset.VIEWS, 32, 64, 3), np.float32)
    (folder / "objects" / "ball_000000" / "lights.npz").write_bytes(layout.encode_lights(lights))
    settings = json.loads((folder / "dataset.json").read_text())
    settings["environment_map"] = {"kinds": [{"name": "maps", "sha256": {"sky_1k.hdr": "0"}}]}
    (folder / "dataset.json").write_text(json.dumps(settings))
    return folder


@pytest.fixture
def painted(tmp_path):
    """The painted data set, described as the generator describes its own: Poisson surfaces need that."""
    folder = tmp_path / "painted"
    shutil.copytree(tiny_dataset.dataset().folder, folder)
    described = {
        "schema_version": layout.SCHEMA_VERSION,
        "settings": vars(views.ViewConfig(resolution=SIZE, spp=4, views=tiny_dataset.VIEWS, max_depth=2)),
        "environment_map": {"name": "procedural room", "sha256": None},
    }
    layout.write_text(folder / "dataset.json", layout.json_text(described))
    return folder


def run_twice(main, options):
    """The results of an experiment; everything in them is a finite number, and the same when it is called again."""
    main(options)
    first, files = read(options.out), made(options.out)
    assert (options.out / "table.md").read_text().count("|") > 10
    assert all(math.isfinite(x) for x in numbers(first))
    main(options)
    assert made(options.out) == files
    assert without_clock(read(options.out)) == without_clock(first)
    return first


def read(out):
    return json.loads((out / "results.json").read_text())


def made(out):
    """What stands in the folders below, and when it was made; a run notes each of its starts."""
    return {p: p.stat().st_mtime_ns for p in out.glob("*/**/*") if p.is_file() and p.name != "run.json"}


def numbers(found):
    if isinstance(found, dict | list):
        for value in found.values() if isinstance(found, dict) else found:
            yield from numbers(value)
    elif isinstance(found, float | int):
        yield found


def without_clock(found):
    if isinstance(found, dict):
        return {name: without_clock(value) for name, value in found.items() if name not in CLOCKED}
    return found


def test_sharpness_of_networks_and_of_pictures_made_elsewhere(balls, tmp_path, monkeypatch):
    monkeypatch.setattr(sharpness, "KNOWN_SIZE", 48)
    right = tmp_path / "right"  # pictures of another program that are the references
    for count in (16, 32):
        shutil.copytree(balls / "objects" / "ball_000000" / "images", right / str(count) / "ball_000000")
    options = sharpness.SharpnessStudy(
        data=balls,
        out=tmp_path / "out",
        runs=(str(tiny_surfels.run()),),
        counts=(16, 32),
        views=1,
        elsewhere=(right,),
    )
    found = run_twice(sharpness.main, options)["objects"]
    assert len(found) == 6  # network, discs and right, two numbers of points
    assert found["right, 32"][0]["psnr"] == pytest.approx(100, abs=1e-3)
    assert found["right, 32"][0]["outline_rmse"] == pytest.approx(0, abs=1e-6)


def test_relighting_of_each_light_and_a_refusal_of_data_without(balls, tmp_path):
    options = {"run": str(tiny_surfels.run()), "counts": (32,), "views": 2}
    found = run_twice(relighting.main, relighting.RelightingStudy(data=(balls,), out=tmp_path / "out", **options))
    assert list(found["objects"]) == [f"sky_1k, 32, {method}" for method in relighting.METHODS]
    with pytest.raises(ValueError, match="no light of their own"):
        relighting.name_of(tiny_surfels.dataset())


def test_scans_with_and_without_cleaning(balls, tmp_path):
    few = {"counts": (32,), "noise": (0.02,), "outliers": (0.1,), "scanners": (2,), "views": 1}
    options = scans.ScansStudy(data=balls, out=tmp_path / "out", run=str(tiny_surfels.run()), **few)
    found = run_twice(scans.main, options)["objects"]
    (clean,) = found["32, clean"]
    assert clean["auto"] == clean["off"] != clean["draft"]
    assert clean["left"] == 1
    assert found["32, outliers 10%"][0]["left"] == 1.1


def test_speed_against_accuracy(balls, tmp_path):
    few = {"sizes": (24, 48), "counts": (64, 32), "objects": 1, "views": 1, "quick": True}
    options = speed_accuracy.SpeedAccuracy(data=balls, runs=(str(tiny_surfels.run()),), out=tmp_path / "out", **few)
    rows = run_twice(speed_accuracy.main, options)["rows"]
    assert {row["size"] for row in rows} == {24, 48}
    assert all(5 < row["psnr"] < 60 and row["ms_view"] > 0 for row in rows)


def test_numbers_of_points(tmp_path, monkeypatch):
    monkeypatch.setattr(trained_networks, "networks", lambda *_: stand_ins.stand_ins("Ours", "NPBG"))
    monkeypatch.setattr(evaluation, "choose_radius", lambda *_: 1.5)
    monkeypatch.setattr(point_count, "details", lambda *_: {"seeds": {"points": 5}})
    folder = tiny_dataset.dataset().folder
    found = run_twice(point_count.main, point_count.PointCount(data=folder, out=tmp_path, counts=(8, 16, 64)))
    assert [row["points"] for row in found["curves"]["Ours"]["psnr"]] == [8, 16, 64]  # 64 are new ones of the mesh
    assert set(found["curves"]["NPBG"]) == {"psnr", "flip"}, "it has no opacity"


def test_depths_beside_the_mesh(tmp_path, monkeypatch):
    monkeypatch.setattr(trained_networks, "networks", lambda *_: stand_ins.stand_ins("Ours", "NPBG"))
    options = fig3.Fig3(data=tiny_dataset.dataset().folder, out=tmp_path, quick=True, variant="scalar_rgb")
    found = run_twice(fig3.main, options)["methods"]
    assert list(found) == ["Ours"]  # the other one predicts no depth
    for name in ("error", "median", "bias", "surface"):
        assert found["Ours"][name]["mean"] == pytest.approx(stand_ins.OFFSET, abs=3e-3)
    assert found["Ours"]["missed"]["mean"] == found["Ours"]["far_floaters"]["mean"] == 0


def test_ablations_and_their_folds(tmp_path):
    data = tiny_dataset.dataset().folder
    asked = {"rows": ("no_view_direction",), "folds": 2, "budget": Budget(steps=2, shown=2)}
    found = run_twice(ablations.main, ablations.Ablations(data=data, out=tmp_path, **asked))
    assert sorted(found["test_objects"]) == sorted(n for names in tiny_dataset.SPLITS.values() for n in names)
    means = [found["variants"][name]["psnr"] for name in ("no_view_direction", "reference")]
    difference = found["minus_reference"]["no_view_direction"]["psnr"]
    assert difference["mean"] == pytest.approx(means[0] - means[1], abs=1e-5)


def test_weights_of_the_adversarial_loss_from_one_network(tmp_path):
    options = fig1.Fig1(
        data=tiny_dataset.dataset().folder,
        out=tmp_path / "out",
        l1_weights=(0.0, 100.0),
        pretrain=2,
        budget=Budget(quick=True, shown=1),
    )
    found = run_twice(fig1.main, options)
    assert (found["reference"], found["start"]) == ("l1_100", "2 steps of L1 alone")
    with pytest.raises(ValueError, match="another pretrain; choose another --out"):
        fig1.main(dataclasses.replace(options, pretrain=0))
    with pytest.raises(ValueError, match="are of another network"):
        fig1.main(dataclasses.replace(options, out=tmp_path / "new", pretrain=0, init=Path("surfels")))
    assert not (tmp_path / "new").exists()


def test_colour_variants(tmp_path):
    folder = tiny_dataset.write_dataset(tmp_path / "data", tiny_dataset.SPLITS | VARIANTS)
    budget = Budget(quick=True)
    found = run_twice(fig2.main, fig2.Fig2(data=folder, out=tmp_path / "out", budget=budget))
    assert {name: row["training_objects"] for name, row in found["variants"].items()} == {"without": 2, "with": 3}
    assert (tmp_path / "out" / "variants.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="spnr-data generate DIR --colour-variants 5"):
        fig2.main(fig2.Fig2(data=tiny_dataset.dataset().folder, out=tmp_path / "none", budget=budget))


def test_table_1_has_the_scores_of_the_evaluation_of_its_runs(painted, tmp_path):
    methods = tuple(name for name in table1.ROWS if SOLVER or not name.startswith("poisson"))
    asked = {"budget": "quick", "methods": methods, "variant": "scalar_rgb"}
    found = run_twice(table1.main, table1.Table1(data=painted, out=tmp_path / "out", **asked))
    assert set(found["methods"]) == set(methods)
    first = found["compared"]
    alone = evaluation.evaluate(tmp_path / "out" / "runs" / first, table1.data_sets.open_dataset(painted)).summary
    for method in (first, *evaluation.FLOORS):
        assert found["methods"][method] == alone["methods"][method]
        assert method == first or found["differences"][method] == alone[f"{first}_minus"][method]
    page = (tmp_path / "out" / "table1.html").read_text()
    assert "http" not in page
    assert page.count("data:image/png;base64") >= len(methods)


def test_without_the_solver_rows_of_table_1_say_what_to_install(painted, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pymeshlab", None)
    asked = {"data": painted, "budget": "quick", "variant": "scalar_rgb"}
    table1.main(table1.Table1(out=tmp_path / "out", methods=("poisson", "white"), **asked))
    found = read(tmp_path / "out")
    assert list(found["methods"]) == ["white"]
    assert "pip install" in found["missing"]["poisson"]
    with pytest.raises(ValueError, match="none can be made here, not run"):
        table1.main(table1.Table1(out=tmp_path / "alone", methods=("poisson",), **asked))
