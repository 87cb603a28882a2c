"""What speed costs in quality: networks asked for pictures in many ways, and which of these nothing beats.

    python -m experiments.studies.speed_accuracy DATA [surfels small RUN ...] [--sizes 128 512] [--out OUT]

Each network draws test objects at every level of `--quality`, from other numbers of points, and in pictures of fewer
pixels that are enlarged.  Networks of rays also draw with other samples, in all of the box and near the points, and in
bfloat16.  `draft` of the network over surfels is discs and light alone.  A size that a network has not learnt is left
out.  Keeps every setting in a file of its own (an interrupted call goes on); writes the tables and front.png.

ms a view   median over objects of the fastest of several drawings of one view, the cloud encoded before
s to encode the same for a cloud
MB          of memory at most above what was held before the picture, the largest over objects
front       settings of a size that no other beats in both PSNR and ms a view; its knee lies farthest above the line
            from its cheapest to its best, PSNR against the logarithm of the time
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import entry_point
from experiments.comparison import results_folder
from experiments.comparison.object_views import told, view_of
from experiments.comparison.peak_memory import forget_peak, peak_mb
from experiments.comparison.result_tables import Table, number, text
from experiments.comparison.trained_networks import test_objects
from experiments.studies.speed_accuracy_plot import plot
from spnr_jax import cli
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.kernels import cameras, metrics
from spnr_jax.kernels.records import Camera
from spnr_jax.method.model import Model, Quality, Volume
from spnr_jax.model_config import NetworkConfig, RayNetworkConfig, SurfelConfig
from spnr_jax.scoring.flip import flip
from spnr_jax.training.weights import load

REPEATS = 5
TIMED_OBJECTS = 8
SHARES = (0.75, 0.5, 0.25)  # of the pixels along a side that are drawn; the picture is enlarged from there


@dataclass(frozen=True, kw_only=True)
class SpeedAccuracy:
    """Draw with trained networks in many ways, and show quality against cost."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set; its test objects are drawn."""
    runs: tyro.conf.Positional[tuple[str, ...]] = ("surfels", "small")
    """Networks: of the package, run folders (the paper's, published methods) or files of weights."""
    out: Path = Path("runs/speed_accuracy")
    """Folder of the results."""
    sizes: tuple[int, ...] = (128, 512)
    """Pixels along each side of the pictures that are looked at: those of the data set, or a whole share of them."""
    counts: tuple[int, ...] = (16384, 1024, 4096)
    """Points of an object, the first of its file; all settings with the first number, the levels with the others."""
    objects: int = 16
    """Test objects, evenly out of the split."""
    views: int = 2
    """Views of an object."""
    quick: bool = False
    """A few settings of each network, for a test."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A way to ask a network for a picture; `share` of its pixels along a side are drawn."""

    group: str
    name: str
    config: NetworkConfig
    points: int
    quality: Quality = "best"
    share: float | int = 1


@dataclass
class Drawn:
    """What was measured of one setting, object by object."""

    scores: list[dict[str, float]] = field(default_factory=list)
    view_ms: list[float] = field(default_factory=list)
    encode_s: list[float] = field(default_factory=list)
    mb: list[int] = field(default_factory=list)


def settings(config: NetworkConfig, counts: Sequence[int]) -> list[Setting]:
    """Every way to ask a network, its best level first; of all but the first number of points the levels alone."""
    levels: tuple[Quality, ...] = ("best",)
    if isinstance(config, SurfelConfig):
        levels = ("best", "draft")
    elif isinstance(config, RayNetworkConfig):
        levels = ("best", "balanced", "draft", "trained")
    common: dict[str, Any] = {"config": config, "points": counts[0]}
    ways = [Setting(group="level", name=level, quality=level, **common) for level in levels]
    if config.any_size:
        enlarged: dict[str, Any] = {"group": "fewer pixels", **common}
        ways += [Setting(name=f"best, {share:g} of the size", share=share, **enlarged) for share in SHARES]
        if "draft" in levels:
            ways.append(Setting(name="draft, 0.5 of the size", quality="draft", share=0.5, **enlarged))
    if isinstance(config, RayNetworkConfig):
        ways += _of_rays(config, counts[0])
    for count in counts[1:]:
        ways += [
            Setting(group="points", name=f"{level}, {count:,} points", config=config, points=count, quality=level)
            for level in levels
        ]
    return ways


