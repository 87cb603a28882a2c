"""Laws of the cost model: one device waits for nobody, more devices cost more, and the documents hold its tables."""

import dataclasses
import itertools
import json
import math
from pathlib import Path

import pytest
from support import tiny_dataset

from experiments import cost_counts, cost_model
from experiments.cost_model import (
    DEVICES,
    MACHINE,
    STEP,
    compute_seconds,
    efficiency,
    figure,
    reduce_seconds,
    ring_seconds,
    simulated_seconds,
    step_seconds,
)
from spnr_jax import presets


def test_a_ring_sends_every_byte_twice_but_for_the_own_share():
    assert ring_seconds(1e9, 1, 50e9, 5e-6) == 0
    assert ring_seconds(1e9, 2, 50e9, 0) == pytest.approx(1e9 / 50e9)
    assert ring_seconds(1e9, 4, 50e9, 0) == pytest.approx(2 * 3 / 4 * 1e9 / 50e9)
    assert ring_seconds(1e9, 10**6, 50e9, 0) == pytest.approx(2e9 / 50e9, rel=1e-5)
    assert ring_seconds(0, 8, 50e9, 5e-6) == pytest.approx(14 * 5e-6)


def test_a_sum_takes_longer_over_more_devices_and_longest_between_hosts():
    seconds = [reduce_seconds(n) for n in (1, 2, 4, 8, 16, 64, 256)]
    assert seconds[0] == 0
    assert seconds == sorted(seconds)
    assert reduce_seconds(9) > 5 * reduce_seconds(8)


def test_computing_takes_what_is_longer_of_operations_and_bytes():
    fixed = MACHINE.fixed_seconds
    slow = dataclasses.replace(MACHINE, reached_operations=1e-6)
    operations = STEP.operations + STEP.operations_of_r1 / STEP.r1_interval
    assert compute_seconds(8) - fixed == pytest.approx(8 * STEP.bytes / (MACHINE.bandwidth * MACHINE.reached_bandwidth))
    assert compute_seconds(8, machine=slow) - fixed == pytest.approx(8 * operations / (MACHINE.operations * 1e-6))
    assert compute_seconds(0) == fixed


@pytest.mark.parametrize("devices", [1, 3])
@pytest.mark.parametrize(("read", "expected"), [(0.0, 0.6), (0.5, 0.6), (0.9, 0.9)])
def test_without_jitter_a_step_takes_what_is_longer_of_reading_and_computing_with_its_sum(devices, read, expected):
    assert simulated_seconds(devices, 0.4, read, 0.2) == pytest.approx(expected)


def test_all_wait_for_the_slowest_and_one_device_for_nobody():
    found = [simulated_seconds(n, 0.1, 0.0, 0.0, jitter=0.02) for n in (1, 8, 256)]
    assert found[0] == pytest.approx(0.1, rel=5e-3)
    assert found == sorted(found)
    assert found[2] == pytest.approx(0.1 * (1 + 2.8 * 0.02), rel=5e-3), "the largest of 256 normal numbers"


def test_batches_that_are_ready_hide_a_reader_that_is_sometimes_late():
    rare = simulated_seconds(1, 0.1, 0.099, 0.0, jitter=0.2, steps=4000)
    assert rare == pytest.approx(0.1, rel=0.05)


def test_one_device_that_does_not_wait_is_efficient_and_more_are_less():
    still = dataclasses.replace(MACHINE, jitter=0.0)
    assert efficiency(1, threads=math.inf, machine=still) == pytest.approx(1)
    values = [efficiency(n, threads=math.inf) for n in (1, 2, 8, 64, 256)]
    assert values == sorted(values, reverse=True)
    assert efficiency(8, objects=1, threads=math.inf) < efficiency(8, objects=8, threads=math.inf)


def test_more_threads_never_cost_time_and_too_few_set_the_pace():
    seconds = [step_seconds(8, threads=threads) for threads in (0.25, 1, 2, 8, math.inf)]
    assert all(more <= (1 + 1e-9) * fewer for fewer, more in itertools.pairwise(seconds))
    assert seconds[0] == pytest.approx(8 / (0.25 * cost_model.OBJECT.read_per_second), rel=1e-3)


def test_what_is_generated_and_stored_grows_with_the_objects(monkeypatch):
    def row(size):
        monkeypatch.setattr(cost_model, "SIZES", (size,))
        return [float(cell.replace(",", "")) for cell in cost_model.generation_table().splitlines()[2].split("|")[2:-1]]

    for one, ten in zip(row(10_000), row(100_000), strict=True):
        assert ten == pytest.approx(10 * one, rel=0.06)  # they are rounded


@pytest.mark.parametrize(("value", "text"), [(0.0144, "0.014"), (3.479, "3.5"), (55.66, "55.7"), (3444.4, "3,440")])
def test_figures_are_rounded(value, text):
    assert figure(value) == text


@pytest.mark.parametrize("make", cost_model.TABLES)
def test_the_tables_stand_in_the_documents(make):
    assert make() in (Path(__file__).parents[1] / "docs" / "scale.md").read_text()


def test_the_command_writes_tables_and_a_curve(tmp_path, capsys):
    cost_model.main(cost_model.CostModel(out=tmp_path))
    assert (tmp_path / "tables.md").read_text() in capsys.readouterr().out
    assert (tmp_path / "efficiency.png").read_bytes().startswith(b"\x89PNG")
    assert len(DEVICES) == 3


def test_counted_parameters_are_those_of_the_preset():
    found = cost_counts.parameters(presets.abo())
    assert found["parameters"] == STEP.parameters
    assert found["batch_norms"] == STEP.batch_norms
    assert STEP.r1_interval == presets.abo().loss.r1_interval


@pytest.mark.slow
def test_a_step_is_counted_and_more_samples_are_more_operations(monkeypatch, capsys):
    monkeypatch.setattr(cost_counts.convolution, "_conv3d_cpu", cost_counts.convolution._conv3d_cpu)  # put back later
    monkeypatch.setattr(cost_counts.convolution, "_conv2d_cpu", cost_counts.convolution._conv2d_cpu)
    config = tiny_dataset.CONFIG
    monkeypatch.setitem(presets.PRESETS, "tiny", lambda: config)
    cost_counts.main(cost_counts.CostCounts(preset="tiny"))
    found = json.loads(capsys.readouterr().out)
    assert 0 < found["operations_of_r1"] < found["operations"]
    assert 0 < found["bytes"] < found["bytes_unfused"]
    sampling = dataclasses.replace(config.model.sampling, num_coarse=4 * config.model.sampling.num_coarse)
    more = dataclasses.replace(config, model=dataclasses.replace(config.model, sampling=sampling))
    assert cost_counts.lowered(more).cost_analysis()["flops"] > found["operations"]
