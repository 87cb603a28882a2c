"""What speed costs in quality: a trained network rendered in many ways, and which of them nothing beats.

    python -m experiments.studies.speed_accuracy DATA RUN [RUN ...] [--out runs/speed_accuracy] [--objects 24]

Every run is rendered as it was trained, and with other sample counts, with samples near the points alone, with fewer
rays, in bfloat16 and from other numbers of points.  Networks that see the nearest points have samples nowhere else, and
as many rays as pixels.  Runs of other volume resolutions or widths add their own points.
Keeps every setting in a file of its own (an interrupted call goes on); writes the table and front.png: PSNR, SSIM and
FLIP against milliseconds a view, and PSNR against memory.

ms a view   median over objects of the fastest of several renderings of one view, the volume encoded before
ms encode   the same for the volume
MB          temporary memory of the compiled rendering
front       settings that no other beats in both PSNR and ms a view; its knee lies farthest above the line from its
            cheapest to its best, PSNR against the logarithm of the time
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.comparison.result_tables import Table, number, text
from experiments.comparison.trained_networks import test_objects
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.method import inference
from spnr_jax.model_config import PaperConfig, RayNetworkConfig, SamplingConfig
from spnr_jax.scoring import evaluation
from spnr_jax.training import checkpoint, optimisation

REPEATS = 5
TIMED_OBJECTS = 8
MARKERS = "osD^v<>P"  # of runs
GROUPS = {  # of settings, as the plot colours them
    "trained": "#1d2330",
    "samples": "#2457d6",
    "near points": "#2f9e44",
    "rays": "#d9480f",
    "bfloat16": "#9c36b5",
    "points": "#868e96",
}


@dataclass(frozen=True, kw_only=True)
class SpeedAccuracy:
    """Render trained networks in many ways and draw quality against cost."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set; its test objects are rendered."""
    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders."""
    out: Path = Path("runs/speed_accuracy")
    """Folder of results.json, table.md and front.png."""
    objects: int = 24
    """Test objects, evenly out of the split."""
    quick: bool = False
    """A few settings of the first run, for a test."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A way to render a run."""

    group: str
    name: str
    config: TrainConfig


