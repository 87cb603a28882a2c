"""What speed costs in quality: networks asked for pictures in many ways, and which of these nothing beats.

    python -m experiments.studies.speed_accuracy DATA [surfels RUN ...] [--sizes 128 512]

Each network draws test objects at every level of `--quality`, from other numbers of points, and in pictures of fewer
pixels that are enlarged.  `draft` of the network over surfels is discs and light alone.  What a network with an
upsampler draws at the one size that it has learnt is enlarged (or averaged).  Keeps
every setting in a file of its own (an interrupted call goes on); writes the tables and front.png.

ms a view   median over objects of the fastest of several drawings of all views, as of a film, the cloud encoded before;
            CPU time of all cores where that is what computes, so that other work on the machine does not count
s to encode the same for a cloud, once, all compiled
front       settings of a size that no other beats in both PSNR and ms a view
"""

import dataclasses
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from experiments import entry_point
from experiments.comparison import results_folder, scores
from experiments.comparison.contenders import checksums, draw_volume
from experiments.comparison.scores import Measured
from experiments.comparison.study_objects import cut, test_objects
from spnr_jax.config import NetworkConfig, Quality
from spnr_jax.devices import runtime
from spnr_jax.errors import require_at_least
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import ObjectData
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Encoded
from spnr_jax.method.model import Model
from spnr_jax.scoring.evaluation import check_known_light
from spnr_jax.scoring.report import Table, number, text
from spnr_jax.training.weights import load

COLUMNS = ("psnr", "ssim", "flip", "iou")
LEVELS: dict[str, tuple[Quality, ...]] = {  # method -> quality levels at which its pictures differ, the best first
    "paper": ("best", "balanced", "draft", "trained"),
    "surfels": ("best", "balanced", "draft"),
}
SHARES = (0.75, 0.5, 0.25)  # of the pixels along a side that are drawn; the picture is enlarged from there


class Setting(NamedTuple):
    """A way to ask a network for a picture; `share` of its pixels along a side are drawn."""

    group: str
    name: str
    points: int
    quality: Quality = "best"
    share: float = 1.0


def settings(config: NetworkConfig, counts: Sequence[int]) -> list[Setting]:
    """Every way to ask a network, its best level first; of all but the first number of points the levels alone."""
    levels, (first, *others) = LEVELS.get(config.method, ("best",)), counts
    ways = [Setting("level", level, first, level) for level in levels]
    if config.any_size:
        ways += [Setting("fewer pixels", f"best, {share:g} of the size", first, share=share) for share in SHARES]
        ways += [Setting("fewer pixels", "draft, 0.5 of the size", first, "draft", 0.5)] * ("draft" in levels)
    drawn: list[Quality] = [level for level in levels if level in ("best", "draft")]
    return ways + [Setting("points", f"{way}, {count:,} points", count, way) for count in others for way in drawn]


def front(rows: Sequence[dict]) -> list[int]:
    """Rows that no other beats in PSNR and time, cheapest first."""
    order = sorted(range(len(rows)), key=lambda i: (rows[i]["ms_view"], -rows[i]["psnr"]))
    chosen: list[int] = []
    for i in order:
        if not chosen or rows[i]["psnr"] > rows[chosen[-1]]["psnr"]:
            chosen.append(i)
    return chosen


def table(rows: Sequence[dict], chosen: Sequence[int]) -> Table:
    """Settings of one size; those of the front are marked, and differences are to the network's best level."""
    heads = ("setting", "PSNR, dB", "SSIM", "FLIP", "IoU", "ms a view", "s to encode")
    decimals = {"ssim": 3, "flip": 3, "iou": 3, "ms_view": 1, "s_encode": 2}
    made = []
    for i, row in enumerate(rows):
        base = next(r for r in rows if r["run"] == row["run"])
        mark = " (front)" if i in chosen else ""
        change = () if row is base else (f"({row['psnr'] - base['psnr']:+.2f})",)
        cells = [text(row["name"] + mark), number(row["psnr"], 2, more=change)]
        made.append((row["run"], (*cells, *(number(row[name], n) for name, n in decimals.items()))))
    return Table(title=f"Quality and cost at {rows[0]['size']} px", heads=heads, rows=tuple(made))


