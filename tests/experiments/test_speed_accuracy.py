"""The trade of speed for quality: which settings are measured, which of them nothing beats, and what is written."""

import dataclasses
import json

import pytest
from support import tiny_dataset, tiny_model, tiny_surfels, tiny_untrained

from experiments.studies import speed_accuracy, speed_accuracy_plot
from experiments.studies.speed_accuracy import SpeedAccuracy, main
from experiments.studies.speed_accuracy_report import front, knee
from experiments.studies.speed_accuracy_settings import settings
from spnr_jax import cli
from spnr_jax.config import SurfelConfig
from spnr_jax.formats import data_sets
from spnr_jax.training.weights import load


def row(ms, psnr):
    return {"ms_view": ms, "psnr": psnr}


class TestFront:
    rows = (row(4, 20.0), row(2, 18.0), row(8, 21.0), row(5, 19.0), row(3, 20.5), row(3, 20.4), row(16, 21.0))

    def test_it_holds_the_settings_that_no_other_beats_cheapest_first(self):
        assert front(list(self.rows)) == [1, 4, 2]

    def test_its_knee_lies_farthest_above_the_line_from_the_cheapest_to_the_best(self):
        assert knee(list(self.rows), front(list(self.rows))) == 4

    def test_a_single_setting_is_front_and_knee(self):
        assert knee([row(1, 1.0)], front([row(1, 1.0)])) == 0


COUNTS = (64, 32)
SURFELS = SurfelConfig(image_resolution=48)


@pytest.mark.parametrize("config", [tiny_model.MODEL, tiny_model.WITHOUT_UPSAMPLER, tiny_model.PLUS, SURFELS])
def test_the_best_level_comes_first_and_every_name_once(config):
    ways = settings(config, COUNTS)
    first = ways[0]
    assert (first.config, first.quality, first.share, first.points) == (config, "best", 1, 64)
    assert len({way.name for way in ways}) == len(ways)
    assert {way.group for way in ways} <= set(speed_accuracy_plot.GROUPS)
    assert {way.points for way in ways if way.group == "points"} == {32}
    assert any(way.share < 1 for way in ways) == config.any_size


def test_the_network_over_surfels_has_levels_sizes_and_points_alone():
    assert {way.group for way in settings(SURFELS, COUNTS)} == {"level", "fewer pixels", "points"}


def test_networks_of_rays_have_other_samples_where_they_have_learnt_them():
    boxed, near = (settings(config, COUNTS) for config in (tiny_model.MODEL, tiny_model.PLUS))
    assert {way.group for way in boxed} == {"level", "samples", "near points", "bfloat16", "points"}
    assert {way.config.sampling.reach for way in near} == {tiny_model.PLUS.sampling.reach}
    found = [way.config.sampling.num_coarse for way in near if way.group == "near points"]
    assert found == [2 * tiny_model.PLUS.sampling.num_coarse], "the levels have fewer"


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    """A data set of two balls of 48 pixels."""
    splits = {"train": (), "val": (), "test": ("ball_000000", "ball_000001")}
    return tiny_dataset.write_dataset(tmp_path_factory.mktemp("balls") / "set", splits, tiny_surfels.SIZE)


def test_a_second_call_goes_on_where_the_first_one_stopped(balls, tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)
    runs, measured = (str(tiny_surfels.run()), str(tiny_untrained.run())), []
    options = SpeedAccuracy(data=balls, runs=runs, out=tmp_path, objects=2, sizes=(24, 48), quick=True)

    def measure(model, way, *, size, **_):
        measured.append((size, way.name))
        if len(measured) == 3:
            raise KeyboardInterrupt
        same = {"ssim": 0.8, "flip": 0.1, "iou": 0.9, "s_encode": 1.0, "mb": 1.0}
        return same | {"psnr": 20.0 + len(measured), "ms_view": 1.0 + len(measured)}

    monkeypatch.setattr(speed_accuracy, "measure", measure)
    with pytest.raises(KeyboardInterrupt):
        main(options)
    main(options)
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert {21.0, 22.0} < {row["psnr"] for row in rows}
    assert len(rows) == len(measured) - 1
    assert [name for _, name in measured[:2]] == ["best", "best"], "levels come first"
    assert {row["size"] for row in rows if row["run"] == runs[0]} == {24, 48}
    assert {row["size"] for row in rows if row["run"] == runs[1]} == {24, 48}
    assert (tmp_path / "front.png").stat().st_size > 1000
    text = (tmp_path / "table.md").read_text()
    assert "Quality and cost at 24 px" in text
    assert "The front at 48 px, step by step" in text
    with pytest.raises(ValueError, match="speed_accuracy with another objects; choose another --out"):
        main(dataclasses.replace(options, objects=1))


@pytest.mark.ci
def test_a_setting_is_scored_and_timed_and_fewer_pixels_are_enlarged(balls):
    dataset, model = data_sets.open_dataset(balls), load(str(tiny_surfels.run()))
    ways = {way.name: way for way in settings(model.config, COUNTS)}
    found = [
        speed_accuracy.measure(model, ways[name], dataset, dataset.splits["test"][:1], 1, {}, 48)
        for name in ("best", "draft, 0.5 of the size")
    ]
    for figures in found:
        assert 5 < figures["psnr"] < 60
        assert figures["ms_view"] > 0
        assert figures["mb"] >= 0
    assert found[0] != found[1]


@pytest.mark.ci
@pytest.mark.parametrize("size", [24, 48])
def test_what_an_upsampler_draws_at_its_own_size_is_scored_at_any(balls, size):
    dataset, model = data_sets.open_dataset(balls), load(str(tiny_untrained.run()))
    way = settings(model.config, COUNTS)[0]
    assert speed_accuracy.measure(model, way, dataset, dataset.splits["test"][:1], 1, {}, size)["psnr"] > 5
