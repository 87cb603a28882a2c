"""G-buffers on disk follow from object, cloud and source, batches from (seed, step); mirrored pairs stay pairs."""

import dataclasses
import os
import shutil
import signal
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import surfel_clouds, tiny_surfels
from support.laws import close, same_bits
from support.stopped_runs import PICTURE, interrupted, rows_without_time
from support.tiny_surfels import CONFIG, LIGHT, NAME, SCHEDULE

from spnr_jax.formats import data_sets
from spnr_jax.kernels.cameras import pinhole
from spnr_jax.kernels.records import Crops, PointCloud
from spnr_jax.method import surfel_method
from spnr_jax.method.surfel_method import encode_in_box
from spnr_jax.nn import shader
from spnr_jax.scoring import evaluation
from spnr_jax.surfels import lighting
from spnr_jax.surfels.sides import DIRECTIONS, spiral
from spnr_jax.training import checkpoint, gbuffers, optimisation, trainer, weights

pytestmark = pytest.mark.ci
AXES = pytest.mark.parametrize("axis", [0, 1])


@partial(jax.jit, static_argnames="config")
def loss(params, crops, config=CONFIG):
    value, outcome = gbuffers.loss({"params": params}, crops, config=config)
    return value, outcome.metrics


def made(seed, number):
    item = data_sets.read_object(tiny_surfels.dataset(), NAME)
    return gbuffers.make_views(item, number, LIGHT, dataclasses.replace(CONFIG, seed=seed), {})


def test_a_file_is_what_its_seed_object_and_cloud_make_of_it():
    one, two = sorted({view.path for view in tiny_surfels.views()})
    with np.load(one) as file, np.load(two) as other:
        again = made(CONFIG.seed, 0)
        assert {*again, "source"} == set(file)
        assert all(np.array_equal(again[name], file[name]) for name in again)
        for different in (other, made(CONFIG.seed + 1, 0)):
            assert not np.array_equal(different.get("inputs0"), file["inputs0"])


def test_clouds_have_normals_of_their_file_or_of_all_its_points_or_none():
    ball = spiral(800).astype(np.float32)
    flat = {name: np.full(len(ball), 0.5, np.float32) for name in ("roughness", "metallic")}
    whole = PointCloud(positions=ball, mask=np.ones(len(ball), bool), base_color=np.abs(ball), normals=ball, **flat)
    clouds = [
        gbuffers.random_cloud(whole, 1, dataclasses.replace(CONFIG, max_points=200), np.random.default_rng(seed))
        for seed in range(50)
    ]
    told = [cloud for cloud in clouds if cloud.normals is not None]
    agree = np.array([np.median(np.sum(cloud.normals * cloud.positions, axis=1)) for cloud in told])
    assert 0.08 < 1 - len(told) / len(clouds) < 0.28, "a sixth are files of few points without normals"
    assert np.quantile(agree, 0.1) > 0.9, "outward, of scans too"
    for cloud in clouds:
        assert 32 <= len(cloud.positions) <= 200
        assert np.abs(cloud.positions).max() <= 1
        assert {x.dtype for name, x in vars(cloud).items() if x is not None and name != "mask"} == {np.dtype("f4")}


def test_a_file_cut_off_by_a_crash_is_made_again_and_no_other_one_and_one_that_breaks_later_is_named(tmp_path):
    views = tiny_surfels.views()
    folder = shutil.copytree(views[0].path.parent, tmp_path / "gbuffers")
    broken = folder / views[0].path.name
    whole = broken.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    written = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    again = gbuffers.make_missing(tiny_surfels.dataset(), LIGHT, CONFIG, folder, {})
    assert [view._replace(path=view.path.name) for view in again] == [v._replace(path=v.path.name) for v in views]
    assert broken.read_bytes() == whole
    assert {path for path in folder.iterdir() if path.stat().st_mtime_ns != written[path]} == {broken}
    broken.write_bytes(whole[:-30])
    with pytest.raises(ValueError, match=r"npz: is a broken.*remove it"):
        gbuffers.read_view(gbuffers.KeptView(broken, 0, 0))