MARKERS = "osD^v<>P"  # of networks
GROUPS = {  # of settings, as the plot colours them
    "level": "#1d2330",
    "fewer pixels": "#d9480f",
    "points": "#868e96",
}
LABELS = {"psnr": "PSNR, dB", "flip": "FLIP (lower is better)", "iou": "opacity IoU"}


def plot(sizes: Sequence[tuple[Sequence[dict], Sequence[int]]]) -> bytes:
    """A PNG of quality against cost: of each size its rows, and which of them make the front."""
    figure = Figure(figsize=(14, 0.6 + 3.3 * len(sizes)), layout="constrained")
    for line, (rows, chosen) in zip(figure.subplots(len(sizes), 3, squeeze=False), sizes, strict=True):
        for axes, y in zip(line, LABELS, strict=True):
            _scatter(axes, rows, y)
        first = line[0]
        first.set_title(f"{rows[0]['size']} x {rows[0]['size']}")
        first.plot([rows[i]["ms_view"] for i in chosen], [rows[i]["psnr"] for i in chosen], color="#adb5bd", zorder=2)
    handles = {label: h for axes in figure.axes for h, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, metadata={"Software": None})
    return stream.getvalue()


def _scatter(axes: Axes, rows: Sequence[dict], y: str) -> None:
    """A point for each setting."""
    runs = list(dict.fromkeys(row["run"] for row in rows))
    for group, color in GROUPS.items():
        for marker, run in zip(cycle(MARKERS), runs, strict=False):
            if shown := [row for row in rows if (row["group"], row["run"]) == (group, run)]:
                label = group if len(runs) == 1 else f"{run}, {group}"
                across, up = ([row[name] for row in shown] for name in ("ms_view", y))
                axes.scatter(across, up, s=26, c=color, marker=marker, zorder=3, label=label)
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("ms a view")
    axes.set_ylabel(LABELS[y])


Volumes = dict[tuple[str, int], tuple[Encoded, float]]  # of object, points: encoded, in so many ms
REPEATS = 2
TIMED_OBJECTS = 4


@dataclass(frozen=True, kw_only=True)
class SpeedAccuracy:
    """Draw with trained networks in many ways, and show quality against cost."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set; its test objects are drawn."""
    runs: tyro.conf.Positional[tuple[str, ...]] = ("surfels",)
    """Networks: `surfels` of the package, run folders (the paper's, published methods) or files of weights."""
    out: Path = Path("runs/speed_accuracy")
    """Folder of the results."""
    sizes: tuple[int, ...] = (512, 128)
    """Pixels along each side of the pictures that are looked at: those of the data set, or a whole share of them."""
    counts: tuple[int, ...] = (16384, 1024, 4096, 65536)
    """Points of an object, the first of its file; all settings with the first number, `best` and `draft` with more."""
    objects: int = 8
    """Test objects, evenly out of the split."""
    views: int = 2
    """Views of an object."""
    quick: bool = False
    """A few settings of each network, for a test."""

    def __post_init__(self) -> None:
        require_at_least(self, 1, "sizes", "counts", "objects", "views")


class Row(NamedTuple):
    """A setting of a run at a size, and what measures it."""

    number: int
    run: str
    size: int
    setting: Setting
    measure: scores.Measure

    @property
    def place(self) -> str:
        """The name of its folder."""
        return f"{self.number} {self.size} {self.setting.points} {self.setting.name}"

    def summary(self, objects: Sequence[dict]) -> dict[str, Any]:
        """Means of the scores, medians of the times."""
        found = {name: float(np.mean([of[name] for of in objects])) for name in COLUMNS}
        for name in ("ms_view", "s_encode"):
            found[name] = float(np.median([of[name] for of in objects if of[name] is not None]))
        described = {"run": self.run, "size": self.size, "group": self.setting.group, "name": self.setting.name}
        return described | {name: round(value, 4) for name, value in found.items()}


