"""What large data sets cost on 1, 8 and 256 GPUs: measured figures, counted work, and stated rates of machines.

    python -m experiments.cost_model [--out runs/cost_model]

Measured are the seconds to render an object, the bytes it takes, and how many a thread reads in a second.  Counted are
operations, bytes and parameters of a training step (`python -m experiments.cost_counts`).  Everything about GPUs is an
estimate: the rates of a data sheet times the shares that are assumed to be reached.

A step of a device waits for its batch (read ahead by threads), computes, and waits for the slowest device and for the
sum of all gradients; `simulated_seconds` plays that step by step.  Nothing overlaps with the sum.

    tables.md  efficiency.png
"""

import dataclasses
import io
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro

from spnr_jax import cli
from spnr_jax.formats.images import write_whole
from spnr_jax.training.batching import READ_AHEAD, READERS

SIZES = (16_161, 1_000_000)  # ABO with its colour variants, as the paper; and a million
DEVICES = (1, 8, 256)
EPOCHS = 50  # 16,161 objects at 8 a step: the preset's 100,000 steps
HOUR, DAY = 3600.0, 86_400.0


@dataclass(frozen=True, kw_only=True)
class Object:
    """Measured (docs/data.md, docs/scale.md): 10 views of 128 x 128, 4096 points."""

    render_seconds: float = 12.4  # of one core, 256 samples per pixel, llvm_ad_rgb
    packed_bytes: float = 244e3
    folder_bytes: float = 355e3
    decoded_bytes: float = 1.5e6  # 2 x 10 pictures of RGBA, and the points
    read_per_second: float = 69.0  # decoded by a thread: 138 by two


@dataclass(frozen=True, kw_only=True)
class Step:
    """Counted: what a training step of one object of the preset `abo` takes, with the discriminator."""

    operations: float = 49.5e9
    operations_of_r1: float = 8.7e9  # every r1_interval steps
    r1_interval: int = 16
    bytes: float = 10.1e9
    parameters: int = 21_774_549
    batch_norms: int = 3  # each averages over all devices, forward and backward


@dataclass(frozen=True, kw_only=True)
class Machine:
    """A GPU by its data sheet (NVIDIA H100 SXM: TF32 without sparsity), and what is assumed of it."""

    operations: float = 495e12  # a second
    bandwidth: float = 3.35e12  # of its memory, bytes a second
    link_inside: float = 450e9  # to the others of a host, bytes a second and direction
    link_between: float = 50e9  # to other hosts: 400 Gbit/s for each GPU
    per_host: int = 8
    cores: int = 16  # of the host, for each GPU
    # assumed
    reached_operations: float = 0.1
    reached_bandwidth: float = 0.5
    fixed_seconds: float = 0.01  # a thousand kernels of 10 us
    latency: float = 5e-6  # of a message
    jitter: float = 0.02  # standard deviation of a device's step, as a share


OBJECT, STEP, MACHINE = Object(), Step(), Machine()


def compute_seconds(objects: float, step: Step = STEP, machine: Machine = MACHINE) -> float:
    """A device's step of so many objects: as long as its operations or its bytes take, whichever is longer."""
    operations = objects * (step.operations + step.operations_of_r1 / step.r1_interval)
    rates = machine.operations * machine.reached_operations, machine.bandwidth * machine.reached_bandwidth
    return machine.fixed_seconds + max(operations / rates[0], objects * step.bytes / rates[1])


def ring_seconds(size: float, devices: int, bandwidth: float, latency: float) -> float:
    """A sum of `size` bytes over devices in a ring: 2 (n - 1) messages of size / n."""
    return 2 * (devices - 1) * (size / devices / bandwidth + latency)


def reduce_seconds(devices: int, step: Step = STEP, machine: Machine = MACHINE) -> float:
    """All sums of a step over devices: the gradients in a ring of the slowest link, the norms' few bytes in a tree."""
    if devices == 1:
        return 0.0
    link = machine.link_inside if devices <= machine.per_host else machine.link_between
    gradients = ring_seconds(4 * step.parameters, devices, link, machine.latency)
    return gradients + 2 * step.batch_norms * 2 * math.ceil(math.log2(devices)) * machine.latency


