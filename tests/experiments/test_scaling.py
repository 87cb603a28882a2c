"""How cost grows: slopes are those of the log-log plot, and every axis changes what it says and nothing else."""

import json

import numpy as np
import pytest

from experiments.speed import ours, scaling

BASE = ours.twin_sized("tiny", "train_l1")


def test_slopes_of_a_power_law_and_of_a_cost_with_a_constant_part():
    work = np.array([1.0, 2.0, 4.0, 8.0])
    np.testing.assert_allclose(scaling.slopes(work, 3 * work**1.5), (1.5, 1.5), rtol=1e-6)
    slope, last = scaling.slopes(work, 10 + work)
    assert 0 < slope < last < 1


@pytest.mark.parametrize("name", scaling.SWEEPS)
def test_work_is_what_the_axis_multiplies(name):
    sweep = scaling.SWEEPS[name]
    first, second = sweep.values[:2]
    (config_a, a), (config_b, b) = sweep.case(BASE, first), sweep.case(BASE, second)
    counts = {
        "points": lambda config, batch: batch.cloud.mask.shape[1],
        "objects": lambda config, batch: batch.image.shape[0],
        "views": lambda config, batch: batch.camera.cam_to_world.shape[1],
        "image": lambda config, batch: batch.camera.height * batch.camera.width,
        "volume": lambda config, batch: config.model.encoder.volume_resolution**3,
        "samples": lambda config, batch: config.model.sampling.num_coarse + config.model.sampling.num_fine,
    }
    for axis, count in counts.items():
        before, after = count(config_a, a), count(config_b, b)
        if axis == name:
            assert (before, after) == (sweep.work(first), sweep.work(second))
        else:
            assert before == after


@pytest.mark.slow
def test_a_quick_run_ends_with_table_and_plot(tmp_path, monkeypatch):
    monkeypatch.setattr(scaling.cli, "set_up_jax", lambda **_: None)
    scaling.main(scaling.Options(out=tmp_path / "scaling", only=("points",), quick=True))
    found = json.loads((tmp_path / "scaling-quick" / "results.json").read_text())
    assert [point["work"] for point in found["axes"][0]["points"]] == [512, 1024]
    assert (tmp_path / "scaling-quick" / "scaling.png").read_bytes().startswith(b"\x89PNG")
