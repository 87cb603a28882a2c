"""Sharpness and relighting: the whole of both studies on one ball, and what their scores are of known pictures."""

import json
import shutil

import numpy as np
import pytest
from support import tiny_dataset, tiny_surfels
from support.tiny_runs import goes_on

from data_gen.store import layout
from experiments.studies import relighting, sharpness
from spnr_jax.formats import data_sets
from spnr_jax.scoring.picture_scores import under_true_opacity

SPLITS = {"train": (), "val": (), "test": ("ball_000000",)}


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    """A data set of one ball whose views have a light of their own, as `spnr-data generate --lights` writes it."""
    folder = tiny_dataset.write_dataset(tmp_path_factory.mktemp("lit") / "set", SPLITS, tiny_surfels.SIZE)
    lights = np.random.default_rng(0).random((tiny_dataset.VIEWS, 32, 64, 3), np.float32)
    (folder / "objects" / "ball_000000" / "lights.npz").write_bytes(layout.encode_lights(lights))
    settings = json.loads((folder / "dataset.json").read_text())
    settings["environment_map"] = {"kinds": [{"name": "maps", "sha256": {"sky_1k.hdr": "0"}}]}
    (folder / "dataset.json").write_text(json.dumps(settings))
    return folder


@pytest.mark.ci
def test_the_sharpness_study_ends_with_a_table_and_pictures_and_goes_on_where_it_stopped(tmp_path):
    folder = tiny_dataset.write_dataset(tmp_path / "set", SPLITS, tiny_surfels.SIZE)
    right = tmp_path / "right"  # pictures of another program that are the references
    for count in (16, 32):
        shutil.copytree(folder / "objects" / "ball_000000" / "images", right / str(count) / "ball_000000")
    options = sharpness.SharpnessStudy(
        data=folder,
        out=tmp_path / "out",
        runs=(str(tiny_surfels.run()),),
        counts=(16, 32),
        views=1,
        elsewhere=(right,),
    )
    sharpness.main(options)
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert len(results["objects"]) == len(results["known"]) == 6  # network, discs and right, two numbers of points
    assert results["objects"]["right, 32"][0]["psnr"] == pytest.approx(100, abs=1e-3)
    assert results["objects"]["right, 32"][0]["outline_rmse"] == pytest.approx(0, abs=1e-6)
    scores = next(iter(results["objects"].values()))[0]
    assert np.isfinite([scores[name] for name in ("psnr", "psnr_inside", "outline_rmse", "encode", "render")]).all()
    assert (tmp_path / "out" / "gallery.png").is_file()
    assert (tmp_path / "out" / "ball_000000.png").is_file()
    goes_on(sharpness.main, options)


@pytest.mark.ci
def test_the_relighting_study_scores_each_light_and_refuses_data_without_lights(lit, tmp_path):
    options = {"run": str(tiny_surfels.run()), "counts": (32,), "views": 2}
    relighting.main(relighting.RelightingStudy(data=(lit,), out=tmp_path / "out", **options))
    results = json.loads((tmp_path / "out" / "results.json").read_text())["objects"]
    assert list(results) == [f"sky_1k, 32, {method}" for method in relighting.METHODS]
    assert np.isfinite(list(results.values())).all()
    assert (tmp_path / "out" / "gallery.png").is_file()
    with pytest.raises(ValueError, match="no light of their own"):
        relighting.name_of(tiny_surfels.dataset())


def test_each_view_of_a_lit_data_set_has_its_light(lit):
    item = data_sets.read_object(data_sets.open_dataset(lit), "ball_000000")
    assert item.lights.shape == (len(item.images), 32, 64, 3)
    assert len(item.own_lights) == len(item.images)


def test_colours_under_the_true_opacity_are_those_of_the_nearest_pixel_that_is_covered():
    reference = np.zeros((32, 32, 4), np.float32)
    reference[8:24, 8:24] = 0.2, 0.4, 0.6, 1
    white = reference[..., :3] * reference[..., 3:] + 1 - reference[..., 3:]
    found = under_true_opacity(white, reference[..., 3], reference)
    np.testing.assert_allclose(found, white, atol=1e-6)
    opacity = reference[..., 3].copy()
    opacity[12:16, 8:16] = 0.05  # a hole, and half of an outline that is missing
    torn = reference[..., :3] * opacity[..., None] + 1 - opacity[..., None]
    np.testing.assert_allclose(under_true_opacity(torn, opacity, reference), white, atol=1e-6)
    nothing = under_true_opacity(np.ones_like(white), np.zeros((32, 32), np.float32), reference)
    assert np.isfinite(nothing).all()


def test_scores_of_a_picture_that_is_right_and_of_one_half_as_bright():
    reference = np.ones((32, 32, 4), np.float32)
    reference[..., :3] = 0.6
    right = relighting.scores(reference[..., :3], reference[..., 3], reference)
    assert right == pytest.approx([100.0, 100.0, 0.0, 0.0], abs=1e-3)
    linear = ((0.6 + 0.055) / 1.055) ** 2.4 / 2
    dim = np.full((32, 32, 3), 1.055 * linear ** (1 / 2.4) - 0.055, np.float32)
    assert relighting.scores(dim, reference[..., 3], reference)[3] == pytest.approx(np.log(2), abs=1e-3)
