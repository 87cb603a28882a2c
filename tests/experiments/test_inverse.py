"""What one picture tells: the study in a tiny setting, and the parts whose answers are known."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_surfels
from support.laws import close
from support.surfel_clouds import camera

from experiments.studies import inverse, one_picture
from experiments.studies.one_picture import Unknowns
from spnr_jax import cli
from spnr_jax.surfels import lighting
from spnr_jax.training import weights


def test_a_light_of_harmonics_is_that_of_its_map():
    coefficients = np.random.default_rng(0).random((9, 3)).astype(np.float32)
    made = lighting.light_of(one_picture.harmonics() @ coefficients).tables
    close(np.einsum("bc,bthw->thwc", coefficients, one_picture.basis()), made, rtol=1e-4, atol=1e-5)


def test_a_pose_turns_about_the_middle_by_its_angle_and_shifts_in_radii():
    seen, centre, scale = camera(8, (0.0, 0.0, 3.0), 0.8), jnp.array([1.0, 2.0, 3.0]), jnp.float32(0.5)
    same = one_picture.move(seen, jnp.zeros(6), centre, scale)
    close(same.cam_to_world, seen.cam_to_world)
    quarter = one_picture.move(seen, jnp.array([0.0, 2.0, 0.0, 0.1, 0.0, 0.0]), centre, scale).cam_to_world  # 2 tan 45
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    close(quarter[:, :3], turn @ seen.cam_to_world[:, :3], atol=1e-6)
    close(quarter[:, 3], centre + turn @ (seen.cam_to_world[:, 3] - centre) + np.array([0.2, 0, 0]), atol=1e-5)


@pytest.mark.ci
def test_each_task_comes_nearer_to_the_target_and_gradients_are_differences(tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)  # it would write to the home folder
    monkeypatch.setattr(weights, "shipped", tiny_surfels.shipped)
    inverse.main(inverse.InverseStudy(out=tmp_path, quick=True))
    found = json.loads((tmp_path / "results.json").read_text())
    assert set(found["tasks"]) == set(inverse.RATES)
    for task, of in found["tasks"].items():
        assert of["overflow"] == 0, task
        assert np.sum(of["losses"][-1]) < np.sum(of["losses"][0]), task
    for name, pairs in found["gradients"].items():
        for gradient, difference in pairs:
            assert abs(difference) > 1e-4
            assert gradient == pytest.approx(difference, rel=1e-2), name
    assert set(found["gradients"]) == set(Unknowns._fields)
    for name in ("inverse.png", "losses.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
