"""Scores are those of the metrics called by hand on the files' pictures; nothing is left out unsaid."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset, tiny_untrained
from support.laws import close
from support.tiny_untrained import CONFIG

from spnr_jax.formats import data_sets
from spnr_jax.kernels import metrics
from spnr_jax.scoring import evaluation, floors
from spnr_jax.scoring.picture_scores import flip
from spnr_jax.scoring.summary import METRICS
from spnr_jax.training import checkpoint, optimisation, trainer, weights

NAMES = tiny_dataset.SPLITS["test"]
ssim, cpsnr = jax.jit(metrics.ssim), jax.jit(metrics.conditional_psnr)
FACTORS = {"splat": 1.5, "nearest": 0.75}


def methods():
    variables = optimisation.averaged_variables(checkpoint.restore(tiny_untrained.run(), CONFIG))
    trivial = {name: evaluation.floor(name, FACTORS.get(name, 1.0)) for name in evaluation.FLOORS}
    return {"paper": evaluation.network(variables, CONFIG), **trivial}


@pytest.fixture(scope="module")
def outcome():
    return tiny_untrained.evaluated()


@pytest.fixture(scope="module")
def results():
    shown, dataset = methods(), tiny_dataset.dataset()
    return [evaluation.evaluate_object(shown, CONFIG, data_sets.read_object(dataset, name)) for name in NAMES]


def test_scores_are_those_of_the_metrics_called_by_hand(results):
    for name, result in zip(NAMES, results, strict=True):
        item = data_sets.read_object(tiny_dataset.dataset(), name)
        reference, mask = (jnp.asarray(x) for x in (data_sets.on_white(item.images), item.conditions[..., 3] > 0))
        assert list(result.scores) == ["paper", "white", "splat", "nearest"]
        for method, scores in result.scores.items():
            assert set(scores) == set(METRICS) - {"lpips"}
            image = jnp.asarray(result.pictures[method].image)
            assert 0 <= image.min() <= image.max() <= 1
            close(scores["psnr"], -10 * np.log10(np.mean((image - reference) ** 2, axis=(1, 2, 3))), rtol=1e-4)
            close(scores["ssim"], ssim(image, reference), atol=1e-4)
            close(scores["cpsnr"], cpsnr(image, reference, mask), rtol=1e-4)
            close(scores["flip"], flip(image, reference), atol=1e-5)
        assert np.all(result.pictures["white"].image == 1)


def test_the_floors_are_those_of_the_same_points_and_cameras(results):
    item = data_sets.read_object(tiny_dataset.dataset(), NAMES[0])
    cloud = jax.tree.map(jnp.asarray, data_sets.test_cloud(item, CONFIG))
    for method, factor in FACTORS.items():
        view = jax.tree.map(lambda x: jnp.asarray(x[1]), item.camera)
        image, _ = jax.jit(getattr(floors, method))(cloud, view, factor * jax.jit(floors.spacing)(cloud))
        close(results[0].pictures[method].image[1], image, atol=1e-5)


def test_opacity_is_compared_at_the_size_of_the_reference(results):
    pictures, scores = results[0].pictures, results[0].scores
    assert pictures["paper"].acc.shape[1:] == pictures["paper"].depth.shape[1:] == (8, 8)
    assert pictures["splat"].depth is None
    assert np.all(scores["white"]["iou"] == 0), "an empty picture overlaps with nothing"
    assert np.all(scores["nearest"]["iou"] > 0.3)


def test_a_summary_is_the_mean_over_all_images_with_its_counts(outcome, results):
    assert set(outcome.summary["methods"]) == {"paper", *evaluation.FLOORS}
    assert set(outcome.summary["paper_minus"]) == set(evaluation.FLOORS)
    for table in outcome.summary["methods"].values():
        assert table["objects"] == len(NAMES)
        assert table["views"] == len(NAMES) * tiny_dataset.VIEWS
    ours = np.concatenate([result.scores["paper"]["psnr"] for result in results])
    assert outcome.summary["methods"]["paper"]["psnr"] == pytest.approx(ours.mean(), abs=1e-4)
    assert outcome.summary["steps"] == 0
    assert set(outcome.summary["settings"]["radius factors"].values()) <= set(evaluation.RADIUS_FACTORS)


def test_networks_are_compared_under_the_names_that_they_are_given(monkeypatch):
    trained, dataset = weights.read_trained(tiny_untrained.run()), tiny_dataset.dataset()
    monkeypatch.setattr(evaluation, "choose_radius", lambda *_: 1.0)
    one = dataclasses.replace(dataset, splits=dataset.splits | {"test": NAMES[:1]})
    summary = evaluation.compare({"ours": trained, "paper": trained}, one, say=lambda line: None).summary
    assert list(summary["methods"]) == ["ours", "paper", *evaluation.FLOORS]
    assert summary["methods"]["ours"] == summary["methods"]["paper"]
    assert summary["ours_minus"]["paper"]["psnr"]["mean"] == 0
    assert summary["settings"]["networks"] == dict.fromkeys(("ours", "paper"), {"preset": "tiny", "steps": 0})


def test_categories_come_from_the_names_and_add_up(outcome):
    assert set(outcome.per_category) == {"ball", "cube", "meshes"}
    counts = [table["paper"]["objects"] for table in outcome.per_category.values()]
    assert sum(counts) == outcome.summary["methods"]["paper"]["objects"]
    names = ("chair_000012", "office_chair_000012", "chair", "chair_12", "b_0000123")
    assert [evaluation.category_of(n) for n in names] == ["chair", "office_chair", "meshes", "meshes", "meshes"]


def test_the_radius_is_the_one_that_scores_best_on_training_objects(monkeypatch):
    real, asked = data_sets.read_object, []
    monkeypatch.setattr(data_sets, "read_object", lambda dataset, name: asked.append(name) or real(dataset, name))
    chosen = evaluation.choose_radius(tiny_dataset.dataset(), CONFIG, "splat", num_objects=2)
    assert set(asked) == set(tiny_dataset.SPLITS["train"][:2])
    items = [real(tiny_dataset.dataset(), name) for name in tiny_dataset.SPLITS["train"][:2]]

    def score(factor, item):
        image, _ = evaluation.render_floor("splat", data_sets.test_cloud(item, CONFIG), item.camera, factor)
        return np.mean(metrics.psnr(image, jnp.asarray(data_sets.on_white(item.images))))

    means = {factor: np.mean([score(factor, item) for item in items]) for factor in evaluation.RADIUS_FACTORS}
    assert means[chosen] == max(means.values())


@pytest.mark.parametrize(
    ("split", "expected"),
    [
        ("test", "test split is empty; score --split train or --split val, or generate .* --test-objects N"),
        ("train", "no training objects"),
    ],
)
def test_an_empty_split_is_an_error_that_names_it(split, expected, tmp_path):
    copy = shutil.copytree(tiny_dataset.dataset().folder, tmp_path / "data")
    (copy / "splits" / f"{split}.txt").write_text("")
    with pytest.raises(ValueError, match=expected):
        evaluation.evaluate(tiny_untrained.run(), data_sets.open_dataset(copy), say=lambda line: None)


def test_an_lpips_that_can_be_measured_is_in_the_scores_of_each_method(monkeypatch):
    monkeypatch.setattr(evaluation, "lpips", lambda image, reference: np.abs(image - reference).mean(axis=(1, 2, 3)))
    asked = {"white": evaluation.floor("white")}
    result = evaluation.evaluate_object(asked, CONFIG, data_sets.read_object(tiny_dataset.dataset(), NAMES[0]))
    close(result.scores["white"]["lpips"], (1 - result.reference).mean(axis=(1, 2, 3)), rtol=1e-4)


UNKNOWN = "not known whether seen in training"
EXPOSURE = [  # starts that the record of a run names, split, what may be said
    ([{}, {}], "test", "unseen in training"),
    ([{}, {}], "train", "seen in training"),
    ([], "test", UNKNOWN),
    ([{}, {"data_checksum": "another"}], "test", UNKNOWN),
    ([{"init": "small, 9 steps"}], "test", UNKNOWN),
    ([{"init": "small, 9 steps"}], "train", "seen in training"),
]


def recorded(folder, *starts):
    folder.mkdir()
    here = {"data_checksum": trainer.checksum(tiny_dataset.dataset())}
    (folder / "run.json").write_text(json.dumps({"starts": [here | start for start in starts]}))
    return folder


@pytest.mark.parametrize(("starts", "split", "expected"), EXPOSURE)
def test_a_report_says_that_objects_are_unseen_by_the_record_of_the_run_alone(starts, split, expected, tmp_path):
    dataset, run = tiny_dataset.dataset(), recorded(tmp_path / "run", *starts)
    assert evaluation.exposure((run,), dataset, dataset.splits[split]) == expected


def test_of_several_runs_and_objects_the_least_favourable_counts(tmp_path):
    dataset, run = tiny_dataset.dataset(), recorded(tmp_path / "run", {})
    train = dataset.splits["train"]
    assert evaluation.exposure((run,), dataset, (*NAMES, train[0])) == "seen in training"
    assert evaluation.exposure((run, run), dataset, NAMES) == "unseen in training"
    assert evaluation.exposure((run, tmp_path), dataset, NAMES) == evaluation.exposure((), dataset, NAMES) == UNKNOWN
    assert evaluation.exposure((tmp_path, run), dataset, train) == "seen in training"


def test_objects_are_spread_from_the_first_to_the_last():
    assert evaluation.spread(tuple("abcdefg"), 3) == ("a", "d", "g")
    assert evaluation.spread(tuple("ab"), 5) == ("a", "b")
    assert evaluation.spread(("a",), 0) == ()
