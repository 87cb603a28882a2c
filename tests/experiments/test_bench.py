"""The benchmark: what it times has the twin's sizes, its ratios are paired, and a stop loses no row."""

import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from support import twin

from experiments.speed import bench, bench_scene, ours, twin_layout
from experiments.speed import worker as workers
from spnr_jax.devices import machine

OPTIONS = {"presets": ("tiny",), "modes": ("render",), "variants": ("plain", "fast"), "rounds": 3, "seconds": 0.02}


@pytest.fixture
def options(tmp_path, monkeypatch):
    """A benchmark of sleeping sides."""
    monkeypatch.setenv("PYTHONPATH", f"{bench.ROOT}{os.pathsep}{Path(__file__).parent}")
    monkeypatch.setattr(bench, "OURS", "bench_fake")
    monkeypatch.setattr(bench, "TWIN", "bench_fake")
    monkeypatch.setattr(bench.importlib.util, "find_spec", lambda name: name)
    return bench.Options(out=tmp_path / "bench", **OPTIONS)


def rows_of(options):
    return json.loads((options.out / "rows.json").read_text())


class TestTable:
    def test_ratios_are_those_of_the_sleeps(self, options, capsys):
        bench.main(options)
        rows = rows_of(options)
        assert [(r["function"], r["twin_variant"]) for r in rows] == [
            ("network", "plain"),
            ("network", "fast"),
            ("near points", "fast"),
        ]
        for row, expected in zip(rows, (2 / 8, 2 / 4, 1 / 4), strict=True):
            assert row["ratio"] == pytest.approx(expected, rel=0.4)
            assert row["ratio_low"] <= row["ratio"] <= row["ratio_high"]
            assert row["twin_ms"] >= row["twin_min_ms"] >= 4
            assert row["ours_peak_mb"] > 5
            assert (row["compile_s"], row["batch"]) == (0.5, 2)
            assert row["load"] >= 0
        assert "[3/3, about 0 min left] tiny batch 2 render, ours near points" in capsys.readouterr().out
        assert (options.out / "bench.png").read_bytes().startswith(b"\x89PNG")
        written = (options.out / "table.md").read_text()
        cores = min(2, len(os.sched_getaffinity(0)))
        for said in (
            f"{cores} of {os.cpu_count()} cores, {machine.processor()}",
            "fake 1",
            "load of the machine before the rows",
        ):
            assert said in written

    def test_without_torch_one_line_says_so_and_ours_is_timed_alone(self, options, monkeypatch, capsys):
        monkeypatch.setattr(bench.importlib.util, "find_spec", lambda name: None)
        bench.main(options)
        said = capsys.readouterr().out.splitlines()
        assert [i for i, line in enumerate(said) if "ours is timed alone" in line] == [0]
        assert said[0].startswith("torch is not installed")
        assert [(r["function"], r["twin_variant"], r["ratio"]) for r in rows_of(options)] == [
            ("network", None, None),
            ("near points", None, None),
        ]

    def test_a_stop_loses_no_row_and_a_rerun_measures_the_rest(self, options, monkeypatch, capsys):
        compared = []

        def stopping(ours, theirs, cell, options):
            if len(compared) == 2:
                raise KeyboardInterrupt
            compared.append(cell)
            return compare(ours, theirs, cell, options)

        compare = bench.compare
        monkeypatch.setattr(bench, "compare", stopping)
        with pytest.raises(KeyboardInterrupt):
            bench.main(options)
        before = rows_of(options)
        assert len(before) == 2
        monkeypatch.setattr(bench, "compare", compare)
        bench.main(options)
        assert rows_of(options)[:2] == before
        assert len(rows_of(options)) == 3
        assert "2 rows of the same code and options are kept" in capsys.readouterr().out

    def test_another_network_is_not_timed(self, options, monkeypatch):
        monkeypatch.setattr(bench, "worker", lambda module, spec: workers.worker(module, spec | {"wrong": True}))
        with pytest.raises(ValueError, match=r"tiny: fast/image differs from the twin's by 1.0e-03 of its norm"):
            bench.main(options)
        assert not (options.out / "rows.json").exists()

    def test_a_side_that_stops_is_named_with_its_last_words(self, options):
        with pytest.raises(ValueError, match=r"bench_fake \(tiny, encode\) stopped with code 1: for encoding"):
            bench.main(dataclasses.replace(options, modes=("encode",)))