def main(options: SpeedAccuracy) -> None:
    """Measures the settings that are not measured, then writes the tables and the plot."""
    dataset = data_sets.open_dataset(options.data)
    for run in options.runs:
        check_known_light(load(run).config, dataset)
    names = test_objects(dataset, options.objects, max(options.counts), *options.sizes)
    asked = {"objects": names, "views": options.views, "runs": list(checksums(options.runs).items())}
    results_folder.claim(options.out, "speed_accuracy", asked, dataset)
    rows = [row for number in range(len(options.runs)) for row in rows_of(number, options, names)]
    telling = sorted(rows, key=lambda row: row.setting.group != "level")  # the most telling ones first
    measured = scores.measure_rows(options.out, {row.place: row.measure for row in telling}, dataset, names)
    found = [row.summary(measured[row.place]) for row in rows]
    whole = {
        "hardware": runtime.describe_hardware(),
        "load": runtime.measure_load(),
        "date": time.strftime("%Y-%m-%d"),
        "rows": found,
    }
    sizes = [of for size in options.sizes if (of := [row for row in found if row["size"] == size])]
    fronts = [(of, front(of)) for of in sizes]
    tables = [table(of, chosen) for of, chosen in fronts]
    note = f"{len(names)} objects x {options.views} views, {options.counts[0]:,} points where nothing else is said."
    notes = [note, f"{whole['hardware']}, load {whole['load']}, {whole['date']}."]
    results_folder.write(options.out, whole, tables, notes, {"front.png": plot(fronts)})


def rows_of(number: int, options: SpeedAccuracy, names: Sequence[str]) -> list[Row]:
    """All settings of a network at all sizes."""
    run = options.runs[number]
    model = load(run)
    ways = settings(model.config, options.counts)
    ways = ways[:: max(len(ways) // 3, 1)] if options.quick else ways
    measure_one = partial(measure, model, Volumes({}), names[:TIMED_OBJECTS])
    return [
        Row(number, run, size, way, partial(measure_one, way, options.views, size))
        for size in options.sizes
        for way in ways
    ]


def measure(
    model: Model, volumes: Volumes, timed: Sequence[str], way: Setting, views: int, size: int, item: ObjectData
) -> Measured:
    """Mean scores of an object's pictures and times of one setting at one size; `timed` are objects."""
    item = cut(item, way.points, views, size)
    key = item.name, way.points
    if key not in volumes:  # levels and sizes share it
        model.encode(item.cloud)
        volumes[key] = take_time(partial(model.encode, item.cloud))
    volume, ms = volumes[key]
    drawn = max(round(way.share * size / 4) * 4, 16) if model.config.any_size else model.config.image_resolution
    small = item if drawn == size else dataclasses.replace(item, camera=cameras.resize(item.camera, drawn, drawn))
    film = partial(draw_volume, model, volume, small, way.quality)
    scored = scores.score_views(item, film())
    found = scores.mean_scores({name: scored[name] for name in COLUMNS}) | {"s_encode": ms / 1e3, "ms_view": None}
    if item.name in timed:
        found["ms_view"] = min(take_time(film)[1] for _ in range(REPEATS)) / len(item.images)
    return found, item.images[0]


def take_time(work: Callable[[], Any]) -> tuple[Any, float]:
    """What the work gives, and its milliseconds, of CPU time where JAX computes on a CPU: other work does not count."""
    now = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    start = now()
    result = jax.block_until_ready(work())
    return result, 1000 * (now() - start)


if __name__ == "__main__":
    entry_point.run(main, SpeedAccuracy, "studies.speed_accuracy")
