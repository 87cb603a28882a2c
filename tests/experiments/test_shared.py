"""What every experiment stands on: networks, scores, tables, a folder that goes on."""

import dataclasses
import io
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from support import tiny_dataset

from experiments.comparison import contenders, results_folder, scores, study_objects, variants
from experiments.paper import fig3
from experiments.studies import inverse
from spnr_jax.formats import data_sets
from spnr_jax.scoring import evaluation
from spnr_jax.training import weights
from spnr_jax.training.gbuffers import average_squares

ROOT = Path(__file__).parents[2]


def test_the_false_alarms_of_cached_programs_are_hidden_before_jax_is_imported():
    code = "import os, sys, experiments; print('jax' in sys.modules, os.environ['TF_CPP_MIN_LOG_LEVEL'])"
    environment = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "False 3\n"


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.json", {"b": [1, 2.5]}), ("a.png", np.zeros((2, 3, 3), np.uint8))],
)
def test_what_was_made_is_read_and_not_made_again(name, content, tmp_path):
    calls = []
    for _ in range(2):
        found = results_folder.load_or_make(tmp_path / "in" / name, lambda: calls.append(1) or content)
        for a, b in zip(found, content, strict=True):
            np.testing.assert_array_equal(a, b)
    assert calls == [1]


def test_a_folder_is_one_requests_of_one_data_set(tmp_path):
    dataset = tiny_dataset.dataset()
    for _ in range(2):
        results_folder.claim(tmp_path, "scores", {"seed": 0, "objects": ("a", "b")}, dataset)
    with pytest.raises(ValueError, match="holds scores with another seed; choose another --out"):
        results_folder.claim(tmp_path, "scores", {"seed": 1, "objects": ["a", "b"]}, dataset)
    with pytest.raises(ValueError, match="holds scores; choose another --out"):
        results_folder.claim(tmp_path, "pictures", {"seed": 0, "data": "another"})
    for change in ({"settings": {"views": 99}}, {"splits": dataset.splits | {"test": ()}}):
        with pytest.raises(ValueError, match="holds scores with another data; choose another --out"):
            results_folder.claim(tmp_path, "scores", {"seed": 0}, dataclasses.replace(dataset, **change))


def test_a_picture_that_was_not_kept_is_drawn(tmp_path):
    dataset, names, calls = tiny_dataset.dataset(), tiny_dataset.SPLITS["test"][:2], []
    rows = {"a/b": lambda item: calls.append(item.name) or ({"x": 1.0}, np.zeros((2, 2, 3), np.uint8))}
    for _ in range(2):
        assert scores.measure_rows(tmp_path, rows, dataset, names, names[:1]) == {"a/b": [{"x": 1.0}] * 2}
    for name in (*names, *names):
        scores.picture_of(tmp_path, "a/b", rows["a/b"], dataset, name)
    assert calls == [*names, names[1]]


def test_a_gallery_names_the_scores_below_its_pictures():
    white = np.ones((8, 8, 3))
    shown = [scores.Shown(name="a", view=0, reference=white, images={"ours": white})]
    scored = scores.Scored(scores={"a": {"ours": {"psnr": np.array([20.0])}}}, shown=shown, seconds={})
    with Image.open(io.BytesIO(variants.gallery({"ours": "Ours"}, scored, {"psnr": "PSNR"}))) as picture:
        below = np.asarray(picture)[-12:]
    assert all((of < 255).any() for of in (below[:, 110:238], below[:, 242:]))


def test_a_cut_object_has_its_first_points_and_views_in_averaged_pictures():
    item = tiny_dataset.one_object()
    small = study_objects.cut(item, 7, 2, tiny_dataset.SIZE // 2)
    assert (small.cloud.positions == item.cloud.positions[:7]).all()
    assert small.cloud.normals is None
    assert len(small.images) == len(small.camera.cam_to_world) == 2
    assert small.camera.height == tiny_dataset.SIZE // 2
    np.testing.assert_array_equal(small.images[1], average_squares(item.images[1], 2))
    with pytest.raises(ValueError, match="^23 pixels along a side are not"):
        study_objects.cut(item, resolution=tiny_dataset.SIZE - 1)


def test_small_pictures_are_enlarged_and_the_reference_itself_is_right():
    item = tiny_dataset.one_object()
    white, opacity = data_sets.on_white(item.images), item.images[..., 3] / np.float32(255)
    found = scores.mean_scores(scores.score_views(item, evaluation.Pictures(image=white, acc=opacity[:, ::2, ::2])))
    assert (found["psnr"], found["psnr_inside"], found["flip"]) == pytest.approx((100, 100, 0), abs=1e-3)
    assert found["iou"] > 0.8
    assert scores.mean_scores({"a": [1.0, np.nan], "b": [np.nan]}) == {"a": 1.0, "b": None}


def test_what_cannot_be_compared_is_refused_by_name(monkeypatch):
    monkeypatch.setattr(weights, "load", lambda run: SimpleNamespace(config=SimpleNamespace(method=run)))
    assert list(fig3.all_methods(("paper", "npbg"))) == ["paper"]
    with pytest.raises(ValueError, match="--runs: none of these predicts depth"):
        fig3.all_methods(("npbg",))
    dataset = tiny_dataset.dataset()
    with pytest.raises(ValueError, match="the test split is empty"):
        study_objects.test_objects(dataclasses.replace(dataset, splits={"test": ()}), None, 1)
    with pytest.raises(ValueError, match=r"4,097 points of an object .* are there; .* generate it with --points 4097"):
        study_objects.test_objects(dataset, None, 4097)
    with pytest.raises(ValueError, match="5 pixels along a side are not a whole share of the data set's"):
        study_objects.test_objects(dataset, None, 1, None, 5)


def test_gradients_are_shown_of_the_objects_that_were_compared_alone():
    _, apart = inverse.make_tables({}, {"light": [[2.0, 1.0]]}, ["ball", "ring"])
    assert (apart.heads, apart.rows[0][1][0].text) == (("ball",), "100.0000")


def test_a_run_that_was_trained_further_is_another_network(monkeypatch):
    params = {"a": np.zeros(3), "b": np.ones(2)}
    monkeypatch.setattr(weights, "load", lambda run: SimpleNamespace(params=params))
    before = contenders.checksums(("one", "two"))
    assert before["one"] == before["two"]
    params["a"][1] = 1e-9
    assert contenders.checksums(("one",))["one"] != before["one"]
