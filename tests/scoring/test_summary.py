"""Means over images, None where there is no number; intervals hold the truth as often as they say."""

import itertools

import numpy as np
import pytest

from spnr_jax.scoring import summary
from spnr_jax.scoring.summary import METRICS, difference, differences, interval, summarise


def scores_of(*values, cpsnr=None):
    row = np.array(values, np.float32)
    cpsnr = row if cpsnr is None else np.array(cpsnr, np.float32)
    return {"psnr": row, "ssim": row / 100, "cpsnr": cpsnr, "flip": 1 - row / 100, "iou": row / 50}


def objects(seed: int, count: int, views: int = 4, kind: str = "normal") -> list[np.ndarray]:
    """Scores of objects around 0: what all views of an object share, and a little noise for each."""
    rng = np.random.default_rng(seed)
    shared = rng.normal(size=count) if kind == "normal" else rng.exponential(size=count) - 1
    return list(shared[:, None] + 0.3 * rng.normal(size=(count, views)))


def minus(first, second):
    return difference([{"psnr": x} for x in first], [{"psnr": x} for x in second], "psnr")


class TestTables:
    def test_an_image_without_visible_points_is_left_out_of_its_mean_alone_and_counted(self):
        one, two = scores_of(10, 20, cpsnr=[np.nan, 12]), scores_of(30, cpsnr=[14])
        row = summarise([{"a": one}, {"a": two}])["a"]
        assert row["psnr"] == 20, "mean over images, not over objects"
        assert (row["cpsnr"], row["cpsnr_views"], row["views"], row["objects"]) == (13, 2, 3, 2)

    def test_no_visible_point_at_all_is_no_number_and_neither_is_what_was_not_measured(self):
        results = [{"a": scores_of(x, cpsnr=[np.nan]), "b": scores_of(x, cpsnr=[np.nan])} for x in (10, 12)]
        row = summarise(results)["a"]
        assert [row[name] for name in ("cpsnr", "cpsnr_interval", "lpips", "lpips_interval")] == [None] * 4
        assert differences(results, "a")["b"]["cpsnr"] is differences(results, "a")["b"]["lpips"] is None

    def test_every_metric_has_its_interval_and_one_object_has_none(self):
        results = [{"a": scores_of(x, x + 1)} for x in (10, 20, 40)]
        row = summarise(results)["a"]
        assert row["psnr_interval"] == interval([r["a"]["psnr"] for r in results])
        for name in METRICS[:-2]:
            low, high = row[f"{name}_interval"]
            assert low < row[name] < high
        assert summarise(results[:1])["a"]["psnr_interval"] is None

    def test_differences_are_those_of_one_method_to_every_other(self):
        rng = np.random.default_rng(0)
        results = [{name: scores_of(*rng.uniform(10, 30, 3)) for name in ("white", "ours", "npbg")} for _ in range(6)]
        table = differences(results)
        assert set(table) == {"white", "npbg"}
        for other, row in table.items():
            assert row["flip"] == difference([r["ours"] for r in results], [r[other] for r in results], "flip")
            methods = summarise(results)
            assert row["psnr"]["mean"] == pytest.approx(methods["ours"]["psnr"] - methods[other]["psnr"], abs=1e-4)


class TestIntervals:
    @pytest.mark.parametrize(("count", "kind"), [(8, "normal"), (16, "normal"), (24, "skewed")])
    def test_the_interval_holds_the_true_mean_19_times_in_20(self, count, kind, monkeypatch):
        monkeypatch.setattr(summary, "RESAMPLES", 1000)
        found = [interval(objects(seed, count, kind=kind)) for seed in range(300)]
        assert 0.91 <= np.mean([low <= 0 <= high for low, high in found]) <= 0.98

    def test_views_of_one_object_are_no_evidence_of_their_own(self):
        few = objects(0, 12, views=1)
        assert interval([np.repeat(x, 100) for x in few]) == pytest.approx(interval(few))

    def test_three_objects_are_counted_out_by_hand(self, monkeypatch):
        scores = [np.array([1.0]), np.array([2.0, 4.0]), np.array([np.nan, 9.0])]
        pools = [np.array([1.0]), np.array([2.0, 4.0]), np.array([9.0])]
        means = [np.concatenate(drawn).mean() for drawn in itertools.product(pools, repeat=3)]
        assert interval(scores) == pytest.approx([min(means), max(means)]), "so few: the whole range of the resamples"
        monkeypatch.setattr(summary, "confidence_level", lambda count: 0.6)
        exact = [float(np.quantile(means, level, method="inverted_cdf")) for level in (0.2, 0.8)]
        assert interval(scores) == pytest.approx(exact)

    def test_neither_the_order_of_the_objects_nor_another_call_changes_a_bit(self):
        first, second = objects(1, 20), objects(2, 20)
        order = np.random.default_rng(3).permutation(20)
        mixed = [[scores[i] for i in order] for scores in (first, second)]
        assert interval(mixed[0]) == interval(first)
        assert minus(*mixed) == minus(first, second)

    def test_views_without_a_score_are_left_out_and_objects_without_any(self):
        scores = objects(6, 12)
        holes = [np.append(x, np.nan) for x in scores] + [np.full(2, np.nan)]
        assert interval(holes) == interval(scores)

    def test_one_object_has_no_interval_and_no_test(self):
        assert interval([np.array([1.0, 2.0]), np.array([np.nan])]) is None
        assert minus([np.array([3.0])], [np.array([1.0])]) == {"mean": 2.0, "interval": None, "p_value": None}
        assert minus([np.array([np.nan])], [np.array([1.0])]) is None


class TestDifferences:
    def test_a_difference_is_taken_view_by_view_so_that_hard_objects_cancel(self):
        hard = objects(7, 16)
        better = [10 * x + 0.5 + 0.1 * y for x, y in zip(hard, objects(8, 16), strict=True)]
        worse = [10 * x for x in hard]
        found = minus(better, worse)
        assert 0.3 < found["interval"][0] < found["interval"][1] < 0.7
        assert found["p_value"] < 0.001
        apart = interval(better)
        assert apart[0] < np.mean(worse) < apart[1], "each mean alone could not tell them apart"
        assert minus(worse, better)["mean"] == pytest.approx(-found["mean"])

    def test_the_p_value_of_few_objects_counts_all_sign_flips(self):
        sums = np.array([3.0, 1.0, 2.0, -0.5])
        flips = [np.dot(signs, sums) for signs in itertools.product((-1, 1), repeat=4)]
        expected = np.mean(np.abs(flips) >= sums.sum())
        assert minus([np.array([x]) for x in sums], [np.zeros(1)] * 4)["p_value"] == expected == 4 / 16
        scores = objects(11, 5)
        assert minus(scores, scores) == {"mean": 0.0, "interval": [0.0, 0.0], "p_value": 1.0}