def test_the_ratio_is_the_median_of_paired_ratios():
    class Side:
        facts = {"compile_s": 1.0, "software": "s"}

        def __init__(self, *turns):
            self.turns = iter(turns)

        def turn(self, seconds):
            return {"ms": next(self.turns), "peak_mb": 7, "idle_cpu_s": 0.0}

    cell = bench.Cell(preset="tiny", mode="train", function="network", variant="fast")
    ours = Side([1.0, 2.0, 9.0], [40.0, 40.0, 40.0], [3.0, 3.0, 3.0])  # the second round is on a slow machine
    theirs = Side([4.0, 4.0, 4.0], [80.0, 80.0, 80.0], [10.0, 1.0, 30.0])
    row = bench.compare(ours, theirs, cell, bench.Options(rounds=3))
    assert (row["ratio_low"], row["ratio"], row["ratio_high"]) == (0.4, 0.5, 0.5)
    assert (row["ours_ms"], row["ours_min_ms"], row["twin_ms"], row["twin_min_ms"]) == (3.0, 1.0, 10.0, 1.0)


def test_a_processor_is_named_with_the_sets_that_it_has(tmp_path, monkeypatch):
    told = tmp_path / "cpuinfo"
    monkeypatch.setattr(machine, "CPUINFO", told)
    assert machine.processor().endswith("(instruction sets unknown)")
    told.write_text("processor\t: 0\nmodel name\t: Some CPU: 9\nflags\t\t: sse avx2 avx512f xavx512_bf16\n")
    assert machine.processor() == "Some CPU: 9 (avx2, avx512f)"


def test_a_turn_lasts_as_long_as_asked_and_leaves_its_first_run_out():
    runs = []
    assert len(workers.turn(lambda: runs.append(1), seconds=0)) == workers.FEWEST
    assert len(runs) == workers.FEWEST + 1
    assert sum(workers.turn(lambda: time.sleep(1e-3), seconds=0.01)) >= 10


def test_the_peak_of_a_turn_is_not_that_of_what_was_before():
    code = (
        "from experiments.comparison import peak_memory as w; b = b'x' * (200 << 20); del b; first = w.peak_mb();"
        "w.forget_peak(); second = w.peak_mb(); b = b'x' * (50 << 20); print(first, second, w.peak_mb())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=bench.ROOT)
    first, second, third = map(int, done.stdout.split())
    assert first > 200
    assert second < 100
    assert second + 45 < third < second + 60


class TestOurs:
    def test_tiny_has_the_sizes_of_the_twins_fixture(self):
        theirs = twin_layout.train_config(twin.load())
        assert ours.twin_sized("tiny").model == theirs.model

    def test_another_size_is_refused(self):
        config = ours.twin_sized("small")
        with pytest.raises(ValueError, match="small: the twin has other sizes"):
            ours.differences(config, twin.load())

    @pytest.mark.slow
    def test_the_fixture_agrees_and_other_weights_do_not(self):
        stored = twin.load()
        outputs = {"volume": "eval/volume", "image": "eval/image", "logits": "eval/logits_fake"}
        arrays = {name: x for name, x in stored.items() if name.startswith(("meta", "param/", "in/"))}
        arrays |= {f"plain/{name}": stored[key] for name, key in outputs.items()}
        config = ours.twin_sized("tiny")
        config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, discriminator_width=16))
        found = ours.differences(config, arrays)
        assert set(found) == {"plain/volume", "plain/image", "plain/logits"}
        assert max(found.values()) < bench.AGREEMENT
        arrays["param/gen.upsampler.conv3.bias"] = arrays["param/gen.upsampler.conv3.bias"] + 1e-2
        found = ours.differences(config, arrays)
        assert found["plain/image"] > bench.AGREEMENT > found["plain/volume"]


@pytest.mark.parametrize("implementation", ["plain", "fast"])
def test_our_pytorch_twin_is_the_network_of_the_fixture(implementation):
    torch = pytest.importorskip("torch", reason="the extra `bench` is not installed")
    from experiments.speed import twin as torch_twin

    arrays = {name: torch.from_numpy(x) for name, x in twin.load().items() if x.dtype == np.float32}
    config = torch_twin.Config(grid=32, base=8, stages=3, coarse=16, fine=16, render=32, disc_width=16)
    generator = torch_twin.Generator(config, implementation).eval()
    named = {name.removeprefix("param/gen."): x for name, x in arrays.items() if name.startswith("param/gen.")}
    generator.load_state_dict(named, strict=False)
    with torch.inference_mode():
        volume = generator.encode_volume(arrays["in/pos"], arrays["in/mat"])
        image, _ = generator.render_volume(volume, arrays["in/c2w"], arrays["in/focal"])
    for found, theirs in ((volume, arrays["eval/volume"]), (image, arrays["eval/image"])):
        assert (found - theirs).norm() <= 1e-5 * theirs.norm()


class TestScene:
    def test_points_lie_on_a_sphere_and_on_a_box(self):
        sphere, box = bench_scene.arrays(2, 4)["in/pos"]
        np.testing.assert_allclose(np.linalg.norm(sphere, axis=-1), bench_scene.SPHERE, rtol=1e-5)
        np.testing.assert_allclose(np.abs(box).max(axis=-1), bench_scene.BOX, rtol=1e-5)
