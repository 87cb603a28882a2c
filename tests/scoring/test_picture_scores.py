"""FLIP is a number a picture, LPIPS is asked for as its package wants it; means are over images, None where there is no
number, and intervals hold the truth as often as they say."""

import contextlib
import itertools
import sys
import types

import numpy as np
import pytest
from support.laws import close, numbers

from experiments.studies.sharpness import under_true_opacity
from spnr_jax.scoring import picture_scores
from spnr_jax.scoring.picture_scores import (
    difference,
    differences,
    flip,
    interval,
    lpips,
    summarise,
)

IMAGE = np.asarray(numbers(0, 2, 3, 40, 36, 3, low=0.0))
REFERENCE = np.clip(IMAGE + 0.3 * np.asarray(numbers(1, 2, 3, 40, 36, 3)), 0, 1)


@pytest.fixture
def package(monkeypatch):
    """Packages that stand in for `lpips` and `torch`: the distance is the mean of the absolute differences."""

    class Network:
        def eval(self):
            return self

        def __call__(self, shown, wanted):
            assert shown.shape == wanted.shape == (6, 3, 40, 36)
            assert shown.dtype == np.float32
            assert shown.min() < -0.9
            assert shown.max() > 0.9
            distance = np.abs(shown - wanted).mean(axis=(1, 2, 3), keepdims=True)
            return types.SimpleNamespace(numpy=lambda: distance)

    torch = types.SimpleNamespace(from_numpy=lambda values: values, no_grad=contextlib.nullcontext)
    found = types.SimpleNamespace(LPIPS=lambda net, verbose: Network())
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setitem(sys.modules, "lpips", found)
    picture_scores.lpips_network.cache_clear()
    yield found
    picture_scores.lpips_network.cache_clear()


def test_flip_is_a_number_a_picture_whatever_the_batch():
    found = flip(IMAGE, REFERENCE)
    assert found.shape == (2, 3)
    assert flip(IMAGE[1, 2], REFERENCE[1, 2]) == found[1, 2]
    assert ((found > 0.01) & (found < 1)).all()
    close(flip(REFERENCE, IMAGE), found, atol=1e-6)


def test_flip_of_equal_pictures_is_0_and_greys_differ_by_their_lightness_alone():
    black, white = np.zeros((20, 20, 3)), np.ones((20, 20, 3))
    assert flip(IMAGE[0, 0], IMAGE[0, 0]) == 0
    lab_green, lab_blue = (87.735, -86.183, 83.180), (32.297, 79.188, -107.860)  # published L*a*b* of sRGB, D65
    chroma = np.hypot(*(lab_green[0] * lab_green[i] - lab_blue[0] * lab_blue[i] for i in (1, 2))) / 100
    largest = (lab_green[0] - lab_blue[0] + chroma) ** 0.7
    assert flip(black, white) == pytest.approx(0.95 + 0.05 * (100**0.7 / largest - 0.4) / 0.6, abs=1e-4)


def test_lpips_sees_views_of_channels_first_from_minus_1_to_1_and_is_missing_without_its_package(package, monkeypatch):
    close(lpips(IMAGE, REFERENCE), 2 * np.abs(IMAGE - REFERENCE).mean(axis=(2, 3, 4)), atol=1e-6)
    assert lpips(IMAGE[..., :31, :, :], REFERENCE[..., :31, :, :]) is None, "too few pixels"

    def offline(net, verbose):
        raise OSError("no way to the weights")

    monkeypatch.setattr(package, "LPIPS", offline)
    for _ in ("without its weights", "without the package"):
        picture_scores.lpips_network.cache_clear()
        assert lpips(IMAGE, REFERENCE) is None
        monkeypatch.setitem(sys.modules, "lpips", None)


def test_colours_under_the_true_opacity_are_those_of_the_nearest_pixel_that_is_covered():
    reference = np.zeros((32, 32, 4), np.float32)
    reference[8:24, 8:24] = 0.2, 0.4, 0.6, 1
    white = reference[..., :3] * reference[..., 3:] + 1 - reference[..., 3:]
    found = under_true_opacity(white, reference[..., 3], reference[..., 3])
    np.testing.assert_allclose(found, white, atol=1e-6)
    opacity = reference[..., 3].copy()
    opacity[12:16, 8:16] = 0.05  # a hole, and half of an outline that is missing
    torn = reference[..., :3] * opacity[..., None] + 1 - opacity[..., None]
    np.testing.assert_allclose(under_true_opacity(torn, opacity, reference[..., 3]), white, atol=1e-6)
    nothing = under_true_opacity(np.ones_like(white), np.zeros((32, 32), np.float32), reference[..., 3])
    assert np.isfinite(nothing).all()


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
    @pytest.mark.parametrize(("count", "kind"), [(5, "normal"), (16, "normal"), (24, "skewed")])
    def test_the_interval_holds_the_true_mean_19_times_in_20(self, count, kind, monkeypatch):
        monkeypatch.setattr(picture_scores, "RESAMPLES", 1000)
        found = [interval(objects(seed, count, kind=kind)) for seed in range(300)]
        assert 0.91 <= np.mean([low <= 0 <= high for low, high in found]) <= 0.98

    def test_views_of_one_object_are_no_evidence_of_their_own(self):
        few = objects(0, 12, views=1)
        assert interval([np.repeat(x, 100) for x in few]) == pytest.approx(interval(few))

    def test_three_objects_are_counted_out_by_hand(self, monkeypatch):
        found = [np.array([1.0]), np.array([2.0, 4.0]), np.array([np.nan, 9.0])]
        pools = [np.array([1.0]), np.array([2.0, 4.0]), np.array([9.0])]
        means = [np.concatenate(drawn).mean() for drawn in itertools.product(pools, repeat=3)]
        assert interval(found) is None, "the whole range of the resamples would be too narrow"
        monkeypatch.setattr(picture_scores, "FEWEST_OBJECTS", 3)
        monkeypatch.setattr(picture_scores, "confidence_level", lambda count: 0.6)
        exact = [float(np.quantile(means, level, method="inverted_cdf")) for level in (0.2, 0.8)]
        assert interval(found) == pytest.approx(exact)

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
