"""What single experiments compute, apart from drawing and training: rows, fronts, classes, views, light, depth."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset
from support.laws import close
from support.surfel_clouds import camera

from experiments.paper import fig3
from experiments.paper.fig1 import Fig1, variant
from experiments.paper.fig2 import nearest_views
from experiments.studies import inverse, relighting
from experiments.studies.speed_accuracy import front
from spnr_jax import config, presets
from spnr_jax.formats import data_sets
from spnr_jax.scoring.evaluation import Pictures
from spnr_jax.surfels import lighting
from spnr_jax.training import optimisation

TINY = presets.tiny()


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


def test_the_front_holds_what_no_other_setting_beats():
    pairs = ((4, 20.0), (2, 18.0), (8, 21.0), (5, 19.0), (3, 20.5), (3, 20.4), (16, 21.0))
    rows = [{"ms_view": ms, "psnr": psnr} for ms, psnr in pairs]
    assert front(rows) == [1, 4, 2]


def test_the_log_error_of_a_picture_that_is_right_and_of_one_half_as_bright():
    item = tiny_dataset.one_object()
    white = data_sets.on_white(item.images)
    half = relighting.linear(white) / 2
    dim = np.where(half <= 0.0031308, 12.92 * half, 1.055 * half ** (1 / 2.4) - 0.055)
    for image, expected in ((white, 0), (dim, np.log(2))):
        found = relighting.log_errors(item, Pictures(image=image, acc=image[..., 0]))
        assert found == pytest.approx([expected] * tiny_dataset.VIEWS, abs=1e-3)


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


# --- depth ------------------------------------------------------------------------------------------------------------

SIZE = 64
TRUTH = np.full((SIZE, SIZE), np.inf)
TRUTH[20:40, 20:40] = np.linspace(2, 3, 20)[:, None]
INSIDE = np.isfinite(TRUTH)
SEEN, FAR = np.where(INSIDE, TRUTH, 9.0), np.full((SIZE, SIZE), 4.0)
RIGHT = dict.fromkeys(fig3.COLUMNS, 0.0)


def changed_at(array, place, value):
    array = array.copy()
    array[place] += value
    return array


THIN = changed_at(INSIDE * 1.0, np.s_[20:25, 20:40], -0.6)
FLOATING = changed_at(changed_at(INSIDE * 1.0, np.s_[18:20, 20:40], 1.0), np.s_[0, :6], 0.6)  # 18: within 1/32
CLEAR = np.where(INSIDE, 0.75, 0.0)
OUTSIDE = SIZE**2 - 400
DEPTHS = {  # depth, opacity, and the metrics that are not 0
    "the truth": (SEEN, INSIDE * 1.0, {}),
    "too far": (SEEN + 0.25, INSIDE * 1.0, dict.fromkeys(("error", "median", "bias", "surface"), 0.25)),
    "too near": (SEEN - 0.25, INSIDE * 1.0, {"error": 0.25, "median": 0.25, "bias": -0.25, "surface": 0.25}),
    "one pixel": (changed_at(SEEN, (30, 30), 4), INSIDE * 1.0, dict.fromkeys(("error", "bias", "surface"), 4 / 400)),
    "holes": (np.where(THIN > 0.5, SEEN, 99.0), THIN, {"missed": 25.0}),
    "floaters": (SEEN, FLOATING, {"floaters": 46e3 / OUTSIDE, "far_floaters": 6e3 / OUTSIDE}),
    "far side": (
        CLEAR * SEEN + (1 - CLEAR) * FAR,
        CLEAR,
        dict.fromkeys(("error", "bias"), np.mean(0.25 * (FAR - TRUTH)[INSIDE])) | {"median": 0.375},
    ),
}


@pytest.mark.parametrize("name", DEPTHS)
def test_depth_errors_are_what_their_definitions_say(name):
    depth, acc, expected = DEPTHS[name]
    assert fig3.score(depth, acc, FAR, TRUTH) == pytest.approx(RIGHT | expected, abs=1e-9)


def test_an_empty_view_has_floaters_and_a_full_one_has_errors():
    ones = np.ones((SIZE, SIZE))
    nothing, full = fig3.score(SEEN, ones, FAR, np.inf * ones), fig3.score(2 * ones, ones, FAR, 2.5 * ones)
    floaters = {"floaters", "far_floaters"}
    assert {name for name, x in nothing.items() if not np.isnan(x)} == floaters
    assert {name for name, x in full.items() if np.isnan(x)} == floaters
    assert (nothing["floaters"], full["error"]) == (1000, 0.5)
