"""Scores are those of the metrics called by hand on the files' pictures; nothing is left out unsaid."""

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_dataset
from laws import close
from tiny_dataset import CONFIG

from spnr_jax import checkpoint, data, evaluation, metrics, training
from spnr_jax.baselines import floors

NAMES = tiny_dataset.SPLITS["test"]
FACTORS = {"splat": 1.5, "nearest": 0.75}


@pytest.fixture(scope="module")
def outcome():
    return evaluation.evaluate(tiny_dataset.run(), tiny_dataset.dataset(), say=lambda line: None)


@pytest.fixture(scope="module")
def results():
    variables = training.averaged_variables(checkpoint.restore(tiny_dataset.run(), CONFIG))
    return list(evaluation.evaluate_objects(variables, CONFIG, tiny_dataset.dataset(), NAMES, FACTORS))


def test_scores_are_those_of_the_metrics_called_by_hand(results):
    for name, result in zip(NAMES, results, strict=True):
        item = data.read_object(tiny_dataset.dataset(), name)
        reference, mask = (jnp.asarray(x) for x in (data.on_white(item.images), item.conditions[..., 3] > 0))
        for method in evaluation.METHODS:
            image = jnp.asarray(result.images[method])
            assert 0 <= image.min() <= image.max() <= 1
            scores = result.scores[method]
            close(scores.psnr, -10 * np.log10(np.mean((image - reference) ** 2, axis=(1, 2, 3))), rtol=1e-4)
            close(scores.ssim, metrics.ssim(image, reference), atol=1e-4)
            close(scores.cpsnr, metrics.conditional_psnr(image, reference, mask), rtol=1e-4)
        assert np.all(result.images["white"] == 1)


def test_the_floors_are_those_of_the_same_points_and_cameras(results):
    item = data.read_object(tiny_dataset.dataset(), NAMES[0])
    cloud = jax.tree.map(jnp.asarray, evaluation.test_cloud(item, CONFIG))
    for method, factor in FACTORS.items():
        view = jax.tree.map(lambda x: jnp.asarray(x[1]), item.camera)
        image, _ = getattr(floors, method)(cloud, view, factor * floors.spacing(cloud))
        close(results[0].images[method][1], image, atol=1e-5)


def test_opacity_is_compared_at_the_size_of_the_reference(results):
    item = data.read_object(tiny_dataset.dataset(), NAMES[0])
    assert results[0].acc.shape[1:] == (8, 8)
    white = results[0].scores["white"].iou
    assert np.all(white == 0), "an empty picture overlaps with nothing"
    assert np.all(results[0].scores["nearest"].iou > 0.3)
    assert len(white) == len(item.images)


def test_a_summary_is_the_mean_over_all_images_with_its_counts(outcome, results):
    assert set(outcome.summary["methods"]) == set(evaluation.METHODS)
    for table in outcome.summary["methods"].values():
        assert table["objects"] == len(NAMES)
        assert table["views"] == len(NAMES) * tiny_dataset.VIEWS
    ours = np.concatenate([result.scores["ours"].psnr for result in results])
    assert outcome.summary["methods"]["ours"]["psnr"] == pytest.approx(ours.mean(), abs=1e-4)
    assert outcome.summary["steps"] == CONFIG.num_steps
    assert set(outcome.summary["settings"]["radius factors"].values()) <= set(evaluation.RADIUS_FACTORS)


def scores_of(*values, cpsnr):
    row = np.array(values, np.float32)
    return evaluation.Scores(psnr=row, ssim=row / 100, cpsnr=np.array(cpsnr, np.float32), iou=row / 50)


def test_an_image_without_visible_points_is_left_out_of_its_mean_alone_and_counted():
    one, two = scores_of(10, 20, cpsnr=[np.nan, 12]), scores_of(30, cpsnr=[14])
    table = evaluation.summarise([dict.fromkeys(evaluation.METHODS, one), dict.fromkeys(evaluation.METHODS, two)])
    assert table["ours"]["psnr"] == 20, "mean over images, not over objects"
    assert (table["ours"]["cpsnr"], table["ours"]["cpsnr_views"], table["ours"]["views"]) == (13, 2, 3)


