"""Depth errors are what their definitions say."""

import numpy as np
import pytest

from experiments.paper import depth_scores, fig3

SIZE = 64
TRUTH = np.full((SIZE, SIZE), np.inf)
TRUTH[20:40, 20:40] = np.linspace(2, 3, 20)[:, None]
INSIDE = np.isfinite(TRUTH)
SEEN = np.where(INSIDE, TRUTH, 9.0)
FAR = np.full((SIZE, SIZE), 4.0)


def score(seen=SEEN, acc=INSIDE * 1.0, truth=TRUTH):
    return depth_scores.score(seen, acc, FAR, truth)


class TestScores:
    def test_the_truth_has_no_error_and_nothing_missing_or_floating(self):
        assert score() == dict.fromkeys(depth_scores.METRICS, 0.0)

    @pytest.mark.parametrize("offset", [0.25, -0.25])
    def test_an_offset_is_the_error_and_its_sign_the_bias(self, offset):
        found = score(SEEN + offset)
        assert found["error"] == found["median"] == found["surface"] == pytest.approx(0.25)
        assert found["bias"] == pytest.approx(offset)

    def test_one_wrong_pixel_moves_the_mean_and_not_the_median(self):
        seen = SEEN.copy()
        seen[30, 30] += 4
        assert score(seen)["error"] == pytest.approx(4 / 400)
        assert score(seen)["median"] == 0

    def test_what_is_not_opaque_is_missed_and_its_depth_does_not_count(self):
        acc = INSIDE * 1.0
        acc[20:25] *= 0.4
        found = score(np.where(acc > 0.5, SEEN, 99.0), acc)
        assert found["missed"] == pytest.approx(0.25)
        assert found["error"] == 0

    def test_opaque_pixels_outside_are_floaters_and_those_off_the_edge_are_far(self):
        acc = INSIDE * 1.0
        acc[18:20, 20:40] = 1.0  # within 1/32 of 64 pixels
        acc[0, :6] = 0.6
        found, outside = score(acc=acc), SIZE**2 - 400
        assert found["floaters"] == pytest.approx(1000 * 46 / outside)
        assert found["far_floaters"] == pytest.approx(1000 * 6 / outside)
        assert found["error"] == found["missed"] == 0

    def test_the_surface_is_what_compositing_mixed_with_the_far_side(self):
        acc = np.where(INSIDE, 0.75, 0.0)
        found = score(acc * SEEN + (1 - acc) * FAR, acc)
        assert found["surface"] == pytest.approx(0, abs=1e-12)
        assert found["error"] == pytest.approx(np.mean(0.25 * (FAR - TRUTH)[INSIDE]))

    def test_an_empty_view_has_floaters_and_a_full_one_has_errors(self):
        nothing = score(truth=np.full((SIZE, SIZE), np.inf), acc=np.ones((SIZE, SIZE)))
        assert nothing["floaters"] == nothing["far_floaters"] == 1000
        assert np.isnan([nothing[name] for name in ("error", "median", "bias", "surface", "missed")]).all()
        full = score(np.full((SIZE, SIZE), 2.0), np.ones((SIZE, SIZE)), np.full((SIZE, SIZE), 2.5))
        assert full["error"] == 0.5
        assert np.isnan([full["floaters"], full["far_floaters"]]).all()

    def test_a_summary_leaves_out_views_without_a_number(self):
        views = [{name: np.array([1.0, np.nan]) for name in depth_scores.METRICS} for _ in range(2)]
        assert depth_scores.summarise(views)["error"] == {"mean": 1.0, "interval": [1.0, 1.0]}
        nothing = [{name: np.array([np.nan]) for name in depth_scores.METRICS}]
        assert depth_scores.summarise(nothing)["error"] == {"mean": None, "interval": None}


def test_errors_are_grey_floaters_red_and_what_is_missed_blue():
    acc = INSIDE * 1.0
    acc[0, 0], acc[20, 20] = 1, 0
    seen = SEEN.copy()
    seen[30, 30] += fig3.WORST / 2
    picture = fig3.error_image(seen, acc, TRUTH)
    np.testing.assert_array_equal(picture[0, 0], fig3.FLOATER)
    np.testing.assert_array_equal(picture[20, 20], fig3.MISSED)
    np.testing.assert_allclose(picture[30, 30], 0.5)
    np.testing.assert_array_equal(picture[[5, 25], [5, 25]], 1)