def _of_rays(config: RayNetworkConfig, points: int) -> list[Setting]:
    """Other samples along a ray, each drawn as the network was trained but for these, and bfloat16."""
    total, reach = config.sampling.num_coarse + config.sampling.num_fine, config.sampling.reach
    halves = [max(total // k, 2) for k in (1, 2, 4)]
    if reach:
        ways = [("near points", f"{n} near points", (n, 0, reach)) for n in (2 * total, 3 * total // 4, *halves[1:])]
    else:
        ways = [("samples", f"{n // 2} + {n // 2} in the box", (n // 2, n // 2, 0)) for n in (2 * total, *halves[1:])]
        ways += [("near points", f"{n} within {r} voxels", (n, 0, r)) for r in (1, 2, 3) for n in halves]

    def made(group: str, name: str, **changed: Any) -> Setting:
        other = dataclasses.replace(config, **changed)
        return Setting(group=group, name=name, config=other, points=points, quality="trained")

    names = ("num_coarse", "num_fine", "reach")
    found = [
        made(group, name, sampling=dataclasses.replace(config.sampling, **dict(zip(names, values, strict=True))))
        for group, name, values in ways
    ]
    found.append(made("bfloat16", "bfloat16", precision="bfloat16"))
    return list({way.name: way for way in found}.values())  # small counts give one setting twice


def main(options: SpeedAccuracy) -> None:
    """Measures the settings that are not measured, then writes the tables and the plot."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, options.objects)
    asked = {"objects": list(names), "views": options.views, "runs": list(options.runs)}
    results_folder.claim(options.out, "speed_accuracy", asked, dataset)
    rows = []
    for number_of_run, run in enumerate(options.runs):
        model = load(run)
        ways = settings(model.config, options.counts)
        for size in options.sizes:
            if not model.config.any_size and size != model.config.image_resolution:
                print(f"{run}: it has not learnt pictures of {size} pixels", flush=True)
                continue
            for way in ways[:: max(len(ways) // 3, 1)] if options.quick else ways:
                make = partial(measure, model, way, dataset, names, size, options.views)
                name = f"{number_of_run} {size} {way.points} {way.name}.json"
                found = results_folder.kept(options.out / "settings" / name, make)
                rows.append({"run": run, "size": size, "group": way.group, "name": way.name, **found})
                print(f"{run}, {size} px, {way.name}: {found['psnr']:.2f} dB, {found['ms_view']:.1f} ms", flush=True)
    found = {"hardware": machine.hardware(), "load": machine.load(), "date": time.strftime("%Y-%m-%d"), "rows": rows}
    tables = [made for size in options.sizes if (of := [r for r in rows if r["size"] == size]) for made in _both(of)]
    fronts = [[r for r in rows if r["size"] == size] for size in options.sizes]
    picture = plot([(of, front(of), knee(of, front(of))) for of in fronts if of])
    note = f"{len(names)} objects x {options.views} views, {options.counts[0]:,} points where nothing else is said."
    notes = [note, f"{found['hardware']}, load {found['load']}, {found['date']}."]
    results_folder.write(options.out, found, tables, notes, {"front.png": picture})


def measure(
    model: Model, way: Setting, dataset: data_sets.Dataset, names: Sequence[str], size: int, views: int
) -> dict[str, float]:
    """Mean scores over the objects' pictures, times and memory of one setting at one size."""
    model, found = dataclasses.replace(model, config=way.config), Drawn()
    for number_of_object, name in enumerate(names):
        item = data_sets.read_object(dataset, name)
        cloud = told(jax.tree.map(lambda x: x[: way.points], item.cloud), normals=False)
        volume = model.encode(cloud)
        pairs = [view_of(item, view, size) for view in range(min(views, len(item.images)))]
        drawn = max(round(way.share * size / 4) * 4, 16)
        asked = [cameras.resize(camera, drawn, drawn) if drawn != size else camera for camera, _ in pairs]
        for rendering, (_, reference) in zip(model.render_each(volume, asked, way.quality), pairs, strict=True):
            found.scores.append(_scores(np.asarray(rendering.image), np.asarray(rendering.acc), reference))
        if number_of_object < TIMED_OBJECTS:
            found.encode_s.append(fastest(lambda c=cloud: model.encode(c).scene) / 1e3)
            _time_view(found, model, volume, asked[0], way.quality)
    means = {name: float(np.mean([of[name] for of in found.scores])) for name in found.scores[0]}
    costs = {"ms_view": float(np.median(found.view_ms)), "s_encode": float(np.median(found.encode_s))}
    return {name: round(value, 4) for name, value in (means | costs | {"mb": max(found.mb)}).items()}


def _scores(image: np.ndarray, opacity: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Of a picture, enlarged to its reference (RGBA) where it is smaller."""
    shape = reference.shape[:2]
    image = np.clip(np.asarray(jax.image.resize(image, (*shape, 3), "cubic")), 0, 1)
    opacity = np.asarray(jax.image.resize(opacity, shape, "linear"))
    white = reference[..., :3] * reference[..., 3:] + 1 - reference[..., 3:]
    return {
        "psnr": float(metrics.psnr(jnp.asarray(image), jnp.asarray(white))),
        "ssim": float(metrics.ssim(jnp.asarray(image), jnp.asarray(white))),
        "flip": float(flip(jnp.asarray(image), jnp.asarray(white))),
        "iou": float(metrics.opacity_iou(jnp.asarray(opacity), jnp.asarray(reference[..., 3]))),
    }


def _time_view(found: Drawn, model: Model, volume: Volume, camera: Camera, quality: Quality) -> None:
    """Adds time and memory of one view, which was drawn before."""

    def draw() -> jax.Array:
        return model.render(volume, camera, quality).image

    found.view_ms.append(fastest(draw))
    forget_peak()
    before = peak_mb()
    jax.block_until_ready(draw())
    found.mb.append(peak_mb() - before)


def fastest(work: Callable) -> float:
    """Milliseconds of the fastest of several calls; the first one, which compiles, does not count."""
    jax.block_until_ready(work())
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(work())
        times.append(1000 * (time.perf_counter() - start))
    return min(times)


def front(rows: Sequence[dict]) -> list[int]:
    """Rows that no other beats in PSNR and time, cheapest first."""
    order = sorted(range(len(rows)), key=lambda i: (rows[i]["ms_view"], -rows[i]["psnr"]))
    chosen: list[int] = []
    for i in order:
        if not chosen or rows[i]["psnr"] > rows[chosen[-1]]["psnr"]:
            chosen.append(i)
    return chosen


def knee(rows: Sequence[dict], chosen: Sequence[int]) -> int:
    """The row of the front that lies farthest above the line from its cheapest to its best."""
    x = np.log([rows[i]["ms_view"] for i in chosen])
    y = np.array([rows[i]["psnr"] for i in chosen])
    x, y = ((v - v[0]) / (v[-1] - v[0]) if v[-1] != v[0] else np.zeros_like(v) for v in (x, y))
    return chosen[int(np.argmax(y - x))]


def _both(rows: Sequence[dict]) -> tuple[Table, Table]:
    return table(rows, front(rows)), steps(rows, front(rows))


def table(rows: Sequence[dict], chosen: Sequence[int]) -> Table:
    """Settings of one size; those of the front are marked, and differences are to the network's best level."""
    heads = ("setting", "PSNR, dB", "SSIM", "FLIP", "IoU", "ms a view", "s to encode", "MB")
    decimals = {"ssim": 3, "flip": 3, "iou": 3, "ms_view": 1, "s_encode": 2, "mb": 0}
    made = []
    for i, row in enumerate(rows):
        base = next(r for r in rows if r["run"] == row["run"])
        mark = " (front, knee)" if i == knee(rows, chosen) else " (front)" if i in chosen else ""
        change = () if row is base else (f"({row['psnr'] - base['psnr']:+.2f})",)
        cells = [text(row["name"] + mark), number(row["psnr"], 2, more=change)]
        made.append((Path(row["run"]).name, (*cells, *(number(row[name], n) for name, n in decimals.items()))))
    return Table(title=f"Quality and cost at {rows[0]['size']} px", heads=heads, rows=tuple(made))


def steps(rows: Sequence[dict], chosen: Sequence[int]) -> Table:
    """The front from its cheapest on: what each step costs and gives."""
    made = []
    for before, i in zip((None, *chosen), chosen, strict=False):
        row = rows[i]
        cells = [text(row["name"]), number(row["psnr"], 2), number(row["ms_view"], 1)]
        if before is not None:
            last = rows[before]
            cells.append(number(row["ms_view"] / last["ms_view"], 2))
            differences = {"psnr": 2, "flip": 3, "iou": 3}
            cells += [number(row[name] - last[name], n, sign="+") for name, n in differences.items()]
        made.append((Path(row["run"]).name, tuple(cells)))
    heads = ("setting", "PSNR, dB", "ms a view", "times as long as the row before", "PSNR", "FLIP", "IoU")
    return Table(title=f"The front at {rows[0]['size']} px, step by step", heads=heads, rows=tuple(made))


if __name__ == "__main__":
    entry_point.run(main, SpeedAccuracy, "studies.speed_accuracy")
