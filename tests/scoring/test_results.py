"""metrics.json has the form that other programs rely on, and the report shows the median view."""

import dataclasses
import json

import numpy as np
import pytest
from support import tiny_dataset, tiny_untrained

from spnr_jax.scoring import results
from spnr_jax.scoring.score_tables import METHODS
from spnr_jax.scoring.summary import METRICS

NUMBERS = {"objects", "views", "cpsnr_views", *METRICS, *(f"{metric}_interval" for metric in METRICS)}

ROWS = [{"step": step, "loss": 1.0, "psnr": 12.0 + step} for step in range(6)] + [{"step": 6, "val_psnr": 15.0}]


@pytest.fixture(scope="module")
def outcome():
    return tiny_untrained.evaluated()


def written(out, outcome):
    results.write_results(out, outcome, {"seed": 0}, ROWS, {"evaluate": 1.5, "total": 2.0})

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads((out / "metrics.json").read_text(), parse_constant=refuse)


def test_metrics_json_has_exactly_these_keys(outcome, tmp_path):
    metrics = written(tmp_path, outcome)
    assert set(metrics) == {
        "methods", "paper_minus", "seconds", "preset", "steps", "seed", "hardware", "settings", "per_category",
    }  # fmt: skip
    assert set(metrics["methods"]) == {"paper", "white", "splat", "nearest"}
    assert all(set(values) == NUMBERS for values in metrics["methods"].values())
    assert (metrics["preset"], metrics["steps"], metrics["seed"]) == ("tiny", 0, 0)
    assert metrics["seconds"] == {"evaluate": 1.5, "total": 2.0}
    assert isinstance(metrics["hardware"], str)


def test_a_cpsnr_that_does_not_exist_is_null_and_the_report_is_written(outcome, tmp_path):
    methods = {name: values | {"cpsnr": None, "cpsnr_views": 0} for name, values in outcome.summary["methods"].items()}
    metrics = written(tmp_path, dataclasses.replace(outcome, summary=outcome.summary | {"methods": methods}))
    assert metrics["methods"]["paper"]["cpsnr"] is None
    assert ">nan" not in (tmp_path / "report.html").read_text().lower()


def test_a_number_that_is_not_finite_is_refused_instead_of_written(outcome, tmp_path):
    broken = dataclasses.replace(outcome, summary=outcome.summary | {"steps": float("nan")})
    with pytest.raises(ValueError, match="not JSON compliant"):
        written(tmp_path, broken)
    assert not (tmp_path / "metrics.json").exists()


def test_the_report_is_one_file_that_names_the_objects_and_the_best_floor(outcome, tmp_path):
    metrics = written(tmp_path, outcome)
    page = (tmp_path / "report.html").read_text()
    for name in tiny_dataset.SPLITS["test"]:
        assert name in page
    best = max(("white", "splat", "nearest"), key=lambda name: metrics["methods"][name]["psnr"])
    assert f"best trivial renderer ({best})" in page
    found = metrics["paper_minus"][best]["psnr"]
    assert (
        f"{found['mean']:+.2f} dB [{found['interval'][0]:+.2f}, {found['interval'][1]:+.2f}] against the best" in page
    )
    assert page.count("n/a (no weights)") >= 4


def test_the_table_for_a_terminal_has_a_line_for_each_method_and_says_what_is_missing(outcome):
    methods = outcome.summary["methods"]
    lines = results.text_table(methods)
    assert [line.partition("  ")[0] for line in lines] == [METHODS[name] for name in methods]
    for line, row in zip(lines, methods.values(), strict=True):
        assert f"PSNR {row['psnr']:.2f} " in line
        assert f"FLIP {row['flip']:.3f} " in line
        assert "LPIPS n/a (no weights)" in line


def test_a_gallery_row_is_the_view_of_the_median_psnr(outcome):
    result = outcome.gallery[0]
    psnr = np.array([30.0, 10.0, 20.0], np.float32)
    scores = result.scores | {"paper": result.scores["paper"] | {"psnr": psnr}}
    row = results.gallery_row(dataclasses.replace(result, scores=scores))
    np.testing.assert_array_equal(row.reference, result.reference[2])
    assert set(row.images) == {"paper", "splat", "nearest"}
    for method, image in row.images.items():
        np.testing.assert_array_equal(image, result.pictures[method].image[2])
    np.testing.assert_array_equal(row.depth, result.pictures["paper"].depth[2])
