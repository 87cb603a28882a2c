"""Devices and processes divide the work and change nothing: what one device computes is what all of them compute."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from layouts import NETWORK, QUICK_COMPILATION, Layout, compared
from layouts import run as run_layout
from support import tiny_dataset
from support.laws import same_bits
from support.tiny_dataset import CONFIG

from spnr_jax.devices import placement
from spnr_jax.training import batching

# the discriminator and R1 take part from the first step
FLAGS = f"{NETWORK} --adversarial-start 0 --batch-objects 4 --num-steps 4 --checkpoint-every 2".split()
TOLERANCE = 1e-5


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("distributed")


@pytest.fixture(scope="module")
def one(folder):
    """Four steps on one device, with checkpoints at 2 and 4."""
    return start(folder, Layout(name="one"))


def agrees(run, one):
    found = compared(run, one)
    assert max(found.values()) < TOLERANCE, found


def start(folder, layout):
    return run_layout(folder, tiny_dataset.dataset().folder, layout, FLAGS)


@pytest.mark.ci
def test_two_processes_of_two_devices_go_on_from_a_checkpoint_of_one_and_one_reads_theirs(folder, one):
    """R1 is due in the first of the two steps, statistics are of all objects."""
    shutil.copytree(one, folder / "four", ignore=shutil.ignore_patterns("4"))
    agrees(start(folder, Layout(name="four", processes=2, devices=2)), one)


@pytest.mark.ci
@pytest.mark.parametrize("launcher", ["SLURM's environment", "mpirun"])
def test_processes_of_a_launcher_find_each_other(folder, one, launcher):
    if launcher == "mpirun" and sys.platform != "linux":
        pytest.skip("Open MPI is installed on Linux alone")
    agrees(start(folder, Layout(name=launcher, processes=2, launcher=launcher)), one)


@pytest.mark.slow
@pytest.mark.parametrize(
    "layout",
    [
        Layout(name="4 devices", devices=4),
        Layout(name="4 processes", processes=4),
    ],
    ids=lambda layout: layout.name,
)
def test_every_layout_trains_as_one_device(folder, one, layout):
    agrees(start(folder, layout), one)


def many_devices(*arguments):
    """What tests/robustness/many_devices.py finds on eight virtual devices."""
    here = Path(__file__).parent
    environment = os.environ | {
        "XLA_FLAGS": f"{QUICK_COMPILATION} --xla_force_host_platform_device_count=8",
        "PYTHONPATH": str(here.parents[1]),
    }
    command = [sys.executable, here / "many_devices.py", *arguments]
    return json.loads(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)


@pytest.mark.ci
def test_gradients_of_eight_devices_are_those_of_one_in_float64():
    assert many_devices("float64") < 1e-9


@pytest.mark.ci
def test_eight_devices_train_what_one_does_and_each_renders_only_its_own_objects():
    found = many_devices()
    assert max(found["gradients"].values()) < TOLERANCE, found
    (one,), eight = found["blocks"]
    assert len(eight) == 8
    assert max(eight) <= one // 8 + 1, "each packs its rays into blocks of its own"


@pytest.mark.parametrize("count", [1, 2, 4])
def test_processes_assemble_the_pieces_of_one_batch(count):
    config = dataclasses.replace(CONFIG, batch_objects=4, num_steps=2)
    pieces = [range(i, i + 4 // count) for i in range(0, 4, 4 // count)]
    parts = [list(batching.batches(tiny_dataset.dataset(), config, 0, own=own)) for own in pieces]
    for whole, *of_step in zip(batching.batches(tiny_dataset.dataset(), config, 0), *parts, strict=True):
        same_bits(jax.tree.map(lambda *x: np.concatenate(x), *of_step), whole)


def test_a_batch_that_the_devices_do_not_divide_is_refused_in_one_line():
    assert placement.device_mesh() is None, "of one device"
    mesh = jax.sharding.Mesh(np.full(4, jax.devices()[0]), (placement.OBJECTS,))
    with pytest.raises(ValueError, match="batch_objects 6 cannot be divided among 4 devices; use a multiple"):
        placement.own_objects(mesh, 6)


@pytest.mark.parametrize(
    ("address", "line"),
    [
        ((None, 2, 0), "expected all three, or none in a launcher"),
        (("localhost:1234", 2, 2), "--process-id 2: expected 0 to 1"),
        ((None, None, None), "the processes do not find each other .*; start them by srun, mpirun"),
    ],
)
def test_processes_that_cannot_find_each_other_are_told_what_to_give(address, line):
    with pytest.raises(ValueError, match=line):
        placement.join(*address)


def test_a_process_alone_waits_for_nobody():
    done = []
    placement.first_alone(lambda: done.append(placement.leads()))
    assert done == [True]
    assert [placement.Agreement(None)(asked) for asked in (False, True, False)] == [False, True, False]
