"""What single experiments compute, apart from drawing and training: fronts, views, light, depth."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset
from support.laws import close
from support.surfel_clouds import camera, cloud

from experiments.comparison import study_objects
from experiments.comparison.view_scores import compare_high_frequencies
from experiments.paper import fig3
from experiments.paper.fig1 import Fig1, variant
from experiments.paper.fig2 import nearest_views
from experiments.paper.table1 import duration
from experiments.studies import inverse, relighting
from experiments.studies.speed_accuracy import front
from spnr_jax import config, presets
from spnr_jax.formats import data_sets
from spnr_jax.kernels.imaging import linear_to_srgb, srgb_to_linear
from spnr_jax.scoring.evaluation import Pictures
from spnr_jax.surfels import lighting
from spnr_jax.surfels.sides import spiral
from spnr_jax.training import optimisation

TINY = presets.tiny()


def test_the_front_holds_what_no_other_setting_beats():
    pairs = ((4, 20.0), (2, 18.0), (8, 21.0), (5, 19.0), (3, 20.5), (3, 20.4), (16, 21.0))
    rows = [{"ms_view": ms, "psnr": psnr} for ms, psnr in pairs]
    assert front(rows) == [1, 4, 2]


def test_the_adversarial_loss_takes_part_from_the_first_step_and_the_weights_alone_differ():
    options = Fig1(data=tiny_dataset.dataset().folder, out=tiny_dataset.folder())
    made = [variant(options, weight, TINY, tiny_dataset.dataset()).config for weight in options.l1_weights]
    assert [v.loss.l1_weight for v in made] == [0, 100, 5000]
    assert {(v.loss.adversarial_weight, optimisation.first_adversarial_step(v)) for v in made} == {(1, 0)}
    same = dataclasses.replace(TINY, loss=config.LossConfig())
    assert all(dataclasses.replace(v, loss=config.LossConfig()) == same for v in made)


def test_the_nearest_views_look_from_the_same_side():
    angles = np.radians([[0, 90, 180], [95, 200, 300], [270, 10, 88]])
    eyes = [3 * np.stack([np.sin(a), 0 * a, np.cos(a)], axis=-1) for a in angles]
    assert nearest_views(eyes) == [1, 0, 2]


def test_the_log_error_of_a_picture_that_is_right_of_one_half_as_bright_and_of_nothing():
    item = tiny_dataset.one_object()
    white, clear = data_sets.on_white(item.images), np.minimum(item.images, 254)
    dim = linear_to_srgb(srgb_to_linear(white) / 2)
    for image, images, expected in ((white, item.images, 0), (dim, item.images, np.log(2)), (white, clear, np.nan)):
        pictures, seen = Pictures(image=image, acc=image[..., 0]), dataclasses.replace(item, images=images)
        found = relighting.log_errors(seen, pictures)
        assert found == pytest.approx([expected] * tiny_dataset.VIEWS, abs=1e-3, nan_ok=True)


def test_a_light_of_harmonics_is_that_of_its_map():
    coefficients = np.random.default_rng(0).random((9, 3)).astype(np.float32)
    made = lighting.light_of(inverse.harmonics() @ coefficients).tables
    close(np.einsum("bc,bthw->thwc", coefficients, inverse.basis()), made, rtol=1e-4, atol=1e-5)


def test_a_pose_turns_about_the_middle_by_its_angle_and_shifts_in_radii():
    seen, centre, scale = camera(8, (0.0, 0.0, 3.0), 0.8), jnp.array([1.0, 2.0, 3.0]), jnp.float32(0.5)
    same = inverse.move(seen, jnp.zeros(6), centre, scale)
    close(same.cam_to_world, seen.cam_to_world)
    quarter = inverse.move(seen, jnp.array([0.0, 2.0, 0.0, 0.1, 0.0, 0.0]), centre, scale).cam_to_world  # 2 tan 45
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    close(quarter[:, :3], turn @ seen.cam_to_world[:, :3], atol=1e-6)
    close(quarter[:, 3], centre + turn @ (seen.cam_to_world[:, 3] - centre) + np.array([0.2, 0, 0]), atol=1e-5)


def test_depth_errors_at_the_points_that_the_eye_sees_are_what_their_definitions_say():
    item, size = study_objects.cut(tiny_dataset.one_object(), views=1), tiny_dataset.SIZE
    item = dataclasses.replace(item, cloud=cloud(0.8 * spiral(500)))  # within the outline of the picture
    (view,), seen, empty = study_objects.each_view(item), item.images[..., 3] > 0, item.images[..., 3] == 0
    truth = fig3.true_depth(np.asarray(item.cloud.positions), view, (size, size))[None]
    known, full, left = np.isfinite(truth), item.images[..., 3] == 255, np.arange(size) < size // 2
    for acc, shift, expected in (
        (seen, 0, {}),
        (seen, -0.25, {"error": 0.25, "median": 0.25, "bias": -0.25}),
        (seen & ~left, 0, {"missed": 100 * (full & left).sum() / full.sum()}),
        (seen | left, 0, {"floaters": 1000 * (empty & left).sum() / empty.sum()}),
    ):
        pictures = Pictures(image=np.ones((1, size, size, 3)), acc=acc * 1.0, depth=np.where(known, truth + shift, 9.0))
        (found,) = fig3.score(item, pictures)
        assert found == pytest.approx(dict.fromkeys(fig3.COLUMNS, 0.0) | expected, abs=1e-6)


def test_an_eye_sees_the_near_half_of_a_ball_and_nothing_behind_a_wall():
    eye, sphere = np.array([0.5, 0.7, 3.0]), 0.9 * spiral(2000)
    facing = ((eye - sphere) * sphere).sum(axis=1)
    found = np.isin(np.arange(2000), fig3.visible_points(sphere - eye))
    assert found[facing > 0].all()
    assert not found[facing < -0.5].any()
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 30), np.linspace(-0.5, 0.5, 30))
    wall = np.stack([x, y, 0.5 + 0 * x], axis=-1).reshape(-1, 3)
    both = np.concatenate([wall, wall * 0.8 - (0, 0, 0.8)])
    found = fig3.visible_points(both - (0, 0, 3.0))
    assert len(found) == len(wall)
    assert (found < len(wall)).all()


def test_durations_are_said_in_the_units_that_people_use():
    spoken = {8.44: "8.4 s", 59.96: "1 min 0 s", 119.7: "2 min 0 s", 3599.9: "1 h 0 min", 7503: "2 h 5 min"}
    assert {seconds: duration(seconds) for seconds in spoken} == spoken


def test_high_frequencies_are_those_of_the_reference_or_there_is_no_ratio():
    wave = np.sin(np.pi * 0.75 * np.arange(32))[:, None, None] * np.ones((32, 32, 3))
    slow = np.cos(2 * np.pi * np.arange(32) / 32)[:, None, None] * np.ones((32, 32, 3))
    found = compare_high_frequencies(np.stack([0.5 * wave + 0.2, wave, slow]), np.stack([wave, wave, wave]))
    assert found == pytest.approx([0.25, 1, 0], abs=1e-6)
    assert np.isnan(compare_high_frequencies(wave, np.full_like(wave, 0.3)))
