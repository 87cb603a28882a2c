"""Commands that measure speed: ratios are paired, slopes are those of a log-log plot, axes change what they say."""

import json

import numpy as np
import pytest
from support import twin

from experiments.speed import bench, gpu, speed_scenes, twin_layout, where_time_goes
from spnr_jax import cli
from spnr_jax.devices import runtime


@pytest.fixture(autouse=True)
def _without_cache(monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)


def test_the_ratio_is_the_median_of_paired_ratios():
    turns = [([1.0, 2.0, 9.0], [4.0] * 3), ([40.0] * 3, [80.0] * 3), ([3.0] * 3, [10.0, 1.0, 30.0])]
    assert bench.paired_ratio(turns) == [0.4, 0.5, 0.5]  # the second round is on a slow machine


def test_a_turn_leaves_its_first_run_out():
    runs = []
    assert len(bench.turn(lambda: runs.append(1), seconds=0)) == bench.FEWEST
    assert len(runs) == bench.FEWEST + 1


@pytest.mark.ci
def test_without_torch_one_line_says_so_and_ours_is_timed_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench.importlib.util, "find_spec", lambda name: None)
    options = bench.Options(out=tmp_path, presets=("tiny",), modes=("encode",), rounds=2, seconds=0.01)
    (row,) = bench.rows_of(options)
    assert row["ours_ms"] > 0
    assert row["ratio"] is None
    assert "ours is timed alone" in capsys.readouterr().out
    assert bench.rows_of(options) == [row]  # nothing is measured again


@pytest.mark.parametrize("implementation", ["plain", "fast"])
def test_our_pytorch_twin_is_the_network_of_the_fixture(implementation):
    torch = pytest.importorskip("torch", reason="the extra `bench` is not installed")
    from experiments.speed import twin as torch_twin

    arrays = {name: torch.from_numpy(x) for name, x in twin.load().items() if x.dtype == np.float32}
    generator = torch_twin.Generator(twin.config(twin.load()), implementation).eval()
    named = {name.removeprefix("param/gen."): x for name, x in arrays.items() if name.startswith("param/gen.")}
    generator.load_state_dict(named, strict=False)
    with torch.inference_mode():
        volume = generator.encode_volume(arrays["in/pos"], arrays["in/mat"])
        image, _ = generator.render_volume(volume, arrays["in/c2w"], arrays["in/focal"])
    for found, theirs in ((volume, arrays["eval/volume"]), (image, arrays["eval/image"])):
        assert (found - theirs).norm() <= 1e-5 * theirs.norm()


def test_the_sizes_of_the_fixture_are_those_that_are_timed_as_tiny():
    assert bench.our_config("tiny").model == twin_layout.train_config(twin.config(twin.load())).model


def test_points_lie_on_a_sphere_and_on_a_box():
    sphere, box = speed_scenes.arrays(2, 4, 1024)["pos"]
    np.testing.assert_allclose(np.linalg.norm(sphere, axis=-1), speed_scenes.SPHERE, rtol=1e-5)
    np.testing.assert_allclose(np.abs(box).max(axis=-1), speed_scenes.BOX, rtol=1e-5)


def test_slopes_of_a_power_law_and_of_a_cost_with_a_constant_part():
    work = np.array([1.0, 2.0, 4.0, 8.0])
    np.testing.assert_allclose(where_time_goes.slopes(work, 3 * work**1.5), (1.5, 1.5), rtol=1e-6)
    slope, last = where_time_goes.slopes(work, 10 + work)
    assert 0 < slope < last < 1


def test_a_processor_is_named_with_the_sets_that_it_has(tmp_path, monkeypatch):
    told = tmp_path / "cpuinfo"
    monkeypatch.setattr(runtime, "CPUINFO", told)
    assert runtime.processor().endswith("(instruction sets unknown)")
    told.write_text("processor\t: 0\nmodel name\t: Some CPU: 9\nflags\t\t: sse avx2 avx512f xavx512_bf16\n")
    assert runtime.processor() == "Some CPU: 9 (avx2, avx512f)"


COUNTS = {
    "points": lambda config, batch: batch.cloud.mask.shape[1],
    "objects": lambda config, batch: batch.image.shape[0],
    "views": lambda config, batch: batch.camera.cam_to_world.shape[1],
    "image": lambda config, batch: batch.camera.height,
    "volume": lambda config, batch: config.model.encoder.volume_resolution,
    "samples": lambda config, batch: config.model.sampling.num_coarse + config.model.sampling.num_fine,
}


@pytest.mark.parametrize("name", where_time_goes.AXES)
def test_an_axis_changes_what_it_says_and_nothing_else(name):
    axis, base = where_time_goes.AXES[name], bench.our_config("tiny", "train_l1")
    cases = [axis.case(base, value) for value in axis.values[:2]]
    for other, count in COUNTS.items():
        before, after = (count(*case) for case in cases)
        assert (before, after) == axis.values[:2] if other == name else before == after


@pytest.mark.ci
def test_a_profile_times_the_parts_of_a_step_and_of_a_frame(tmp_path):
    where_time_goes.main(where_time_goes.WhereTimeGoes(out=tmp_path, quick=True, only=("points",)))
    found = json.loads((tmp_path / "results.json").read_text())
    step, frame = found["a training step"], found["a frame of 64 px"]
    assert step["network alone"] < step["network and its gradient"] < 2 * step["whole step"]
    assert min(frame.values()) > 0
    assert list(found["growth"]["points"]["ms"]) == ["512", "4096"]
    assert found["processor"] in (tmp_path / "table.md").read_text()


@pytest.mark.ci
def test_the_command_for_a_gpu_ends_with_one_table(tmp_path, monkeypatch):
    row = {"preset": "tiny", "mode": "render", "batch": 2, "ours_ms": 4.0, "twin_ms": 8.0}
    asked = []
    monkeypatch.setattr(bench, "rows_of", lambda options: asked.append(options) or [row])
    gpu.main(gpu.OnGPU(out=tmp_path, quick=True))
    assert asked[0].bf16
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [row["unit"] for row in rows] == ["frames", "frames", "steps", *["steps of a run"] * 2, "objects"]
    assert (rows[-1]["a_second"], rows[-1]["beside"]) == (500.0, 250.0)
    assert all(row["beside"] > 0 for row in rows[3:5])
    assert all(row["megabytes"] > 0 for row in rows[2:5])
