"""Depth errors are what their definitions say, and the command measures depths against the mesh, once."""

import importlib.util
import json

import numpy as np
import pytest
from support import stand_ins, tiny_dataset
from support.handmade import ball
from support.surfel_clouds import cloud
from support.tiny_runs import forbidden

from data_gen.render.poisson_surface import PoissonConfig
from experiments.comparison import trained_networks
from experiments.paper import depth_scores, fig3
from experiments.paper.fig3 import Fig3
from spnr_jax import cli
from spnr_jax.formats import data_sets
from spnr_jax.formats.mesh.assets import Asset

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


@pytest.fixture(autouse=True)
def _no_cache(monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)


def painted_ball(*_):
    """What the tiny data set's pictures show, as a mesh."""
    return Asset(parts=(ball(radius=tiny_dataset.RADIUS, rows=64),))


def asked(out, **options):
    return Fig3(data=tiny_dataset.dataset().folder, out=out, **({"quick": True, "variant": "scalar_rgb"} | options))


def show(patch, *labels, **identity):
    patch.setattr(trained_networks, "networks", lambda *_: stand_ins.stand_ins(*labels, **identity))


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fig3")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fig3, "mesh_of", painted_ball)
        patch.setattr(cli, "set_up_jax", lambda **_: None)
        show(patch, "Ours", "NPBG")
        fig3.main(asked(folder))
    return folder


def test_the_error_of_a_depth_behind_the_mesh_is_how_far_it_lies_behind(out):
    results = json.loads((out / "results.json").read_text())
    assert list(results["methods"]) == ["Ours"]  # the other one predicts no depth
    found = results["methods"]["Ours"]
    for name in ("error", "median", "bias", "surface"):
        assert found[name]["mean"] == pytest.approx(stand_ins.OFFSET, abs=3e-3)
        assert found[name]["interval"][0] == pytest.approx(stand_ins.OFFSET, abs=3e-3)
    assert found["missed"]["mean"] == found["far_floaters"]["mean"] == 0
    assert results["pixels"] == {"Ours": tiny_dataset.SIZE}


def test_a_second_call_makes_nothing_again_and_gives_the_same(out, monkeypatch):
    before = (out / "results.json").read_bytes()
    monkeypatch.setattr(fig3, "true_depth", forbidden)
    monkeypatch.setattr(stand_ins.StandIn, "show", forbidden)
    show(monkeypatch, "Ours")
    fig3.main(asked(out))
    assert (out / "results.json").read_bytes() == before


@pytest.mark.skipif(importlib.util.find_spec("pymeshlab") is None, reason="pymeshlab is not installed")
def test_a_poisson_surface_of_many_points_has_the_depth_of_the_ball():
    dataset = tiny_dataset.dataset()
    item = data_sets.read_object(dataset, dataset.splits["test"][0])
    normals = np.random.default_rng(0).normal(size=(800, 3)).astype(np.float32)
    positions = tiny_dataset.RADIUS * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    seen, acc = fig3.of_surface(PoissonConfig(depth=5)).show(item, cloud(positions))
    expected, opaque = stand_ins.disc(tiny_dataset.SIZE)
    assert np.mean(acc == opaque) > 0.95
    both = (acc > 0) & (opaque > 0) & (expected < expected.min() + 0.3)
    np.testing.assert_allclose(seen[both] + stand_ins.OFFSET, np.tile(expected, (3, 1, 1))[both], atol=0.05)
    line = data_sets.first_points(item, 1)
    assert not fig3.of_surface(PoissonConfig(depth=5)).show(item, line)[1].any()


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
