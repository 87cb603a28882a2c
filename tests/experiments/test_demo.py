"""The demo trains two networks, reuses what is there, and reports the seconds of the run that did the work."""

import dataclasses
import html
import json
import shutil
from types import SimpleNamespace

import pytest
from support import tiny_dataset, tiny_surfels

from data_gen.store import layout
from experiments.packaged import demo
from spnr_jax import cli, presets
from spnr_jax.config import SurfelConfig

SMALL = SurfelConfig(image_resolution=tiny_dataset.SIZE, widths=(4, 6), top=4)
OURS = dataclasses.replace(tiny_surfels.CONFIG, preset="surfels_tiny", model=SMALL)


@pytest.fixture
def asked(monkeypatch):
    """Instead of Mitsuba, the tests' data set; the configs that the generator was given."""
    configs = []

    def generate(generation):
        configs.append(generation)
        if not generation.out.exists():
            shutil.copytree(tiny_dataset.dataset().folder, generation.out)
            described = {"settings": {"spread": generation.spread}}
            layout.write_text(generation.out / "dataset.json", layout.json_text(described))

    monkeypatch.setattr(demo, "generate", generate)
    monkeypatch.setattr(presets, "tiny", lambda: tiny_dataset.CONFIG)
    monkeypatch.setattr(presets, "surfels_tiny", lambda: OURS)
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)
    return configs


@pytest.mark.ci
def test_the_demo_writes_its_report_and_a_second_call_reuses_everything(asked, tmp_path, capsys):
    demo.main(demo.Demo(out=tmp_path, steps=3))
    first = json.loads((tmp_path / "metrics.json").read_text())
    assert list(first["methods"]) == ["ours", "paper", "white", "splat", "nearest"]
    assert set(first["ours_minus"]) == {"paper", "white", "splat", "nearest"}
    trained = first["settings"]["networks"]
    assert (trained["ours"]["preset"], trained["paper"]["preset"]) == ("surfels_tiny", "tiny")
    assert set(first["seconds"]) >= {"generate", "train", "train paper", "evaluate", "total"}
    parts = sum(seconds for name, seconds in first["seconds"].items() if name != "total")
    assert first["seconds"]["total"] == pytest.approx(parts, abs=0.3)
    assert first["steps"] == trained["ours"]["steps"] == trained["paper"]["steps"] == 3
    page = html.unescape((tmp_path / "report.html").read_text())
    assert all(name in page for name in tiny_dataset.SPLITS["test"])
    assert "<th>Ours</th><th>The paper's network</th>" in page
    assert str(tmp_path / "report.html") in capsys.readouterr().out

    checkpoints = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/checkpoints/**/*")}
    assert {path.relative_to(tmp_path).parts[0] for path in checkpoints} == {"ours", "paper"}
    demo.main(demo.Demo(out=tmp_path, steps=3))
    second = json.loads((tmp_path / "metrics.json").read_text())
    assert checkpoints == {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/checkpoints/**/*")}
    assert second["methods"] == first["methods"]
    assert second["seconds"]["train"] == first["seconds"]["train"]


@pytest.mark.parametrize(("meshes", "objects", "expected"), [(None, None, 240), ("m", None, None), ("m", 7, 7)])
def test_procedural_objects_are_made_unless_meshes_replace_them(
    meshes, objects, expected, asked, tmp_path, monkeypatch
):
    class Generated(Exception):  # noqa: N818 - no error: the demo has got as far as the test looks
        pass

    def stop(*_):
        raise Generated

    monkeypatch.setattr(demo.data_sets, "open_dataset", stop)
    with pytest.raises(Generated):
        demo.main(demo.Demo(out=tmp_path, meshes=meshes and tmp_path / meshes, objects=objects))
    assert asked[0].objects == expected


def test_seconds_add_up_over_calls_and_idle_ones_add_nothing(tmp_path, monkeypatch):
    clock = iter([0.0, 30.0, 100.0, 112.0, 200.0, 203.0])
    monkeypatch.setattr(demo, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    for expected in (30.0, 42.0, 42.0):
        seconds = demo.Seconds(tmp_path / "seconds.json")
        seconds.measure("train", lambda: None)
        assert json.loads((tmp_path / "seconds.json").read_text()) == {"train": expected}


def test_seconds_of_work_that_was_stopped_are_kept(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        demo.Seconds(tmp_path / "seconds.json").measure("train", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    assert "train" in json.loads((tmp_path / "seconds.json").read_text())