def simulated_seconds(
    devices: int, compute: float, read: float, reduce: float, jitter: float = 0.0, steps: int = 400, seed: int = 0
) -> float:
    """Seconds of a step of all devices, once the first quarter of the steps is over.

    A batch of a device takes `read` seconds to read, at most READ_AHEAD of them are ready; computing takes `compute`,
    with a random factor of mean 1; then all wait for the slowest, and for the sum.
    """
    rng = np.random.default_rng(seed)
    factors = rng.lognormal(-(jitter**2) / 2, jitter, (steps, devices))
    ready, taken, now, begin = np.zeros(devices), np.zeros((steps, devices)), 0.0, 0.0
    for step in range(steps):
        free = taken[step - READ_AHEAD] if step >= READ_AHEAD else np.zeros(devices)
        ready = np.maximum(ready, free) + read
        taken[step] = np.maximum(now, ready)
        now = float(np.max(taken[step] + compute * factors[step])) + reduce
        if step == steps // 4 - 1:
            begin = now
    return (now - begin) / (steps - steps // 4)


def step_seconds(devices: int, objects: float = 8, threads: float = READERS, machine: Machine = MACHINE) -> float:
    """A training step on so many devices, `objects` of the batch and `threads` that read on each."""
    return simulated_seconds(
        devices,
        compute_seconds(objects, machine=machine),
        objects / (threads * OBJECT.read_per_second) if threads < math.inf else 0.0,
        reduce_seconds(devices, machine=machine),
        machine.jitter,
    )


def efficiency(devices: int, objects: float = 8, threads: float = READERS, machine: Machine = MACHINE) -> float:
    """Objects a second of each device, against one device that computes 8 of them at a time and never waits."""
    alone = compute_seconds(8, machine=machine) / 8
    return alone * objects / step_seconds(devices, objects, threads, machine)


def generation_table() -> str:
    """Markdown: rendering and storing the data sets, on the cores beside the GPUs."""
    lines = [
        "| objects | core hours | "
        + " | ".join(f"hours, {MACHINE.cores * n:,} cores" for n in DEVICES)
        + " | packed, GB | decoded, GB |",
        "|---:|---:|" + "---:|" * len(DEVICES) + "---:|---:|",
    ]
    for size in SIZES:
        hours = size * OBJECT.render_seconds / HOUR
        each = " | ".join(figure(hours / (MACHINE.cores * n)) for n in DEVICES)
        stored = " | ".join(figure(size * x / 1e9) for x in (OBJECT.packed_bytes, OBJECT.decoded_bytes))
        lines.append(f"| {size:,} | {figure(hours)} | {each} | {stored} |")
    return "\n".join(lines) + "\n"


def training_table() -> str:
    """Markdown: steps of all numbers of devices, and hours of EPOCHS epochs."""
    heads = [f"{size:,} objects, hours" for size in SIZES]
    lines = [
        "| GPUs | objects each | ms compute | ms sum | ms a step | objects/s | efficiency | "
        + " | ".join(heads)
        + " | read from disk, GB/s |",
        "|---:|---:|---:|---:|---:|---:|---:|" + "---:|" * len(heads) + "---:|",
    ]
    for devices, objects in ((1, 8), (8, 1), *((n, 8) for n in DEVICES[1:])):
        seconds = step_seconds(devices, objects, math.inf)
        rate = devices * objects / seconds
        hours = " | ".join(figure(EPOCHS * size / rate / HOUR) for size in SIZES)
        lines.append(
            f"| {devices} | {objects} | {1e3 * compute_seconds(objects):.1f} | {1e3 * reduce_seconds(devices):.1f} | "
            f"{1e3 * seconds:.1f} | {rate:,.0f} | {efficiency(devices, objects, math.inf):.0%} | {hours} | "
            f"{figure(rate * OBJECT.packed_bytes / 1e9)} |"
        )
    return "\n".join(lines) + "\n"


LAYOUTS = {
    f"a process a host: {READERS} threads for {MACHINE.per_host} GPUs": READERS / MACHINE.per_host,
    f"a process a GPU: {READERS} threads each": float(READERS),
    f"{2 * READERS} threads a GPU": 2.0 * READERS,
    "all in memory": math.inf,
}


def faster(times: float) -> Machine:
    """The machine that reaches so many times the shares that are assumed."""
    return dataclasses.replace(
        MACHINE,
        reached_operations=times * MACHINE.reached_operations,
        reached_bandwidth=times * MACHINE.reached_bandwidth,
    )


def threads_of(layout: float, devices: int) -> float:
    """Threads that read for each device: those of a process are shared among the devices that there are."""
    return READERS / min(devices, MACHINE.per_host) if layout < READERS else layout


def efficiency_table() -> str:
    """Markdown: efficiency by who reads, 8 objects on each device, at half to one and a half of the assumed shares."""
    cases = [(times, devices) for times in (0.5, 1.0, 1.5) for devices in DEVICES]
    names = [f"{n} GPU{'s' * (n > 1)}" + ("" if times == 1 else f", x {times}") for times, n in cases]
    lines = [f"| who reads | {' | '.join(names)} |", "|---|" + "---:|" * len(names)]
    for name, layout in LAYOUTS.items():
        cells = [efficiency(n, 8, threads_of(layout, n), faster(times)) for times, n in cases]
        lines.append(f"| {name} | " + " | ".join(f"{cell:.0%}" for cell in cells) + " |")
    milliseconds = [f"{1e3 * compute_seconds(8, machine=faster(times)):.1f}" for times, _ in cases]
    return "\n".join([*lines, f"| ms to compute | {' | '.join(milliseconds)} |"]) + "\n"


TABLES = (generation_table, training_table, efficiency_table)


def figure(value: float) -> str:
    """Two significant digits, or three above 10; thousands apart."""
    if value >= 100:
        return f"{float(f'{value:.3g}'):,.0f}"
    return f"{value:.3g}" if value >= 10 else f"{value:.2g}"


def plot(counts: Sequence[int] = (1, 2, 4, 8, 16, 32, 64, 128, 256)) -> bytes:
    """PNG: efficiency over devices by who reads."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(7, 4), layout="constrained")
    axes = drawing.subplots()
    for (name, layout), color in zip(LAYOUTS.items(), ("#d9480f", "#e8a700", "#2457d6", "#2f9e44"), strict=True):
        values = [efficiency(n, 8, threads_of(layout, n), faster(1.5)) for n in counts]
        axes.plot(counts, values, ls="--" if layout == math.inf else "-", marker="o", ms=4, color=color, label=name)
    axes.set_xscale("log", base=2)
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.set_ylim(0, 1.05)
    axes.set_xlabel("GPUs, 8 objects each")
    axes.set_ylabel("efficiency (estimate)")
    axes.set_title("at 1.5 times the rates that are assumed", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.2)
    axes.legend(frameon=False, fontsize=8)
    stream = io.BytesIO()
    drawing.savefig(stream, format="png", dpi=110)
    return stream.getvalue()


@dataclass(frozen=True, kw_only=True)
class CostModel:
    """Print what large data sets cost, and draw the efficiency."""

    out: Path = Path("runs/cost_model")
    """Folder of tables and curve."""


def main(options: CostModel) -> None:
    """Writes tables and curve."""
    text = "\n".join(make() for make in TABLES)
    write_whole(options.out / "tables.md", text.encode())
    write_whole(options.out / "efficiency.png", plot())
    print(text)


if __name__ == "__main__":
    run = partial(tyro.cli, CostModel, prog="python -m experiments.cost_model")
    sys.exit(cli.guarded(lambda: main(run()), "cost_model"))