def settings(config: TrainConfig) -> list[Setting]:
    """Every way to render a network, the trained one first."""
    model = config.model
    assert isinstance(model, RayNetworkConfig)

    def variant(group: str, name: str, points: int = config.test_points, **fields) -> Setting:
        changed = dataclasses.replace(config, test_points=points, model=dataclasses.replace(model, **fields))
        return Setting(group=group, name=name, config=changed)

    def samples(coarse: int, fine: int = 0, reach: int = 0) -> SamplingConfig:
        return dataclasses.replace(model.sampling, num_coarse=coarse, num_fine=fine, reach=reach)

    total = model.sampling.num_coarse + model.sampling.num_fine
    halves = [max(total // k, 2) for k in (1, 2, 4)]
    if model.sampling.reach:
        anywhere, near = [], [(n, model.sampling.reach) for n in (2 * total, 3 * total // 4, *halves[1:])]
    else:
        anywhere = [(n // 2, n // 2) for n in (2 * total, *halves[1:])] + [(n, 0) for n in halves[:2]]
        near = [(n, reach) for reach in (1, 2, 3) for n in (*halves, total // 8 + 1)]
    size = model.render_resolution if isinstance(model, PaperConfig) and model.upsamples else 0
    ways = [
        variant("trained", "as trained"),
        *(variant("samples", f"{coarse} + {fine}", sampling=samples(coarse, fine)) for coarse, fine in anywhere),
        *(variant("near points", f"{n} within {reach}", sampling=samples(n, reach=reach)) for n, reach in near),
        *(variant("rays", f"{n} x {n} rays", render_resolution=n) for n in (size // 2, size * 3 // 4) if size),
        variant("bfloat16", "bfloat16", precision="bfloat16"),
        *(variant("points", f"{n} points", points=n) for n in (256, 512, 2048, 4096)),
    ]
    return list({way.name: way for way in ways}.values())  # small counts give one setting twice


def main(options: SpeedAccuracy) -> None:
    """Measures the settings that are not measured, then writes the table and the plot."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, options.objects)
    results_folder.claim(options.out, "results", {"objects": list(names)}, dataset)
    todo = [(run, setting) for run in options.runs for setting in settings(checkpoint.read_config(run))]
    todo = todo[:: len(todo) // 4] if options.quick else todo
    rows, loaded = [], dict[Path, dict]()

    def measured(run: Path, setting: Setting) -> dict:
        if run not in loaded:
            loaded[run] = optimisation.averaged_variables(checkpoint.load_run(run)[1])
        found = measure(loaded[run], setting.config, dataset, names)
        print(f"{run.name}: {setting.name}: {found['psnr']:.2f} dB, {found['ms_view']:.2f} ms", flush=True)
        return {"run": str(run), "group": setting.group, "name": setting.name, **found}

    for count, (run, setting) in enumerate(todo):
        place = options.out / "settings" / f"{options.runs.index(run)} {setting.name}.json"
        rows.append(results_folder.kept(place, partial(measured, run, setting)))
        print(f"{count + 1} of {len(todo)}", flush=True)
    chosen = front(rows)
    found = {"hardware": machine.hardware(), "date": time.strftime("%Y-%m-%d"), "objects": len(names), "rows": rows}
    best = f"The knee of the front is {rows[knee(rows, chosen)]['name']}."
    results_folder.write(options.out, found, [table(rows, chosen)], [best], {"front.png": plot(rows, chosen)})


def measure(
    variables: dict, config: TrainConfig, dataset: data_sets.Dataset, names: tuple[str, ...]
) -> dict[str, float]:
    """Mean scores over the objects' images, times and memory of one setting."""
    show = {"ours": evaluation.network(variables, config)}
    scores = [result.scores["ours"] for result in evaluation.evaluate_objects(show, config, dataset, names)]
    means = {m: float(np.mean(np.concatenate([s[m] for s in scores]))) for m in ("psnr", "ssim", "flip", "iou")}
    model, encodes, views = config.model, [], []
    for name in names[:TIMED_OBJECTS]:
        item = data_sets.read_object(dataset, name)
        cloud = jax.tree.map(lambda x: jnp.asarray(x)[None], data_sets.test_cloud(item, config))
        camera = jax.tree.map(lambda x: jnp.asarray(x)[None, :1], item.camera)
        encodes.append(fastest(lambda c=cloud: inference.jitted_encode(variables, c, config=model)))
        scene = inference.jitted_encode(variables, cloud, config=model)
        side = inference.rays_per_side(model, item.camera.width)
        options = dataclasses.replace(inference.trained(model), rays_per_side=side)
        render = partial(inference.jitted_render, config=model, options=options)
        views.append(fastest(partial(render, variables, scene, camera)))
    analysis = inference.jitted_render.lower(variables, scene, camera, **render.keywords).compile().memory_analysis()
    memory = analysis.temp_size_in_bytes / 2**20 if analysis else float("nan")
    times = {"ms_view": float(np.median(views)), "ms_encode": float(np.median(encodes))}
    return {name: round(value, 4) for name, value in (means | times | {"temporary_mb": memory}).items()}


def fastest(work: Callable) -> float:
    """Milliseconds of the fastest of several calls; the first one, which compiles, does not count."""
    jax.block_until_ready(work())
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(work())
        times.append(1000 * (time.perf_counter() - start))
    return min(times)


def front(rows: list[dict]) -> list[int]:
    """Rows that no other beats in PSNR and time, cheapest first."""
    order = sorted(range(len(rows)), key=lambda i: (rows[i]["ms_view"], -rows[i]["psnr"]))
    chosen: list[int] = []
    for i in order:
        if not chosen or rows[i]["psnr"] > rows[chosen[-1]]["psnr"]:
            chosen.append(i)
    return chosen


def knee(rows: list[dict], chosen: list[int]) -> int:
    """The row of the front that lies farthest above the line from its cheapest to its best."""
    x = np.log([rows[i]["ms_view"] for i in chosen])
    y = np.array([rows[i]["psnr"] for i in chosen])
    x, y = ((v - v[0]) / (v[-1] - v[0]) if v[-1] != v[0] else np.zeros_like(v) for v in (x, y))
    return chosen[int(np.argmax(y - x))]


def table(rows: list[dict], chosen: list[int]) -> Table:
    """Settings of the front are marked, and differences are to the run as trained."""
    heads = ("setting", "PSNR, dB", "SSIM", "FLIP", "IoU", "ms a view", "ms encode", "MB")
    decimals = {"ssim": 3, "flip": 3, "iou": 3, "ms_view": 1, "ms_encode": 1, "temporary_mb": 0}
    made = []
    for i, row in enumerate(rows):
        base = next((r for r in rows if r["run"] == row["run"] and r["group"] == "trained"), row)
        mark = " (front, knee)" if chosen and i == knee(rows, chosen) else " (front)" if i in chosen else ""
        change = () if row is base else (f"({row['psnr'] - base['psnr']:+.2f})",)
        cells = [text(row["name"] + mark), number(row["psnr"], 2, more=change)]
        made.append((Path(row["run"]).name, (*cells, *(number(row[name], n) for name, n in decimals.items()))))
    return Table(title="Quality and cost of each setting", heads=heads, rows=tuple(made))


@figures.drawing
def plot(rows: list[dict], chosen: list[int]) -> Figure:
    """Quality against cost: colours are groups of settings, markers are runs."""
    figure = Figure(figsize=(14, 3.9))
    labels = {"psnr": "PSNR, dB", "ssim": "SSIM", "flip": "FLIP (lower is better)"}
    panels = [("ms_view", "psnr"), ("ms_view", "ssim"), ("ms_view", "flip"), ("temporary_mb", "psnr")]
    for axes, (x, y) in zip(figure.subplots(1, 4), panels, strict=True):
        scatter(axes, rows, x, y)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("ms a view" if x == "ms_view" else "MB of temporary memory")
        axes.set_ylabel(labels[y])
    first = figure.axes[0]
    first.plot([rows[i]["ms_view"] for i in chosen], [rows[i]["psnr"] for i in chosen], color="#adb5bd", zorder=2)
    best = rows[knee(rows, chosen)]
    place = (best["ms_view"], best["psnr"])
    first.annotate(f"knee: {best['name']}", place, xytext=(12, -24), textcoords="offset points")
    figure.legend(*first.get_legend_handles_labels(), loc="outside lower center", ncols=8)
    return figure


def scatter(axes: Axes, rows: list[dict], x: str, y: str) -> None:
    """A point for each setting."""
    runs = list(dict.fromkeys(row["run"] for row in rows))
    for group, color in GROUPS.items():
        for marker, run in zip(MARKERS, runs, strict=False):
            shown = [row for row in rows if (row["group"], row["run"]) == (group, run)]
            label = group if len(runs) == 1 else f"{Path(run).name}, {group}"
            x_values, y_values = ([row[name] for row in shown] for name in (x, y))
            axes.scatter(x_values, y_values, s=26, c=color, marker=marker, zorder=3, label=label)


if __name__ == "__main__":
    entry_point.run(main, SpeedAccuracy, "studies.speed_accuracy")
