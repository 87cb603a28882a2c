"""Intervals hold the truth as often as they say, whatever the order of the objects; they are exact where countable."""

import itertools

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from spnr_jax.scoring import intervals
from spnr_jax.scoring.intervals import difference, interval


def objects(seed: int, count: int, views: int = 4, kind: str = "normal") -> list[np.ndarray]:
    """Scores of objects around 0: what all views of an object share, and a little noise for each."""
    rng = np.random.default_rng(seed)
    shared = rng.normal(size=count) if kind == "normal" else rng.exponential(size=count) - 1
    return list(shared[:, None] + 0.3 * rng.normal(size=(count, views)))


@pytest.mark.parametrize(("count", "kind"), [(8, "normal"), (16, "normal"), (24, "skewed"), (60, "normal")])
def test_the_interval_holds_the_true_mean_19_times_in_20(count, kind, monkeypatch):
    monkeypatch.setattr(intervals, "RESAMPLES", 1000)
    intervals._draws.cache_clear()
    found = [interval(objects(seed, count, kind=kind)) for seed in range(400)]
    intervals._draws.cache_clear()
    assert 0.92 <= np.mean([low <= 0 <= high for low, high in found]) <= 0.98


def test_views_of_one_object_are_no_evidence_of_their_own():
    few = objects(0, 12, views=1)
    low, high = interval(few)
    assert interval([np.repeat(x, 100) for x in few]) == pytest.approx((low, high))


def test_three_objects_are_counted_out_by_hand(monkeypatch):
    scores = [np.array([1.0]), np.array([2.0, 4.0]), np.array([np.nan, 9.0])]
    pools = [np.array([1.0]), np.array([2.0, 4.0]), np.array([9.0])]
    means = [np.concatenate(drawn).mean() for drawn in itertools.product(pools, repeat=3)]
    levels = intervals._levels(3)
    expected = np.quantile(means, levels, method="inverted_cdf")
    assert levels[0] < 1e-6, "three objects: the whole range of the resamples"
    assert interval(scores) == pytest.approx(tuple(expected))
    for level in (0.1, 0.35, 0.5, 0.8):  # in the middle of the steps of the 27 means
        monkeypatch.setattr(intervals, "_levels", lambda count, level=level: (level, level))
        exact = float(np.quantile(means, level, method="inverted_cdf"))
        assert interval(scores) == pytest.approx((exact, exact))


def test_the_levels_approach_95_percent_from_outside():
    lows = [intervals._levels(count)[0] for count in (3, 10, 100, 10**6)]
    assert lows == sorted(lows)
    assert lows[-1] == pytest.approx(0.025, abs=1e-5)
    assert sum(intervals._levels(7)) == 1


def test_the_order_of_the_objects_does_not_matter():
    first, second = objects(1, 20), objects(2, 20)
    order = np.random.default_rng(3).permutation(20)
    mixed = [[scores[i] for i in order] for scores in (first, second)]
    assert interval(mixed[0]) == interval(first)
    assert difference(*mixed) == difference(first, second)


def test_the_same_seed_gives_the_same_interval_and_another_nearly():
    scores = objects(4, 20)
    assert interval(scores, seed=1) == interval(scores, seed=1)
    assert interval(scores, seed=1) != interval(scores, seed=2)
    assert interval(scores, seed=1) == pytest.approx(interval(scores, seed=2), abs=0.03)


def test_shifting_and_scaling_scores_shifts_and_scales_the_interval():
    scores = objects(5, 15)
    low, high = interval(scores)
    assert interval([2 * x + 7 for x in scores]) == pytest.approx((2 * low + 7, 2 * high + 7))


def test_equal_scores_have_an_interval_without_width():
    assert interval([np.full(3, 2.5)] * 5) == pytest.approx((2.5, 2.5))


def test_views_without_a_score_are_left_out_and_objects_without_any():
    scores = objects(6, 12)
    holes = [np.append(x, np.nan) for x in scores] + [np.full(2, np.nan)]
    assert interval(holes) == interval(scores)


def test_one_object_has_no_interval_and_no_test():
    assert interval([np.array([1.0, 2.0])]) is None
    assert interval([np.array([1.0, 2.0]), np.array([np.nan])]) is None
    alone = difference([np.array([3.0])], [np.array([1.0])])
    assert (alone.mean, alone.interval, alone.p_value) == (2.0, None, None)
    assert difference([np.array([np.nan])], [np.array([1.0])]) is None


def test_a_difference_is_taken_view_by_view_so_that_hard_objects_cancel():
    hard = objects(7, 16)
    better = [10 * x + 0.5 + 0.1 * y for x, y in zip(hard, objects(8, 16), strict=True)]
    worse = [10 * x for x in hard]
    found = difference(better, worse)
    low, high = found.interval
    assert low > 0.3
    assert high < 0.7
    assert found.p_value < 0.001
    apart = interval(better)
    assert apart[0] < np.mean(worse) < apart[1], "each mean alone could not tell them apart"
    swapped = difference(worse, better)
    assert swapped.mean == pytest.approx(-found.mean)
    assert swapped.p_value == pytest.approx(found.p_value, abs=0.002)


def test_the_p_value_of_few_objects_counts_all_sign_flips():
    sums = np.array([3.0, 1.0, 2.0, -0.5])
    flips = [np.dot(signs, sums) for signs in itertools.product((-1, 1), repeat=4)]
    expected = np.mean(np.abs(flips) >= sums.sum())
    assert difference([np.array([x]) for x in sums], [np.zeros(1)] * 4).p_value == expected == 4 / 16


def test_the_p_value_is_near_that_of_a_t_test_on_normal_differences():
    for seed, shift in ((9, 0.0), (10, 0.5)):
        changes = np.random.default_rng(seed).normal(shift, 1, 30)
        found = difference([np.array([x]) for x in changes], [np.zeros(1)] * 30)
        assert found.p_value == pytest.approx(ttest_1samp(changes, 0).pvalue, abs=0.02)


def test_no_difference_at_all_is_certain_to_be_no_difference():
    for count in (5, 30):
        scores = objects(11, count)
        found = difference(scores, scores)
        assert (found.mean, found.interval, found.p_value) == (0.0, (0.0, 0.0), 1.0)
