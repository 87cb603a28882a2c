"""How quality depends on the number of points at test: 128 to 10,000, every method on the same points and cameras.

    python -m experiments.studies.point_count --data DIR --out DIR --runs RUN ... [--table1 DIR] [--surfaces ...]

The points of a count are the first ones that the data set holds; where it holds fewer, as many are drawn from the
object's mesh, made again from the data set's records.  All clouds of a count have one shape, so that a method compiles
once for it.  The radius of the point renderers, in point spacings, is chosen once, at the networks' own count.

    OUT/scores/   PSNR, FLIP and opacity IoU of every object; what is there is kept, so a stopped call goes on
    OUT/results.json  OUT/table.md  OUT/point_count.png  OUT/strip.png
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments import entry_point
from experiments.comparison import contenders, figures, poisson, results_folder, scores
from experiments.comparison.contenders import LABELS, Method, Network, Sources
from experiments.comparison.scores import Measured
from experiments.comparison.study_objects import details, mesh_of, test_objects
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import Dataset, ObjectData
from spnr_jax.formats.images import png
from spnr_jax.formats.mesh import surface_points
from spnr_jax.kernels.records import PointCloud
from spnr_jax.scoring import evaluation, summary
from spnr_jax.scoring.report import QUALITY, Table, number, text

METRICS = ("psnr", "flip", "iou")
COUNTS = (128, 256, 512, 1024, 2048, 4096, 10_000)


@dataclass(frozen=True, kw_only=True)
class PointCount:
    """Render unseen objects from few and from many points."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results; the same command goes on there."""
    sources: tyro.conf.OmitArgPrefixes[Sources] = field(default_factory=Sources)
    counts: tuple[int, ...] = COUNTS
    """Numbers of points."""
    surfaces: tuple[Literal["poisson", "poisson_trimmed"], ...] = ()
    """Poisson surfaces to compare with: made of the points, and rendered by Mitsuba (seconds an object and count)."""
    meshes: Path | None = None
    """Folder of the mesh files that the data set was made from, if it was: for more points than it holds."""
    envmap: Path | None = None
    """The environment map of the data set, where that is a file: Poisson surfaces are rendered in it."""
    objects: int | None = None
    """Test objects, spread over the split (default: all)."""
    variant: str = "auto"
    """Mitsuba variant: scalar_rgb, llvm_ad_rgb, or auto for the faster one that works here."""
    quick: bool = False
    """A check that everything works: two objects, the first and the last count."""

    def __post_init__(self) -> None:
        if not self.counts or min(self.counts) < 1 or list(self.counts) != sorted(set(self.counts)):
            raise UserError(f"--counts: expected rising numbers of points, got {' '.join(map(str, self.counts))}")


def main(options: PointCount) -> None:
    """Measures what is missing, then writes results, tables, curves and pictures."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, 2 if options.quick else options.objects)
    trained = contenders.networks(options.sources, dataset)
    config, counts = next(iter(trained.values())).config, available_counts(options, dataset, names[0])
    compared = all_methods(options, dataset, trained, config)
    made_of = {label: method.identity for label, method in compared.items()}
    results_folder.claim(options.out, "point counts", {"objects": names}, dataset)
    for label, identity in made_of.items():
        results_folder.claim(options.out / "made_of" / label, f"scores of {label}", identity)
    rows = {
        f"{label}, {count} points": partial(measure, options, dataset, method, count)
        for label, method in compared.items()
        for count in counts
    }
    shown = names[len(names) // 2]
    found = scores.measure_rows(options.out, rows, dataset, names, [shown])
    by_method = {label: {n: found[f"{label}, {n} points"] for n in counts} for label in compared}
    class_count = min(counts, key=lambda count: abs(np.log(count / config.test_points)))
    whole = {
        "curves": {label: curve(compared[label], of) for label, of in by_method.items()},
        "counts": counts,
        "objects": list(names),
        "classes": by_class({label: dict(zip(names, of[class_count], strict=True)) for label, of in by_method.items()}),
        "made of": made_of,
        "trained on": [config.min_points, config.max_points],
        "class points": class_count,
        "hardware": runtime.hardware(),
        "data": dataset.settings.get("settings", {}),
        "seed": "that of the data set's points; nothing else is drawn",
    }
    picture = partial(scores.picture_of, options.out, dataset=dataset, name=shown)
    drawn = [label for label in compared if label != LABELS["white"]]
    cells = [
        [scores.reference(dataset, shown)]
        + [picture(row, measure=rows[row]) for row in (f"{label}, {count} points" for count in counts)]
        for label in drawn
    ]
    strip = figures.grid(cells, [shown, *(f"{count:,} points" for count in counts)], drawn, 128)
    files = {"point_count.png": plot(whole), "strip.png": png(strip)}
    results_folder.write(options.out, whole, tables_of(whole), notes(whole), files)


def available_counts(options: PointCount, dataset: Dataset, name: str) -> list[int]:
    """The counts that can be had; a line names those that cannot, and why."""
    counts = [options.counts[0], options.counts[-1]] if options.quick else list(options.counts)
    item = data_sets.read_object(dataset, name)
    stored = len(item.cloud.positions)
    try:
        if counts[-1] > stored:
            mesh_of(dataset, item, options.meshes)
    except ValueError as error:
        left_out = [count for count in counts if count > stored]
        print(f"left out {', '.join(map(str, left_out))} points: the data set holds {stored} an object, and {error}")
        counts = [count for count in counts if count <= stored] or [stored]
    return counts


def all_methods(
    options: PointCount, dataset: Dataset, trained: Mapping[str, Network], config: TrainConfig
) -> dict[str, Method]:
    """Networks, Poisson surfaces, and the trivial renderers."""
    found = {label: network.as_method() for label, network in trained.items()}
    if options.surfaces:
        poisson.check_packages()
        renderer = poisson.Renderer(dataset.settings, options.envmap, options.variant)
        found |= {LABELS[name]: renderer.method(name) for name in options.surfaces}
    floors = contenders.floors(evaluation.FLOORS, dataset, config)
    return found | {LABELS[name]: floor for name, floor in floors.items()}


def measure(options: PointCount, dataset: Dataset, method: Method, count: int, item: ObjectData) -> Measured:
    """Mean scores of an object's views from so many points, and the picture of the first one."""
    item = dataclasses.replace(item, cloud=cloud_of(dataset, item, count, options.meshes))
    pictures = method.show(item)
    found = evaluation.score_pictures(item, pictures)
    return {metric: float(np.mean(found[metric])) for metric in METRICS}, np.asarray(pictures.image[0])


