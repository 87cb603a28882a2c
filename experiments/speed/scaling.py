"""How cost grows: least milliseconds of our network against the work it is given, along one axis at a time.

    python -m experiments.speed.scaling [--preset tiny] [--out runs/scaling] [--only AXIS ...] [--quick]

Work is counted in what the axis multiplies (points, voxels, pixels, ...).  Cost that is linear in the work has slope 1
between two points of a log-log plot, and less where something else that does not grow takes part of the time; the
table has the slope of a line through all points, and that of the last step, where the rest weighs least.

    OUT/AXIS.json  results.json  table.md  scaling.png
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.speed import ours, worker
from spnr_jax import cli
from spnr_jax.config import RayNetworkConfig, TrainConfig
from spnr_jax.devices import machine
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Batch
from spnr_jax.scoring.score_tables import Table, number, text


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """One axis: `case` makes network and inputs of a value, `work` counts what it multiplies."""

    mode: Literal["train_l1", "encode", "render"]
    values: tuple[int, ...]
    unit: str
    work: Callable[[int], int]
    case: Callable[[TrainConfig, int], tuple[TrainConfig, Batch]]


def with_points(config: TrainConfig, count: int) -> tuple[TrainConfig, Batch]:
    """Clouds of so many points."""
    return config, ours.batch(dataclasses.replace(config, min_points=count, max_points=count))


def with_objects(config: TrainConfig, count: int) -> tuple[TrainConfig, Batch]:
    """So many objects in a batch."""
    return config, ours.batch(dataclasses.replace(config, batch_objects=count))


def with_views(config: TrainConfig, count: int) -> tuple[TrainConfig, Batch]:
    """So many cameras for each object."""
    batch = ours.batch(config)
    return config, dataclasses.replace(batch, camera=jax.tree.map(lambda x: jnp.repeat(x, count, 1), batch.camera))


def with_pixels(config: TrainConfig, size: int) -> tuple[TrainConfig, Batch]:
    """Images of so many pixels along each side, by the same network."""
    batch = ours.batch(config)
    return config, dataclasses.replace(batch, camera=cameras.resize(batch.camera, size, size))


def with_volume(config: TrainConfig, resolution: int) -> tuple[TrainConfig, Batch]:
    """Volumes of so many voxels along each side."""
    assert isinstance(config.model, RayNetworkConfig)
    encoder = dataclasses.replace(config.model.encoder, volume_resolution=resolution)
    model = dataclasses.replace(config.model, encoder=encoder)
    return dataclasses.replace(config, model=model), ours.batch(config)


def with_samples(config: TrainConfig, count: int) -> tuple[TrainConfig, Batch]:
    """So many samples on each ray, half of them coarse."""
    assert isinstance(config.model, RayNetworkConfig)
    sampling = dataclasses.replace(config.model.sampling, num_coarse=count // 2, num_fine=count // 2)
    model = dataclasses.replace(config.model, sampling=sampling)
    return dataclasses.replace(config, model=model), ours.batch(config)


POWERS = tuple(2**i for i in range(21))
SWEEPS = {
    "points": Sweep(mode="encode", values=POWERS[9:], unit="points of an object", work=lambda n: n, case=with_points),
    "volume": Sweep(
        mode="encode",
        values=POWERS[5:8],
        unit="voxels along a side (work: cubed)",
        work=lambda n: n**3,
        case=with_volume,
    ),
    "image": Sweep(
        mode="render",
        values=POWERS[6:11],
        unit="pixels along a side (work: squared)",
        work=lambda n: n**2,
        case=with_pixels,
    ),
    "samples": Sweep(mode="render", values=POWERS[4:8], unit="samples of a ray", work=lambda n: n, case=with_samples),
    "views": Sweep(mode="render", values=POWERS[:5], unit="views of an object", work=lambda n: n, case=with_views),
    "objects": Sweep(
        mode="train_l1", values=POWERS[:5], unit="objects of a batch", work=lambda n: n, case=with_objects
    ),
}


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure how the cost of our network grows along each axis."""

    preset: Literal["tiny", "small", "abo"] = "tiny"
    """The sizes that an axis does not change; one object, one view, 1024 points."""
    out: Path = Path("runs/scaling")
    """Folder of the results; a stopped call goes on there."""
    only: tuple[Literal["points", "volume", "image", "samples", "views", "objects"], ...] = ()
    """Axes to measure (default: all)."""
    seconds: float = 2.0
    """Length of a measurement; at least three runs."""
    quick: bool = False
    """A check that everything works: the first two values of each axis, into OUT-quick."""


