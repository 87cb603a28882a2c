"""Scores are those of the metrics called by hand on the files' pictures; nothing is left out unsaid."""

import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference, surfel_clouds, tiny_dataset, tiny_untrained
from support.laws import close
from support.tiny_untrained import CONFIG

from spnr_jax.formats import data_sets
from spnr_jax.kernels import metrics
from spnr_jax.kernels.cameras import look_at, project
from spnr_jax.kernels.imaging import linear_to_srgb
from spnr_jax.kernels.records import Camera, PointCloud, unstack
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.picture_scores import METRICS, flip
from spnr_jax.training import checkpoint, optimisation

NAMES = tiny_dataset.SPLITS["test"]
ssim, cpsnr = jax.jit(metrics.ssim), jax.jit(metrics.conditional_psnr)
FACTORS = {"splat": 1.5, "nearest": 0.75}


def methods():
    variables = optimisation.averaged_variables(checkpoint.restore(tiny_untrained.run(), CONFIG))
    trivial = {name: evaluation.make_trivial(name, FACTORS.get(name, 1.0)) for name in evaluation.TRIVIAL}
    return {"paper": evaluation.make_method(variables, CONFIG), **trivial}


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


def test_opacity_is_compared_at_the_size_of_the_reference(results):
    pictures, scores = results[0].pictures, results[0].scores
    assert pictures["paper"].acc.shape[1:] == pictures["paper"].depth.shape[1:] == (8, 8)
    assert pictures["splat"].depth is None
    assert np.all(scores["white"]["iou"] == 0), "an empty picture overlaps with nothing"
    assert np.all(scores["nearest"]["iou"] > 0.3)


def test_a_summary_is_the_mean_over_all_images_with_its_counts(results):
    outcome = tiny_untrained.evaluated()
    assert set(outcome.summary["methods"]) == {"paper", *evaluation.TRIVIAL}
    assert set(outcome.summary["paper_minus"]) == set(evaluation.TRIVIAL)
    for table in outcome.summary["methods"].values():
        assert table["objects"] == len(NAMES)
        assert table["views"] == len(NAMES) * tiny_dataset.VIEWS
    ours = np.concatenate([result.scores["paper"]["psnr"] for result in results])
    assert outcome.summary["methods"]["paper"]["psnr"] == pytest.approx(ours.mean(), abs=1e-4)
    assert outcome.summary["steps"] == 0
    assert set(outcome.summary["settings"]["radius factors"].values()) <= set(evaluation.RADIUS_FACTORS)


def test_the_radius_is_the_one_that_scores_best_on_training_objects(monkeypatch):
    real, asked = data_sets.read_object, []
    monkeypatch.setattr(data_sets, "read_object", lambda dataset, name: asked.append(name) or real(dataset, name))
    monkeypatch.setattr(evaluation, "RADIUS_OBJECTS", 2)
    chosen = evaluation.choose_radius(tiny_dataset.dataset(), CONFIG, "splat")
    assert set(asked) == set(tiny_dataset.SPLITS["train"][:2])
    items = [real(tiny_dataset.dataset(), name) for name in tiny_dataset.SPLITS["train"][:2]]

    def score(factor, item):
        item = replace(item, cloud=data_sets.first_points(item, CONFIG.test_points))
        image = evaluation.make_trivial("splat", factor)(item).image
        return np.mean(metrics.psnr(image, jnp.asarray(data_sets.on_white(item.images))))

    means = {factor: np.mean([score(factor, item) for item in items]) for factor in evaluation.RADIUS_FACTORS}
    assert means[chosen] == max(means.values())


def test_radii_are_chosen_on_small_pictures_of_the_same_views(monkeypatch):
    item = data_sets.read_object(tiny_dataset.dataset(), tiny_dataset.NAMES[0])
    side = item.images.shape[1] // 2
    monkeypatch.setattr(evaluation, "RADIUS_PIXELS", side)
    small = evaluation.shrink(item)
    assert small.images.shape[1:3] == (small.camera.height, small.camera.width) == (side, side)
    points = jnp.asarray(item.cloud.positions)
    for camera, less in zip(unstack(item.camera), unstack(small.camera), strict=True):
        np.testing.assert_allclose(project(less, points)[0], project(camera, points)[0] / 2, rtol=1e-4, atol=1e-3)
    white, less = data_sets.on_white(item.images), data_sets.on_white(small.images)
    means = white.reshape(len(white), side, 2, side, 2, 3).mean(axis=(2, 4))
    np.testing.assert_allclose(less, means, atol=0.02)


