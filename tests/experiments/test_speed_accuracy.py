"""The trade of speed for quality: which settings are measured, which of them nothing beats, and what is written."""

import dataclasses
import json

import pytest
from support import tiny_dataset, tiny_model

from experiments.studies import speed_accuracy
from experiments.studies.speed_accuracy import SpeedAccuracy, front, knee, main, settings
from spnr_jax.config import LossConfig
from spnr_jax.training import checkpoint, optimisation


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


def test_the_trained_way_comes_first_and_every_name_once():
    ways = settings(tiny_dataset.CONFIG)
    assert ways[0].config == tiny_dataset.CONFIG
    assert len({way.name for way in ways}) == len(ways)
    assert {way.group for way in ways} == set(speed_accuracy.GROUPS)


def test_a_network_near_the_points_is_rendered_with_other_samples_there_and_as_many_rays():
    alone = LossConfig(adversarial_weight=0.0)
    config = dataclasses.replace(tiny_dataset.CONFIG, model=tiny_model.PLUS, loss=alone)
    ways = settings(config)
    assert ways[0].config == config
    assert {way.group for way in ways} == {"trained", "near points", "bfloat16", "points"}
    total = config.model.sampling.num_coarse
    found = {way.config.model.sampling.num_coarse for way in ways if way.group == "near points"}
    assert found == {2 * total, 3 * total // 4, total // 2, max(total // 4, 2)}


def test_a_second_call_goes_on_where_the_first_one_stopped(tmp_path, monkeypatch):
    options = SpeedAccuracy(
        data=tiny_dataset.dataset().folder, runs=(tiny_dataset.run(),), out=tmp_path, objects=1, quick=True
    )
    measured = []

    def measure(variables, config, dataset, names):
        measured.append(config)
        if len(measured) == 3:
            raise KeyboardInterrupt
        same = {"ssim": 0.8, "flip": 0.1, "iou": 0.9, "ms_encode": 1.0, "temporary_mb": 1.0}
        return same | {"psnr": 20.0 + len(measured), "ms_view": 1.0 + len(measured)}

    monkeypatch.setattr(speed_accuracy, "measure", measure)
    with pytest.raises(KeyboardInterrupt):
        main(options)
    main(options)
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [row["psnr"] for row in rows[:2]] == [21.0, 22.0]
    assert len({row["name"] for row in rows}) == len(rows) == len(measured) - 1
    assert (tmp_path / "front.png").stat().st_size > 1000
    with pytest.raises(ValueError, match="results with another objects; choose another --out"):
        main(dataclasses.replace(options, objects=2))


def test_a_setting_is_scored_and_timed():
    config, state = checkpoint.load_run(tiny_dataset.run())
    dataset = tiny_dataset.dataset()
    figures = speed_accuracy.measure(
        optimisation.averaged_variables(state), config, dataset, dataset.splits["test"][:1]
    )
    assert figures["psnr"] > 5
    assert figures["ms_view"] > 0
    assert figures["temporary_mb"] > 0
