"""Figure 2: colour variants beside their objects, and two trainings that differ in the training split alone."""

import numpy as np
import pytest
from support import tiny_dataset
from support.tiny_runs import check_conditions, results_of, shrunken

from experiments.comparison.variants import Budget
from experiments.paper.fig2 import Fig2, main, nearest_views, trainings
from spnr_jax import cli
from spnr_jax.formats import data_sets

pytestmark = pytest.mark.ci  # it trains several networks

TRAIN = ("ball_000000", "ball_000000--1", "ball_000000--2", "ball_000001", "ball_000001--1", "cube_000000")


@pytest.fixture(scope="module", autouse=True)
def _shrunken():
    with shrunken():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set with colour variants."""
    return tiny_dataset.write_dataset(tmp_path_factory.mktemp("fig2") / "data", tiny_dataset.SPLITS | {"train": TRAIN})


@pytest.fixture(scope="module")
def out(folder, tmp_path_factory):
    place = tmp_path_factory.mktemp("fig2") / "out"
    main(Fig2(data=folder, out=place, budget=Budget(quick=True)))
    return place


def test_both_trainings_are_scored_on_the_same_objects(out):
    results = results_of(out)
    assert {name: row["training_objects"] for name, row in results["variants"].items()} == {"without": 3, "with": 6}
    assert results["reference"] == "without"
    assert set(results["minus_reference"]["with"]) >= {"psnr", "flip"}
    assert results["minus_reference"]["with"]["psnr"]["mean"] != 0
    assert (out / "variants.png").read_bytes().startswith(b"\x89PNG")
    check_conditions(out)


def test_the_trainings_differ_in_the_training_split_alone(folder):
    dataset = data_sets.open_dataset(folder)
    plain, whole = trainings(Fig2(out=folder, data=folder), dataset)
    assert plain.config == whole.config
    assert whole.dataset == dataset
    assert plain.dataset.splits == dataset.splits | {"train": ("ball_000000", "ball_000001", "cube_000000")}


def test_a_data_set_without_variants_is_refused_with_the_command_that_makes_one(tmp_path, capsys):
    options = Fig2(data=tiny_dataset.dataset().folder, out=tmp_path)
    assert cli.guarded(lambda: main(options), "fig2") == 2
    assert "spnr-data generate DIR --colour-variants 5" in capsys.readouterr().err


def test_the_nearest_views_look_from_the_same_side():
    angles = np.radians([[0, 90, 180], [95, 200, 300], [270, 10, 88]])
    eyes = [3 * np.stack([np.sin(a), 0 * a, np.cos(a)], axis=-1) for a in angles]
    assert nearest_views(eyes) == [1, 0, 2]