def test_files_made_of_something_else_are_made_again(monkeypatch, tmp_path):
    dataset, made = tiny_surfels.dataset(), []
    folder = shutil.copytree(tiny_surfels.views()[0].path.parent, tmp_path / "gbuffers")
    monkeypatch.setattr(gbuffers, "make_views", lambda *_: made.append(1) or {"doublings": np.zeros(1, np.int64)})
    changes = [
        {"config": dataclasses.replace(CONFIG, **x)} for x in ({"seed": 1}, {"even_share": 0.1}, {"max_points": 39})
    ]
    changes += [{"light": 2 * LIGHT}, {"variables": {"densifier": np.ones(1, np.float32)}}]
    changes += [{"dataset": dataclasses.replace(dataset, settings=dataset.settings | {"spp": 9})}]
    given = {"dataset": dataset, "light": LIGHT, "config": CONFIG, "folder": folder, "variables": {}}
    for change in changes:
        gbuffers.make_missing(**given)
        before = len(made)
        for _ in range(2):
            gbuffers.make_missing(**given | change)
        assert len(made) == before + gbuffers.CLOUDS, change
    gbuffers.make_missing(**given)
    before = len(made)
    monkeypatch.setattr(gbuffers, "read_record", lambda *_: b"of another mesh")
    gbuffers.make_missing(**given)
    assert len(made) == before + gbuffers.CLOUDS


def test_a_stop_while_g_buffers_are_made_ends_the_run_at_once(monkeypatch, tmp_path):
    made = []

    def make(*_):
        made.append(1)
        os.kill(os.getpid(), signal.SIGINT)
        return {"doublings": np.zeros(1, np.int64)}

    monkeypatch.setattr(gbuffers, "make_views", make)
    with pytest.raises(KeyboardInterrupt):
        trainer.train(CONFIG, tiny_surfels.dataset(), tmp_path, SCHEDULE, light=LIGHT)
    assert len(made) == 1
    assert not (tmp_path / "metrics.jsonl").exists()


def test_batches_are_a_function_of_seed_and_step():
    views = tiny_surfels.views()
    whole = list(gbuffers.batches(views, CONFIG, 0))
    assert len(whole) == CONFIG.num_steps
    for a, b in zip(gbuffers.batches(views, CONFIG, 2), whole[2:], strict=True):
        assert a.doublings == b.doublings
        same_bits(a, b)
    other = next(gbuffers.batches(views, dataclasses.replace(CONFIG, seed=1), 0))
    assert other.doublings != whole[0].doublings or not np.array_equal(other.inputs, whole[0].inputs)


def test_steps_meet_every_resolution_in_its_share_with_crops_of_its_size(monkeypatch):
    kept, config, steps = tiny_surfels.views()[0], dataclasses.replace(CONFIG, crop=48), []
    view = gbuffers.read_view(kept)
    monkeypatch.setattr(gbuffers, "read_view", lambda _: view)
    monkeypatch.setattr(gbuffers, "crop_square", lambda view, *sizes: steps[-1].append(sizes[:3]) or view)
    for step in range(400):
        steps.append([])
        gbuffers.make_batch({doublings: [kept] for doublings in range(5)}, config, step)
    doublings = [int(np.log2(crops[0][2])) for crops in steps]
    np.testing.assert_allclose(np.bincount(doublings) / 400, gbuffers.SHARES, atol=0.06)
    expected = {(48, 0, 1), (36, 2, 2), (24, 4, 4), (24, 7, 8), (16, 5, 16)}
    assert {tuple(crops) for crops in steps} == {(sizes, sizes) for sizes in expected}


@pytest.mark.parametrize("margin", [0, 3])
def test_a_crop_shows_the_same_place_in_what_is_seen_and_in_the_reference(margin):
    rows, columns = np.mgrid[:7, :9]
    place = (10 * rows + columns + 1)[..., None]
    fine = np.repeat(np.repeat(place, 4, axis=0), 4, axis=1)
    view = {"inputs": place / 100, "maps": place, "light_harmonics": np.zeros((9, 3)), "target": fine.astype(np.uint8)}
    for seed in range(8):
        crop = gbuffers.crop_square(view, 8 + 2 * margin, margin, 4, np.random.default_rng(seed))
        inner = slice(margin, margin + 8)
        assert crop["inputs"].shape == (8 + 2 * margin, 8 + 2 * margin, 1)
        np.testing.assert_allclose(100 * crop["inputs"][inner, inner], crop["target"][::4, ::4], atol=1e-4)
        assert np.isin(np.round(100 * crop["inputs"]), [0, *place.ravel()]).all()
        np.testing.assert_array_equal(crop["maps"], crop["target"][2::4, 2::4])
        assert (crop["maps"][7] == 0).all(), "the view has seven rows"


