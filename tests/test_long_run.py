"""The witness of a long run sees what is compiled and what grows, and changes nothing."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset
from support.tiny_baselines import SHRUNKEN

from experiments import long_run
from experiments.long_run import LongRun, Witness, compiled_once, drift, laws, main, median_rise, stretches
from experiments.long_run_report import hundreds
from spnr_jax import cli, presets
from spnr_jax.devices import allocator
from spnr_jax.training import checkpoint, optimisation, trainer

QUICK = dataclasses.replace(SHRUNKEN["points2nerf_tiny"], batch_objects=2)  # no convolutions: compiles in a second


def asked(out, **options):
    return LongRun(data=tiny_dataset.dataset().folder, out=out, **options)


@pytest.fixture(autouse=True)
def _shrunken(monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)
    monkeypatch.setattr(presets, "tiny", lambda: QUICK)


def row(step, memory=100.0, ms=None, threads=9, files=5):
    return {"step": step, "memory": memory, "threads": threads, "files": files, "ms_per_step": ms}


def witness(memory=lambda step: 100.0, ms=lambda step: 50.0, files=lambda step: 5):
    """One that saw a row and a preview every ten steps."""
    found = Witness()
    for step in range(10, 1010, 10):
        found.samples += [row(step, 150.0, ms(step), files=files(step)), row(step, memory(step), files=files(step))]
    return found


def broken(found, part=(100, 1000)):
    return [law["name"] for law in laws(found, [part]) if not law["held"]]


def test_each_law_is_broken_by_its_own_growth_alone():
    assert broken(witness()) == []
    assert broken(witness(memory=lambda step: 100 + 2e-3 * step)) == ["memory"]
    assert broken(witness(memory=lambda step: 100.0 if step < 960 else 102.0)) == ["memory"], (
        "late, and only at the end"
    )
    assert broken(witness(ms=lambda step: 50 + 5e-3 * step)) == ["pace"]
    assert broken(witness(files=lambda step: 5 + step // 50)) == ["handles"]


def test_what_happens_before_a_run_has_settled_and_single_rows_break_no_law():
    assert broken(witness(memory=lambda step: 40.0 if step < 100 else 100.0)) == []
    assert broken(witness(ms=lambda step: 9000.0 if step in (300, 500, 990) else 50.0)) == []


def test_a_stretch_of_few_rows_is_not_judged():
    assert [law["name"] for law in laws(witness(), [(990, 1000)])] == ["compilations"]


def test_drift_is_the_rise_of_a_line_over_all_steps_as_a_share():
    steps = np.arange(11.0)
    assert drift(steps, 100 + 2 * steps) == pytest.approx(20 / 110)
    assert drift(steps, np.full(11, 7.0)) == 0
    assert median_rise(np.array([5.0, 90, 5, 7, 8, 8, 8])) == 3


def test_stretches_are_the_parts_that_one_program_makes():
    config = dataclasses.replace(
        tiny_dataset.CONFIG, num_steps=100, loss=dataclasses.replace(tiny_dataset.CONFIG.loss, adversarial_start=0.5)
    )
    assert stretches(config, 10) == [(10, 50), (60, 100)]
    start = dataclasses.replace(config, loss=dataclasses.replace(config.loss, adversarial_start=0.0))
    assert stretches(start, 10) == [(10, 100)]
    assert stretches(QUICK, 0) == [(0, QUICK.num_steps)]


def test_only_work_that_is_done_for_the_first_time_may_compile():
    first = {"cause": "preview", "call": 1, "step": 9, "function": "render"}
    assert compiled_once([first, first | {"cause": "step", "call": 1, "step": 1}])["held"]
    for again in ({"call": 2}, {"cause": "loop", "call": 0}, {"cause": "step", "call": 9}):
        law = compiled_once([first, first | again])
        assert not law["held"]
        assert "render at step 9" in law["found"]


def test_hundreds_are_medians_of_the_rows_of_a_hundred_steps():
    samples = [row(20, ms=9000.0), row(60, ms=40.0), row(100, ms=50.0), row(100), row(120, ms=70.0)]
    assert hundreds(samples) == [(1, 100, 50.0), (101, 200, 70.0)]


@pytest.mark.ci
def test_a_run_compiles_once_for_each_kind_of_work(tmp_path, capsys):
    jax.clear_caches()  # another test may have drawn a preview
    assert "compilations" not in main(asked(tmp_path, steps=40))
    results = json.loads((tmp_path / "long_run.json").read_text())
    assert {one["cause"] for one in results["compilations"]} >= {"step", "preview"}
    assert {one["call"] for one in results["compilations"] if one["cause"] in ("step", "preview")} == {1}
    assert [one["function"] for one in results["compilations"] if one["cause"] == "step"] == ["jit(train_step)"]
    assert [x["step"] for x in results["samples"] if x["ms_per_step"] is None] == [10, 20, 30, 40]
    assert min(x["memory"] for x in results["samples"]) > 50
    assert (tmp_path / "long_run.png").read_bytes().startswith(b"\x89PNG")
    assert "compiled at step 1 by step: 1 programs" in capsys.readouterr().out
    with pytest.raises(ValueError, match="holds a run, and one is measured from its first step on"):
        main(asked(tmp_path, steps=40))


def test_a_program_that_is_compiled_at_every_preview_breaks_the_law(tmp_path, monkeypatch):
    real = trainer.preview

    def preview(*arguments):
        jax.jit(lambda x: x + 1)(jnp.zeros(3))
        return real(*arguments)

    monkeypatch.setattr(trainer, "preview", preview)
    assert "compilations" in main(asked(tmp_path, steps=20))


def test_memory_of_a_preview_is_read_once_when_it_was_given_back():
    seen = Witness()
    write, give_back = seen.watched("row", lambda log, row: None), seen.watched("memory", lambda: None)
    give_back()
    write(None, {"step": 5, "psnr": 20.0})
    assert seen.samples == []
    give_back()
    give_back()
    assert [(sample["step"], sample["ms_per_step"]) for sample in seen.samples] == [(5, None)]


def test_the_trainer_is_as_before_when_the_witness_has_gone():
    parts = (
        (optimisation, "jitted_train_step"),
        (trainer, "preview"),
        (checkpoint, "save"),
        (trainer.MetricsLog, "write"),
        (allocator, "give_back"),
    )
    before = [getattr(*part) for part in parts]
    seen = Witness()
    with seen.watching():
        assert all(getattr(*part) != old for part, old in zip(parts, before, strict=True))
    assert [getattr(*part) for part in parts] == before
    jax.jit(lambda x: 3 * x)(jnp.zeros(2))
    assert seen.compilations == []


def test_too_few_steps_are_refused(tmp_path):
    with pytest.raises(ValueError, match="--steps: expected 20 or more, got 3"):
        asked(tmp_path, steps=3)


@pytest.mark.slow
def test_the_discriminator_is_compiled_when_it_joins_and_never_again(tmp_path, monkeypatch):
    monkeypatch.setattr(presets, "tiny", lambda: tiny_dataset.CONFIG)
    assert "compilations" not in main(asked(tmp_path, steps=60))
    found = json.loads((tmp_path / "long_run.json").read_text())["compilations"]
    joined = [one for one in found if one["cause"] == "step with discriminator"]
    assert [(one["function"], one["step"]) for one in joined] == [("jit(train_step)", 31)]


def test_the_discriminator_may_join_at_once(tmp_path):
    config = long_run.configured(asked(tmp_path, steps=20, adversarial_start=0.0))
    assert config.loss.adversarial_start == 0
    assert config.num_steps == 20
