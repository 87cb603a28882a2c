"""Tables hold the means over images with their intervals, and None where there is no number."""

import numpy as np
import pytest

from spnr_jax.scoring import intervals
from spnr_jax.scoring.summary import METRICS, NO_WEIGHTS, differences, metric_settings, summarise


def scores_of(*values, cpsnr=None):
    row = np.array(values, np.float32)
    cpsnr = row if cpsnr is None else np.array(cpsnr, np.float32)
    return {"psnr": row, "ssim": row / 100, "cpsnr": cpsnr, "flip": 1 - row / 100, "iou": row / 50}


def test_an_image_without_visible_points_is_left_out_of_its_mean_alone_and_counted():
    one, two = scores_of(10, 20, cpsnr=[np.nan, 12]), scores_of(30, cpsnr=[14])
    row = summarise([{"a": one}, {"a": two}])["a"]
    assert row["psnr"] == 20, "mean over images, not over objects"
    assert (row["cpsnr"], row["cpsnr_views"], row["views"], row["objects"]) == (13, 2, 3, 2)


def test_no_visible_point_at_all_is_no_number_and_neither_is_what_was_not_measured():
    results = [{"a": scores_of(x, cpsnr=[np.nan]), "b": scores_of(x, cpsnr=[np.nan])} for x in (10, 12)]
    row = summarise(results)["a"]
    assert [row[name] for name in ("cpsnr", "cpsnr_interval", "lpips", "lpips_interval")] == [None] * 4
    assert differences(results, "a")["b"]["cpsnr"] is differences(results, "a")["b"]["lpips"] is None


def test_every_metric_has_its_interval_and_one_object_has_none():
    results = [{"a": scores_of(x, x + 1)} for x in (10, 20, 40)]
    row = summarise(results)["a"]
    assert row["psnr_interval"] == list(intervals.interval([r["a"]["psnr"] for r in results]))
    for name in METRICS[:-2]:
        low, high = row[f"{name}_interval"]
        assert low < row[name] < high
    assert summarise(results[:1])["a"]["psnr_interval"] is None


def test_differences_are_those_of_one_method_to_every_other():
    rng = np.random.default_rng(0)
    results = [{name: scores_of(*rng.uniform(10, 30, 3)) for name in ("white", "ours", "npbg")} for _ in range(6)]
    table = differences(results)
    assert set(table) == {"white", "npbg"}
    for other, row in table.items():
        expected = intervals.difference([r["ours"]["flip"] for r in results], [r[other]["flip"] for r in results])
        assert row["flip"] == {
            "mean": expected.mean, "interval": list(expected.interval), "p_value": expected.p_value,
        }  # fmt: skip
        methods = summarise(results)
        assert row["psnr"]["mean"] == pytest.approx(methods["ours"]["psnr"] - methods[other]["psnr"], abs=1e-4)


def test_the_settings_name_every_metric_and_say_that_there_are_no_weights():
    assert metric_settings(with_lpips=False)["LPIPS"] == NO_WEIGHTS
    assert "AlexNet" in metric_settings(with_lpips=True)["LPIPS"]
    assert set(metric_settings(with_lpips=True)) >= {"PSNR", "SSIM", "FLIP", "LPIPS"}
    assert "67.02" in metric_settings(with_lpips=True)["FLIP"]
