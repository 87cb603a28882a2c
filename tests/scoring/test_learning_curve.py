import re

import numpy as np

from spnr_jax.scoring.learning_curve import learning_curve_svg, series, smooth

ROWS = [{"step": 10 * i, "loss": 1.0, "psnr": 15 + 0.1 * i} for i in range(60)]
ROWS += [{"step": 300, "val_psnr": 17.0}, {"step": 600, "val_psnr": 18.5}]
FLOORS = {"White image": 12.34, "Base-colour splat": 16.0}


def test_a_series_takes_the_rows_that_have_a_finite_value_in_order():
    rows = [{"step": 1, "psnr": 2.0}, {"step": 2}, {"step": 3, "psnr": None}, {"step": 4, "psnr": float("nan")}]
    steps, values = series([*rows, {"step": 5, "psnr": 3.0}], "psnr")
    np.testing.assert_array_equal(steps, [1, 5])
    np.testing.assert_array_equal(values, [2, 3])
    assert len(series(rows, "val_psnr")[0]) == 0


def test_smoothing_is_the_mean_of_a_centred_window_that_shrinks_at_the_ends():
    values = np.random.default_rng(0).normal(size=150)
    expected = []
    for i in range(150):
        reach = min(3, i, 149 - i)  # 150 / 25 / 2
        expected.append(np.mean([values[j] for j in range(i - reach, i + reach + 1)]))
    np.testing.assert_allclose(smooth(values), expected, atol=1e-12)


def test_the_curve_names_every_line_and_floor_and_nothing_that_the_rows_lack():
    svg = learning_curve_svg(ROWS, FLOORS)
    for text in ("training batches", "validation views", "White image, 12.3 dB", "Base-colour splat, 16.0 dB"):
        assert text in svg
    assert "validation views" not in learning_curve_svg(ROWS[:60], FLOORS)
    assert "training batches" not in learning_curve_svg(ROWS[60:], FLOORS)


def test_floors_are_drawn_at_their_height_on_the_axis():
    svg = learning_curve_svg([{"step": 0, "psnr": 10.0}, {"step": 1, "psnr": 20.0}], {"a": 10.0, "b": 12.5, "c": 20.0})
    level = re.compile(r'<path d="M ([\d.]+) ([\d.]+) \s*L ([\d.]+) \2 \s*" clip-path[^>]*stroke-dasharray')
    bottom, middle, top = (float(match[2]) for match in level.finditer(svg))
    np.testing.assert_allclose(middle, bottom + 0.25 * (top - bottom), atol=1e-3)


def test_the_same_rows_give_the_same_bytes_without_prolog_or_script():
    svg = learning_curve_svg(ROWS, FLOORS)
    assert svg == learning_curve_svg(ROWS, FLOORS)
    assert svg.startswith("<svg")
    assert svg.rstrip().endswith("</svg>")
    assert "<script" not in svg