def test_no_visible_point_at_all_is_no_number():
    none = dict.fromkeys(evaluation.METHODS, scores_of(10, cpsnr=[np.nan]))
    assert evaluation.summarise([none])["white"]["cpsnr"] is None


def test_categories_come_from_the_names_and_add_up(outcome):
    assert set(outcome.per_category) == {"ball", "cube", "meshes"}
    counts = [table["ours"]["objects"] for table in outcome.per_category.values()]
    assert sum(counts) == outcome.summary["methods"]["ours"]["objects"]
    names = ("chair_000012", "office_chair_000012", "chair", "chair_12", "b_0000123")
    assert [evaluation.category_of(n) for n in names] == ["chair", "office_chair", "meshes", "meshes", "meshes"]


def test_the_radius_is_the_one_that_scores_best_on_training_objects(monkeypatch):
    asked = []
    real = data.read_object
    monkeypatch.setattr(data, "read_object", lambda dataset, name: asked.append(name) or real(dataset, name))
    chosen = evaluation.choose_radius(tiny_dataset.dataset(), CONFIG, "splat", num_objects=2)
    assert set(asked) == set(tiny_dataset.SPLITS["train"][:2])
    items = [real(tiny_dataset.dataset(), name) for name in tiny_dataset.SPLITS["train"][:2]]

    def score(factor):
        values = []
        for item in items:
            image, _ = evaluation.render_floor("splat", evaluation.test_cloud(item, CONFIG), item.camera, factor)
            values.append(np.mean(metrics.psnr(image, jnp.asarray(data.on_white(item.images)))))
        return np.mean(values)

    assert score(chosen) == max(score(factor) for factor in evaluation.RADIUS_FACTORS)


def test_the_test_points_are_always_the_first_ones():
    item = data.read_object(tiny_dataset.dataset(), NAMES[0])
    cloud = evaluation.test_cloud(item, CONFIG)
    np.testing.assert_array_equal(cloud.positions, item.cloud.positions[: CONFIG.test_points])
    assert len(evaluation.test_cloud(item, dataclasses.replace(CONFIG, test_points=10**6)).positions) == len(
        item.cloud.positions
    )


def test_the_gallery_holds_as_many_objects_as_asked_first_and_last_among_them():
    few = evaluation.evaluate(tiny_dataset.run(), tiny_dataset.dataset(), gallery_objects=2, say=lambda line: None)
    assert [result.name for result in few.gallery] == [NAMES[0], NAMES[-1]]
    assert few.summary["methods"]["ours"]["objects"] == len(NAMES)


def test_objects_of_one_view_are_evaluated_although_training_draws_two(tmp_path):
    copy = shutil.copytree(tiny_dataset.dataset().folder, tmp_path / "data")
    item = data.read_object(data.open_dataset(copy), NAMES[0])
    config = dataclasses.replace(CONFIG, views_per_object=len(item.images) + 1)
    variables = training.averaged_variables(checkpoint.restore(tiny_dataset.run(), CONFIG))
    (result,) = evaluation.evaluate_objects(variables, config, data.open_dataset(copy), NAMES[:1], FACTORS)
    assert len(result.scores["ours"].psnr) == tiny_dataset.VIEWS


@pytest.mark.parametrize(("split", "expected"), [("test", "the test split is empty"), ("train", "no training objects")])
def test_an_empty_split_is_an_error_that_names_it(split, expected, tmp_path):
    copy = shutil.copytree(tiny_dataset.dataset().folder, tmp_path / "data")
    (copy / "splits" / f"{split}.txt").write_text("")
    with pytest.raises(ValueError, match=expected):
        evaluation.evaluate(tiny_dataset.run(), data.open_dataset(copy), say=lambda line: None)


def test_a_run_without_a_checkpoint_says_how_to_go_on(tmp_path):
    checkpoint.write_config(tmp_path, CONFIG)
    with pytest.raises(ValueError, match="no checkpoint yet; go on with `spnr train"):
        evaluation.evaluate(tmp_path, tiny_dataset.dataset())