def test_a_smaller_reference_is_the_mean_of_what_is_seen_on_white():
    image = np.random.default_rng(3).integers(0, 256, (8, 12, 4), np.uint8)
    means = data_sets.on_white(image).reshape(2, 4, 3, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(data_sets.on_white(gbuffers.average_squares(image, 4)), means, atol=1.1 / 255)
    np.testing.assert_array_equal(gbuffers.average_squares(image, 1)[image[..., 3] > 0], image[image[..., 3] > 0])


@pytest.fixture(scope="module")
def crops():
    return next(iter(gbuffers.batches(tiny_surfels.views(), CONFIG, 0)))


@pytest.fixture(scope="module")
def params():
    return optimisation.jitted_create_state(CONFIG).generator


@AXES
def test_mirroring_leaves_the_loss_of_the_untrained_network_as_it_is_and_is_its_own_inverse(axis, params):
    kept = tiny_surfels.views()[0]
    view = gbuffers.read_view(kept)
    whole = gbuffers.crop_square(view, max(view["inputs"].shape[:2]), 0, 2**kept.doublings, np.random.default_rng(0))
    turned = gbuffers.mirror(whole, axis)
    losses = [
        loss(
            params,
            Crops(**{name: x[None] for name, x in one.items()}, doublings=kept.doublings),
        )[0]
        for one in (whole, turned)
    ]
    np.testing.assert_allclose(*losses, rtol=1e-5)
    assert not np.array_equal(whole["inputs"], turned["inputs"])
    same_bits(gbuffers.mirror(turned, axis), whole)


@AXES
def test_a_mirrored_object_is_seen_as_the_mirrored_view(axis):
    """Every number of it: the signs of vectors, which the untrained network does not look at, too."""
    rng, mirror = np.random.default_rng(5), np.where(np.arange(3) == axis, -1, 1).astype(np.float32)
    normal = rng.normal(size=(60, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rim, reach = surfel_clouds.tangents(normal)[0], rng.uniform(0.3, 2, (60, 4)).astype(np.float32)
    color = rng.random((60, 3), np.float32)
    pose = jnp.concatenate([jnp.eye(3), jnp.array([[0.0], [0.0], [3.0]])], axis=1)
    camera, seen = pinhole(pose, 0.7, 24, 24), []
    for sign in (np.ones(3, np.float32), mirror):
        columns = {"base_color": color, "color_jump": color[:, ::-1] - color, "shape_ratios": color[:, :2]}
        columns |= {"roughness": color[:, 0], "metallic": color[:, 1], "materials_unknown": color[:, 2]}
        columns |= {"learned": color[:, 0], "rim_tangent": rim * sign}
        surfels = surfel_clouds.surfels(
            0.8 * normal * sign, normal * sign, 0.4, **columns,
            color_edge=np.concatenate([rim * sign, np.full((60, 1), 0.1, np.float32)], axis=1),
            visibility=np.maximum((normal * sign) @ DIRECTIONS.T, 0),
            rim_distances=reach if sign.min() > 0 else reach[:, [0, 1, 3, 2]],  # normal x rim is not mirrored
        )  # fmt: skip
        seen.append(np.asarray(gbuffers.prepare_view(surfels, camera, LIGHT, capacity=2**14, slots=24 * 24)[0]))
    view = {"inputs": seen[0], "maps": seen[0], "target": seen[0], "light_harmonics": np.zeros((9, 3))}
    np.testing.assert_allclose(gbuffers.mirror(view, axis)["inputs"], seen[1], atol=0.05)
    assert np.abs(seen[1][..., shader.ODD[axis]]).mean() > 0.1


@AXES
def test_harmonics_of_the_mirrored_light_are_the_mirrored_ones(axis):
    towards = np.random.default_rng(2).normal(size=(3, 50)).astype(np.float32)
    towards /= np.linalg.norm(towards, axis=0)
    turned = towards * np.where(np.arange(3) == axis, -1, 1)[:, None].astype(np.float32)
    view = {name: np.zeros((2, 2, shader.NUM_FEATURES)) for name in ("inputs", "maps", "target")}
    basis = np.stack(lighting.harmonics(*jnp.asarray(towards)))
    expected = gbuffers.mirror(view | {"light_harmonics": basis}, axis)["light_harmonics"]
    close(np.stack(lighting.harmonics(*jnp.asarray(turned))), expected, atol=1e-6)


def test_points_too_far_apart_for_the_reference_teach_nothing_and_too_near_ones_are_drawn_at_its_size():
    item = data_sets.read_object(tiny_surfels.dataset(), NAME)
    camera = jax.tree.map(lambda x: x[0], item.camera)
    scene = encode_in_box(item.cloud)
    far, near = (dataclasses.replace(scene, spacing=spacing) for spacing in (3.0, 0.01))
    assert gbuffers.make_view(far, camera, item.images[0], 1, LIGHT) is None  # G-buffers of three pixels
    doublings, view = gbuffers.make_view(near, camera, item.images[0], 1, LIGHT)
    assert doublings == 0
    assert view["inputs"].shape[:2] == view["target"].shape[:2]


def test_a_clear_pixel_costs_nothing_whatever_colour_lies_under_it(crops, params):
    maps = np.array(crops.maps)
    maps[..., 4] = 0  # opacity
    clear = dataclasses.replace(crops, maps=maps, target=np.zeros_like(crops.target))
    assert float(loss(params, clear, config=CONFIG)[0]) < 1e-6


def test_steps_lower_the_loss_on_one_object(crops):
    config = dataclasses.replace(CONFIG, num_steps=100)
    state, losses = optimisation.jitted_create_state(config), []
    for _ in range(60):
        state, metrics = optimisation.jitted_train_step(state, crops, config=config)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < 0.7 * losses[0]
    assert float(loss(state.averaged, crops, config=config)[0]) < losses[0]


def test_the_loss_is_the_sum_of_its_weighted_errors(crops, params):
    value, metrics = loss(params, crops, config=CONFIG)
    terms = {}
    names = "l1_weight", "mse_weight", "opacity_weight", "opacity_l1_weight"
    for name in names:
        weights = dataclasses.replace(CONFIG.loss, **(dict.fromkeys(names, 0.0) | {name: 1.0}))
        terms[name] = float(loss(params, crops, config=dataclasses.replace(CONFIG, loss=weights))[0])
    assert min(terms.values()) > 0
    assert float(value) == pytest.approx(sum(getattr(CONFIG.loss, name) * terms[name] for name in names), rel=1e-5)
    assert terms["l1_weight"] == pytest.approx(float(metrics["l1"]))
    assert terms["opacity_weight"] == pytest.approx(float(metrics["mse_opacity"]))


def test_a_stopped_run_goes_on_to_the_same_bits_and_rows_from_densified_clouds(monkeypatch, tmp_path):
    densified = []
    monkeypatch.setattr(
        surfel_method, "densify_sparse", lambda variables, cloud, *_: densified.append(variables.keys()) or cloud
    )
    monkeypatch.setattr(trainer, "preview", lambda *_: ({"val_psnr": 20.0}, PICTURE))
    with monkeypatch.context() as patch:
        interrupted(patch, gbuffers, 3)
        with pytest.raises(KeyboardInterrupt, match="stopped at step 3 of 4"):
            trainer.train(CONFIG, tiny_surfels.dataset(), tmp_path, SCHEDULE, light=LIGHT)
    assert not (tmp_path / "weights.npz").exists()
    trainer.train(CONFIG, tiny_surfels.dataset(), tmp_path, SCHEDULE, light=LIGHT)
    assert all("densifier" in names for names in densified)
    assert len(densified) == gbuffers.CLOUDS
    same_bits(checkpoint.restore(tmp_path, CONFIG), checkpoint.restore(tiny_surfels.run(), CONFIG))
    assert rows_without_time(tmp_path) == rows_without_time(tiny_surfels.run())
    assert (tmp_path / "weights.npz").read_bytes() == (tiny_surfels.run() / "weights.npz").read_bytes()


def test_the_room_is_the_light_where_a_data_set_names_no_other_one():
    dataset = tiny_surfels.dataset()
    dataset.check_lit_by_room()
    other = dataclasses.replace(dataset, settings={"environment_map": {"name": "forest.hdr"}})
    for learn_or_score in (
        lambda: gbuffers.prepare(CONFIG, other, Path("run"), light=None),
        lambda: evaluation.compare({"surfels": weights.read_trained(tiny_surfels.untrained())}, other, "train"),
    ):
        with pytest.raises(ValueError, match=r"lit by forest\.hdr"):
            learn_or_score()
    gbuffers.prepare(CONFIG, other, Path("run"), light=LIGHT)