def cloud_of(dataset: Dataset, item: ObjectData, count: int, meshes: Path | None) -> PointCloud:
    """So many points of an object: stored ones, or if there are not enough new ones from its mesh."""
    if count <= len(item.cloud.positions):
        return data_sets.first_points(item, count)
    seed = details(dataset, item.name)["seeds"]["points"]
    drawn = surface_points.sample_surface(mesh_of(dataset, item, meshes), count, seed, dataset.spread)
    columns = {name: getattr(drawn, name) for name in ("positions", "base_color", "roughness", "metallic")}
    return PointCloud(**columns, mask=np.ones(count, bool))


def curve(method: Method, by_count: Mapping[int, Sequence[Mapping]]) -> dict[str, list[dict]]:
    """Each metric at each count: mean over objects, and its bootstrap interval."""
    return {
        metric: [
            {
                "points": count,
                "mean": float(np.mean([of[metric] for of in objects])),
                "interval": summary.interval([np.array([of[metric]]) for of in objects]),
            }
            for count, objects in by_count.items()
        ]
        for metric in METRICS
        if metric != "iou" or method.has_opacity
    }


def by_class(psnr: Mapping[str, Mapping[str, Mapping]]) -> dict[str, dict]:
    """For each class its number of objects, each method's mean PSNR, and on how many objects it is best."""
    objects = list(next(iter(psnr.values())))
    best = {name: max(psnr, key=lambda label: psnr[label][name]["psnr"]) for name in objects}
    return {
        category: {
            "objects": len(names),
            "psnr": {label: float(np.mean([of[name]["psnr"] for name in names])) for label, of in psnr.items()},
            "best on": {label: sum(best[name] == label for name in names) for label in psnr},
        }
        for category, names in evaluation.classes_of(objects).items()
    }


def tables_of(found: Mapping) -> list[Table]:
    """A table for each metric, methods x counts, and one of the classes of objects at one count."""
    counts, made = found["counts"], []
    for metric in METRICS:
        head, decimals, _ = QUALITY[metric]
        rows = tuple(
            (label, tuple(number(at["mean"], decimals, at["interval"]) for at in curves.get(metric, ())))
            for label, curves in found["curves"].items()
        )
        rows = tuple((label, cells or (text("n/a"),)) for label, cells in rows)
        made.append(Table(title=f"{head}, by number of points", heads=tuple(f"{n:,}" for n in counts), rows=rows))
    classes = found["classes"]
    heads = (*(f"{name} ({one['objects']})" for name, one in classes.items()), "best on objects")
    rows = tuple(
        (
            label,
            (
                *(number(one["psnr"][label], 2) for one in classes.values()),
                number(sum(one["best on"][label] for one in classes.values()), 0),
            ),
        )
        for label in found["curves"]
    )
    return [*made, Table(title=f"PSNR, dB, {found['class points']:,} points", heads=heads, rows=rows)]


def notes(found: Mapping) -> list[str]:
    """What a reader has to know of the numbers."""
    low, high = found["trained on"]
    how = "means over objects with 95 % bootstrap intervals"
    return [
        f"{len(found['objects'])} unseen objects; {how}. {found['hardware']}.",
        f"The first network trained on {low} to {high} points.",
    ]


@figures.drawing
def plot(found: Mapping) -> Figure:
    """Each metric over the number of points; bands are the intervals, grey is what the network trained on."""
    figure = Figure(figsize=(14, 4.2))
    panels = figure.subplots(1, len(METRICS))
    for axes, metric in zip(panels, METRICS, strict=True):
        axes.axvspan(*found["trained on"], color="#f1f3f5", zorder=0)
        for (label, curves), color in zip(found["curves"].items(), figures.COLORS * 3, strict=False):
            if metric in curves:
                draw_curve(axes, curves[metric], label, color)
        axes.set_xscale("log")
        axes.set_xticks(found["counts"], [f"{count:,}" for count in found["counts"]])
        axes.minorticks_off()
        axes.set_xlabel("points at test")
        axes.set_ylabel(QUALITY[metric][0] + (", lower is better" if metric == "flip" else ""))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def draw_curve(axes: Axes, rows: Sequence[Mapping], label: str, color: str) -> None:
    """One method's means and intervals."""
    counts = [row["points"] for row in rows]
    axes.plot(counts, [row["mean"] for row in rows], "o-", ms=4, color=color, label=label)
    if rows[0]["interval"] is not None:
        low, high = zip(*(row["interval"] for row in rows), strict=True)
        axes.fill_between(counts, low, high, color=color, alpha=0.08, lw=0)


if __name__ == "__main__":
    entry_point.run(main, PointCount, "studies.point_count")