def main(options: Options) -> None:
    """Measures every axis that is not measured yet, a line for each value."""
    cli.set_up_jax()
    out = options.out.with_name(f"{options.out.name}-quick") if options.quick else options.out
    results_folder.claim(out, "costs", {"preset": options.preset})
    found, names = [], list[str](options.only or SWEEPS)
    for name in names:
        found.append(results_folder.kept(out / f"{name}.json", partial(measure, name, options)))
        print(f"{name}: slope {found[-1]['slope']:.2f}, last step {found[-1]['last_slope']:.2f}", flush=True)
    setting = {"hardware": machine.hardware(), "date": time.strftime("%Y-%m-%d"), "preset": options.preset}
    note = f"preset {options.preset}, {setting['hardware']}, {setting['date']}"
    results_folder.write(out, setting | {"axes": found}, [table(found)], [note], {"scaling.png": plot(found)})


def measure(name: str, options: Options) -> dict[str, Any]:
    """Least milliseconds at each value of an axis, and the slopes that follow."""
    sweep = SWEEPS[name]
    values = sweep.values[:2] if options.quick else sweep.values
    base, points = ours.twin_sized(options.preset, "train_l1"), []
    for value in values:
        config, batch = sweep.case(base, value)
        run = ours.function(config, batch, sweep.mode)
        run()  # compiles
        ms = min(worker.turn(run, 0.1 if options.quick else options.seconds))
        points.append({"value": value, "work": sweep.work(value), "ms": round(ms, 2)})
        print(f"{name} {value}: {ms:.1f} ms", flush=True)
    slope, last = slopes([point["work"] for point in points], [point["ms"] for point in points])
    row = {"axis": name, "mode": sweep.mode, "unit": sweep.unit, "points": points}
    return row | {"slope": round(slope, 3), "last_slope": round(last, 3)}


def slopes(work: Sequence[float], ms: Sequence[float]) -> tuple[float, float]:
    """Slope of the log-log line through all points, and between the last two."""
    x, y = np.log(work), np.log(ms)
    return float(np.polyfit(x, y, 1)[0]), float((y[-1] - y[-2]) / (x[-1] - x[-2]))


def table(found: Sequence[dict]) -> Table:
    """The milliseconds of each axis and its slopes."""
    rows = []
    for row in found:
        times = ", ".join(f"{point['value']}: {point['ms']:.1f}" for point in row["points"])
        slopes = number(row["slope"], 2), number(row["last_slope"], 2)
        rows.append((row["axis"], (text(row["mode"]), text(times), *slopes)))
    heads = ("mode", "value: ms", "slope", "of the last step")
    return Table(title="Milliseconds along each axis", heads=heads, rows=tuple(rows))


@figures.drawing
def plot(found: Sequence[dict]) -> Figure:
    """A log-log panel for each axis beside a line of slope 1 through its last point."""
    columns = min(len(found), 3)
    figure = Figure((4 * columns, 3.2 * -(-len(found) // columns)))
    panels = figure.subplots(-(-len(found) // columns), columns, squeeze=False).ravel()
    for panel, row in zip(panels, found, strict=False):
        work, ms = (np.array([point[name] for point in row["points"]]) for name in ("work", "ms"))
        panel.loglog(work, ms[-1] * work / work[-1], "--", color=figures.GREY, label="linear in its work")
        panel.loglog(work, ms, "o-", color=figures.BLUE, label=f"{row['mode']}, slope {row['slope']:.2f}")
        named = slice(None, None, -(len(work) // 6 + 1))  # from the last one back: all would overlap
        panel.set_xticks(work[named], [f"{point['value']:,}" for point in row["points"][named]])
        panel.minorticks_off()
        panel.yaxis.set_major_formatter("{x:g}")
        panel.set(xlabel=row["unit"], ylabel="ms", ylim=(ms.min() / 2, ms.max() * 2))
        panel.legend()
    for panel in panels[len(found) :]:
        panel.remove()
    return figure


if __name__ == "__main__":
    entry_point.run(main, Options, "speed.scaling")