def test_data_in_another_light_than_that_of_the_training_are_named(tmp_path, monkeypatch):
    run, one, said = shutil.copytree(tiny_untrained.run(), tmp_path / "run"), tiny_dataset.dataset(), []
    monkeypatch.setattr(evaluation, "compare", lambda *_: tiny_untrained.evaluated())
    dusk = replace(one, settings=one.settings | {"environment_map": {"name": "dusk.hdr"}})
    for trained, scored in ((None, dusk), (one, one), (one, dusk), (dusk, dusk)):
        if trained:
            checkpoint.record_data(run, trained)
        evaluation.evaluate(run, scored, say=said.append)
    assert said == [f"{run} was trained in another light (procedural room) than that of {one.folder} (dusk.hdr)"]


def test_an_empty_training_split_is_an_error_that_names_it(tmp_path):
    copy = shutil.copytree(tiny_dataset.dataset().folder, tmp_path / "data")
    (copy / "splits" / "train.txt").write_text("")
    with pytest.raises(ValueError, match="no training objects"):
        evaluation.evaluate(tiny_untrained.run(), data_sets.open_dataset(copy), say=lambda line: None)


def test_an_lpips_that_can_be_measured_is_in_the_scores_of_each_method(monkeypatch):
    monkeypatch.setattr(evaluation, "lpips", lambda image, reference: np.abs(image - reference).mean(axis=(1, 2, 3)))
    asked = {"white": evaluation.make_trivial("white")}
    result = evaluation.evaluate_object(asked, CONFIG, data_sets.read_object(tiny_dataset.dataset(), NAMES[0]))
    close(result.scores["white"]["lpips"], (1 - result.reference).mean(axis=(1, 2, 3)), rtol=1e-4)


def test_objects_are_spread_from_the_first_to_the_last():
    assert evaluation.pick_evenly(tuple("abcdefg"), 3) == ("a", "d", "g")
    assert evaluation.pick_evenly(tuple("ab"), 5) == ("a", "b")
    assert evaluation.pick_evenly(("a",), 0) == ()


# the trivial renderers


RADIUS, EYE = 0.12, np.array([0.4, 0.5, 2.0])
splat, nearest = jax.jit(evaluation.render_splat), jax.jit(evaluation.render_nearest)


def make_cloud(positions, mask=None, **columns) -> PointCloud:
    made = surfel_clouds.cloud(positions, **columns)
    return jax.tree.map(jnp.asarray, made if mask is None else made.replace(mask=mask))


def random_cloud(seed: int, num_points: int = 60) -> PointCloud:
    """Points in a ball around the origin that reaches behind the camera of `skewed_camera`; a third is masked."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-1, 1, (num_points, 3)) * [1, 1, 2.5]
    color = rng.uniform(size=(num_points, 3))
    return make_cloud(positions, rng.uniform(size=num_points) < 0.67, base_color=color)


def skewed_camera() -> Camera:
    """Not square, focal lengths that differ, the principal point off the middle."""
    pose = look_at(jnp.asarray(EYE, jnp.float32), jnp.array([0.1, 0, 0]), jnp.array([0.0, 1, 0]))
    intrinsics = jnp.array([[26.0, 0, 13], [0, 31, 8], [0, 0, 1]])
    return Camera(cam_to_world=pose, intrinsics=intrinsics, height=18, width=23)


def loop_rays(camera: Camera):
    """(place, eye, unit direction) of every pixel, float64."""
    pose, k = np.asarray(camera.cam_to_world, np.float64), np.asarray(camera.intrinsics, np.float64)
    for place in np.ndindex(camera.height, camera.width):
        yield place, pose[:, 3], reference.camera_ray(pose, k.diagonal()[:2], k[:2, 2], *place)


def loop_splat(cloud: PointCloud, camera: Camera, radius: float):
    """The disc's definition in camera coordinates: it lies in the plane z = depth of its point."""
    pose = np.asarray(camera.cam_to_world, np.float64)
    image, acc = np.ones((camera.height, camera.width, 3)), np.zeros((camera.height, camera.width))
    for place, eye, direction in loop_rays(camera):
        best, (*across, along) = np.inf, pose[:, :3].T @ direction
        for position, color in zip(
            *(np.asarray(a)[cloud.mask] for a in (cloud.positions, cloud.base_color)), strict=True
        ):
            x, y, z = pose[:, :3].T @ (position - eye)
            if -z > 0 and np.hypot(*(np.array(across) * z / along - [x, y])) <= radius and -z < best:
                best, acc[place], image[place] = -z, 1, linear_to_srgb(color)
    return image, acc


