"""The commands that time the surfel network run to their tables on a CPU."""

import json

import pytest

from experiments.speed import bench, gpu, where_time_goes
from spnr_jax import cli


@pytest.fixture(autouse=True)
def without_cache(monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)


@pytest.mark.ci
def test_a_profile_times_the_parts_of_a_step_and_of_a_frame(tmp_path):
    where_time_goes.main(where_time_goes.WhereTimeGoes(out=tmp_path, quick=True))
    found = json.loads((tmp_path / "results.json").read_text())
    step, frame = found["a training step"], found["a frame of 64 px"]
    assert step["network alone"] < step["network and its gradient"] < 2 * step["whole step"]
    assert min(frame.values()) > 0
    assert found["processor"] in (tmp_path / "table.md").read_text()


@pytest.mark.ci
def test_the_command_for_a_gpu_ends_with_one_table(tmp_path, monkeypatch):
    row = {"preset": "tiny", "mode": "render", "function": "network", "batch": 2, "ours_ms": 4.0, "twin_ms": 8.0}
    asked = []
    monkeypatch.setattr(bench, "rows_of", lambda options: asked.append(options) or [row])
    gpu.main(gpu.OnGPU(out=tmp_path, quick=True))
    assert asked[0].bf16
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [row["unit"] for row in rows] == ["frames", "frames", "steps", *["steps of a run"] * 2, "objects"]
    assert (rows[-1]["a_second"], rows[-1]["beside"]) == (500.0, 250.0)
    assert all(row["beside"] > 0 for row in rows[3:5])
    assert all(row["megabytes"] > 0 for row in rows[2:5])
    assert (tmp_path / "table.md").read_text().count("What a GPU is for") == 1
