"""Every method is scored on clouds of each size, once; points that a data set lacks come from the mesh."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import stand_ins, tiny_dataset
from support.handmade import RED, ball, plain
from support.tiny_runs import forbidden

from experiments.comparison import trained_networks
from experiments.studies import point_count
from experiments.studies.point_count import PointCount, cloud_of, main
from spnr_jax import cli
from spnr_jax.formats import data_sets
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.scoring import evaluation, summary

pytestmark = pytest.mark.ci  # it trains several networks

NAMES = tiny_dataset.SPLITS["test"]
COUNTS = (8, 16, 64)
STORED = tiny_dataset.POINTS
FLOORS = ["Nearest-point shading", "Base-colour splat", "White image"]


def mesh(*_):
    """What the tiny data set's pictures show."""
    return Asset(parts=(ball(radius=tiny_dataset.RADIUS, material=plain(RED, 0.3)),))


@pytest.fixture(scope="module", autouse=True)
def _stand_ins():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "set_up_jax", lambda **_: None)
        patch.setattr(trained_networks, "networks", lambda *_: stand_ins.stand_ins("Ours", "NPBG"))
        patch.setattr(evaluation, "choose_radius", lambda *_: 1.5)
        patch.setattr(point_count, "mesh_of", mesh)
        patch.setattr(point_count, "details", lambda *_: {"seeds": {"points": 5}})
        yield


def asked(out, **options):
    return PointCount(data=tiny_dataset.dataset().folder, out=out, **({"counts": COUNTS} | options))


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("points")
    main(asked(folder))
    return folder


def test_a_cloud_holds_the_first_points_and_beyond_those_new_ones_of_the_mesh():
    dataset = tiny_dataset.dataset()
    item = data_sets.read_object(dataset, NAMES[0])
    np.testing.assert_array_equal(cloud_of(dataset, item, 16, None).positions, item.cloud.positions[:16])
    many = cloud_of(dataset, item, 300, None)
    assert many.mask.shape == (300,)
    assert many.mask.all()
    np.testing.assert_allclose(np.linalg.norm(many.positions, axis=1), tiny_dataset.RADIUS, rtol=0.05)
    np.testing.assert_allclose(many.base_color, np.tile(np.float32(RED), (300, 1)))
    assert {x.dtype for x in jax.tree.leaves(many)} == {np.dtype("float32"), np.dtype("bool")}


def test_the_curves_are_the_scores_of_the_evaluation_at_each_count(out):
    results = json.loads((out / "results.json").read_text())
    assert list(results["curves"]) == ["Ours", "NPBG", *FLOORS]
    assert results["counts"] == list(COUNTS)
    dataset, scores = tiny_dataset.dataset(), []
    for name in NAMES:
        item = data_sets.read_object(dataset, name)
        shown = evaluation.floor("splat", 1.5)(data_sets.first_points(item, 16), item.camera)
        scores.append(evaluation.score_pictures(item, shown))
    for metric in point_count.METRICS:
        values = [np.asarray(row[metric], np.float64) for row in scores]
        (point,) = [p for p in results["curves"]["Base-colour splat"][metric] if p["points"] == 16]
        assert point["mean"] == pytest.approx(np.mean(values), rel=1e-6)
        assert point["interval"] == pytest.approx(summary.interval(values), rel=1e-6)


def test_a_method_without_opacity_has_no_curve_of_it(out):
    results = json.loads((out / "results.json").read_text())
    assert set(results["curves"]["NPBG"]) == {"psnr", "flip"}


def test_classes_have_the_means_of_their_objects_and_the_best_method_is_counted(out):
    objects = {"chair_000001": (20.0, 10.0), "chair_000002": (24.0, 30.0), "sofa_000003": (15.0, 25.0)}
    scores = {
        label: {name: {"psnr": [values[i] - 1, values[i] + 1]} for name, values in objects.items()}
        for i, label in enumerate("ab")
    }
    assert point_count.by_class(scores) == {
        "chair": {"objects": 2, "psnr": {"a": 22.0, "b": 20.0}, "best on": {"a": 1, "b": 1}},
        "sofa": {"objects": 1, "psnr": {"a": 15.0, "b": 25.0}, "best on": {"a": 0, "b": 1}},
    }
    results = json.loads((out / "results.json").read_text())
    assert results["class points"] == 16  # nearest to 24
    for label, curves in results["curves"].items():
        found = results["classes"]
        total = sum(found[name]["psnr"][label] * found[name]["objects"] for name in found) / len(NAMES)
        assert total == pytest.approx(curves["psnr"][1]["mean"], rel=1e-6)


def test_what_was_measured_is_not_measured_again(out, tmp_path, monkeypatch):
    before = (out / "results.json").read_bytes()
    measure = point_count.measure
    monkeypatch.setattr(point_count, "measure", forbidden)
    main(asked(out))
    assert (out / "results.json").read_bytes() == before
    calls = []

    def stopped(*arguments):
        calls.append(arguments)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return measure(*arguments)

    monkeypatch.setattr(point_count, "measure", stopped)
    with pytest.raises(KeyboardInterrupt):
        main(asked(tmp_path))
    main(asked(tmp_path))
    assert (tmp_path / "results.json").read_bytes() == before
    assert len(calls) == len(NAMES) * len(COUNTS) * (2 + len(FLOORS)) + 2  # of the stopped count two were lost


def test_counts_that_cannot_be_had_are_left_out_with_the_reason(monkeypatch, capsys, tmp_path):
    def absent(*_):
        raise ValueError("object chair was made from chair.obj: give the folder of the meshes with --meshes")

    monkeypatch.setattr(point_count, "mesh_of", absent)
    dataset = tiny_dataset.dataset()
    assert point_count.available_counts(asked(tmp_path), dataset, NAMES[0]) == [8, 16]
    said = capsys.readouterr().out
    assert f"left out 64 points: the data set holds {STORED} an object, and object chair was made from" in said
    assert "--meshes" in said
    assert point_count.available_counts(asked(tmp_path, counts=(64,)), dataset, NAMES[0]) == [STORED]


def test_a_method_compiles_once_for_all_objects_of_a_count():
    traces = []

    @jax.jit
    def images(cloud, poses):
        traces.append(cloud)
        grey = jnp.mean(cloud.base_color) + 0 * poses[:, :1, :1]
        acc = jnp.broadcast_to(grey, (len(poses), tiny_dataset.SIZE, tiny_dataset.SIZE))
        return jnp.stack([acc] * 3, axis=-1), acc

    def show(item):
        image, acc = images(item.cloud, item.camera.cam_to_world)
        return evaluation.Pictures(image=image, acc=acc)

    for name in NAMES:
        point_count.measure(tiny_dataset.dataset(), name, point_count.Method(show=show, identity={}), 64, None)
    assert len(traces) == 1