def loop_nearest(cloud: PointCloud, camera: Camera, radius: float):
    """Nearest-point shading to the letter: first find the intersection, then search the point nearest to it."""
    positions, colors = (np.asarray(a, np.float64)[cloud.mask] for a in (cloud.positions, cloud.base_color))
    image, acc = np.ones((camera.height, camera.width, 3)), np.zeros((camera.height, camera.width))
    for place, eye, direction in loop_rays(camera):
        first = np.inf
        for offset in positions - eye:
            b = direction @ offset
            discriminant = b**2 - offset @ offset + radius**2
            if discriminant >= 0 and b + np.sqrt(discriminant) >= 0:
                first = min(first, max(b - np.sqrt(discriminant), 0))
        if np.isfinite(first):
            index = np.argmin(np.linalg.norm(positions - (eye + first * direction), axis=-1))
            acc[place], image[place] = 1, linear_to_srgb(colors[index])
    return image, acc


AROUND = np.concatenate([EYE + [[0.3, 0, 0], [0, 0.1, 0.1], [0, 0, -0.4]], random_cloud(2).positions[3:]])
SCENES = {  # points and their radius, the least and the largest share of pixels that show them
    "random": (random_cloud(0), RADIUS, 0.1, 0.95),
    "random again": (random_cloud(1), RADIUS, 0.1, 0.95),
    "eye inside balls": (make_cloud(AROUND, base_color=random_cloud(2).base_color), 0.5, 0.1, 1.0),
    "no points": (make_cloud(np.zeros((2, 3)), mask=np.zeros(2, bool)), 1.0, 0.0, 0.0),
    "behind the eye": (make_cloud([[0.4, 0.5, 4.0], [0.5, 0.5, 3.0]]), 0.3, 0.0, 0.0),
}


@pytest.mark.parametrize(("renderer", "twin"), [(splat, loop_splat), (nearest, loop_nearest)])
@pytest.mark.parametrize("scene", SCENES)
def test_every_pixel_is_that_of_the_plain_loop(renderer, twin, scene):
    cloud, radius, least, largest = SCENES[scene]
    image, acc = renderer(cloud, skewed_camera(), radius)
    expected_image, expected_acc = twin(cloud, skewed_camera(), radius)
    assert least <= expected_acc.mean() <= largest
    np.testing.assert_array_equal(acc, expected_acc)
    np.testing.assert_allclose(image, expected_image, atol=1e-5)


def test_blocks_of_rays_give_the_image_of_all_rays_at_once(monkeypatch):
    cloud, camera = random_cloud(7), skewed_camera()
    whole = splat(cloud, camera, RADIUS)[0]
    monkeypatch.setattr("spnr_jax.scoring.evaluation.BLOCK", 60 * 5)  # 414 rays: 82 blocks of 5 and a remainder
    np.testing.assert_allclose(evaluation.render_splat(cloud, camera, RADIUS)[0], whole, atol=1e-6)


def test_spacing_is_the_median_distance_to_the_nearest_other_real_point():
    cloud = random_cloud(8)
    real = np.asarray(cloud.positions, np.float64)[cloud.mask]
    distances = [min(np.linalg.norm(p - q) for j, q in enumerate(real) if j != i) for i, p in enumerate(real)]
    np.testing.assert_allclose(evaluation.measure_nearest_distance(cloud), np.median(distances), rtol=1e-5)
    for real in (0, 1):
        assert evaluation.measure_nearest_distance(make_cloud(np.zeros((4, 3)), mask=np.arange(4) < real)) == 0
