"""How quality depends on the number of points at test: 128 to 10,000, every method on the same points and cameras.

    python -m experiments.studies.point_count --data DIR --out DIR --runs RUN ... [--table1 DIR] [--surfaces ...]

The points of a count are the first ones that the data set holds; where it holds fewer, as many are drawn from the
object's mesh, made again from the data set's records.  All clouds of a count have one shape, so that a method compiles
once for it.  The radius of the point renderers, in point spacings, is chosen once, at the networks' own count.

    OUT/METHOD/COUNT.json   PSNR, FLIP and opacity IoU of every view; what is there is kept, so a stopped call goes on
    OUT/METHOD/COUNT.png    a picture of one object
    OUT/results.json  OUT/table.md  OUT/point_count.png  OUT/strip.png
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments import entry_point
from experiments.comparison import figures, poisson, results_folder, trained_networks
from experiments.comparison.object_scores import ObjectMethod
from experiments.comparison.poisson import SURFACES
from experiments.comparison.source_meshes import details, mesh_of
from experiments.comparison.trained_networks import LABELS, Network, Sources
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import png
from spnr_jax.formats.mesh import surface_points
from spnr_jax.kernels.records import PointCloud
from spnr_jax.scoring import evaluation, summary
from spnr_jax.scoring.report import QUALITY, Table, number, text

METRICS = ("psnr", "flip", "iou")


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
    how = "means over images with 95 % bootstrap intervals over objects"
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


COUNTS = (128, 256, 512, 1024, 2048, 4096, 10_000)

Scores = dict[str, dict[str, list[float]]]  # object -> metric -> score of each view


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


@dataclass(frozen=True, kw_only=True)
class Method:
    """How a method shows an object, what tells it from another one, and whether it predicts opacity."""

    show: ObjectMethod
    identity: dict
    has_opacity: bool = True


def main(options: PointCount) -> None:
    """Measures what is missing, then writes results, tables, curves and pictures."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = trained_networks.test_objects(dataset, 2 if options.quick else options.objects)
    trained = trained_networks.networks(options.sources, dataset)
    counts = available_counts(options, dataset, names[0])
    results_folder.claim(options.out, "point counts", {"objects": list(names)}, dataset)
    found = all_methods(options, dataset, trained)
    scores: dict[str, dict[int, Scores]] = {label: {} for label in found}
    for label, method in found.items():
        results_folder.claim(options.out / label, f"scores of {label}", method.identity)
        for count in counts:
            scores[label][count] = kept_scores(options, dataset, names, label, method, count)
    config = next(iter(trained.values())).config
    shown = shown_count(counts, config)
    whole = {
        "curves": {label: curve(found[label], scores[label]) for label in found},
        "counts": counts,
        "objects": list(names),
        "classes": by_class({label: by_count[shown] for label, by_count in scores.items()}),
        "made of": {label: method.identity for label, method in found.items()},
        "trained on": [config.min_points, config.max_points],
        "class points": shown,
        "hardware": runtime.hardware(),
        "data": dataset.settings.get("settings", {}),
        "seed": "that of the data set's points; nothing else is drawn",
    }
    drawn = [label for label in found if label != LABELS["white"]]
    files = {
        "point_count.png": plot(whole),
        "strip.png": png(strip(options, dataset, shown_object(names), drawn, counts)),
    }
    results_folder.write(options.out, whole, tables_of(whole), notes(whole), files)


def available_counts(options: PointCount, dataset: data_sets.Dataset, name: str) -> list[int]:
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


def all_methods(options: PointCount, dataset: data_sets.Dataset, trained: dict[str, Network]) -> dict[str, Method]:
    """Networks, Poisson surfaces, and the trivial renderers."""
    config = next(iter(trained.values())).config
    found = {label: of_network(network) for label, network in trained.items()}
    if options.surfaces:
        poisson.check_packages()
        renderer = poisson.Renderer(dataset.settings, options.envmap, options.variant)
        found |= {LABELS[name]: of_surface(renderer, name) for name in options.surfaces}
    for name in reversed(evaluation.FLOORS):
        factor = 1.0 if name == "white" else evaluation.choose_radius(dataset, config, name)
        found[LABELS[name]] = of_floor(name, factor)
    return found


def of_network(network: Network) -> Method:
    """A trained network."""
    return Method(
        show=lambda item: network.show()(item.cloud, item.camera),
        identity=network.identity,
        has_opacity=network.has_depth,
    )


def of_floor(name: str, factor: float) -> Method:
    """A trivial renderer with the radius of its points, in point spacings."""
    show = evaluation.floor(name, factor)
    return Method(
        show=lambda item: show(item.cloud, item.camera),
        identity={"radius factor": factor},
        has_opacity=name != "white",
    )


def of_surface(renderer: poisson.Renderer, name: str) -> Method:
    """A Poisson surface of the points."""

    def show(item: data_sets.ObjectData) -> evaluation.Pictures:
        rgba, _ = renderer.pictures(item, len(item.cloud.mask), SURFACES[name])
        return evaluation.Pictures(image=data_sets.on_white(rgba), acc=rgba[..., 3].astype(np.float32) / 255)

    return Method(show=show, identity=asdict(SURFACES[name]))


def kept_scores(
    options: PointCount, dataset: data_sets.Dataset, names: tuple[str, ...], label: str, method: Method, count: int
) -> Scores:
    """The scores of a method at a count, with a picture of one object; read where they are made."""
    place = options.out / label / f"{count}.json"

    def score() -> Scores:
        scores = {}
        for name in names:
            scores[name], image = measure(dataset, name, method, count, options.meshes)
            if name == shown_object(names):
                results_folder.kept(place.with_suffix(".png"), partial(np.asarray, image))
        print(f"{label}, {count} points: {mean(scores, 'psnr'):.2f} dB", flush=True)
        return scores

    return results_folder.kept(place, score)


def measure(
    dataset: data_sets.Dataset, name: str, method: Method, count: int, meshes: Path | None
) -> tuple[dict[str, list[float]], np.ndarray]:
    """Scores of every view of an object from so many points, and the picture of the first one."""
    item = data_sets.read_object(dataset, name)
    item = dataclasses.replace(item, cloud=cloud_of(dataset, item, count, meshes))
    pictures = evaluation.on_host(method.show(item))
    found = evaluation.score_pictures(item, pictures)
    return {metric: np.asarray(found[metric], np.float64).tolist() for metric in METRICS}, np.asarray(pictures.image[0])


def cloud_of(dataset: data_sets.Dataset, item: data_sets.ObjectData, count: int, meshes: Path | None) -> PointCloud:
    """So many points of an object: stored ones, or if there are not enough new ones from its mesh."""
    if count <= len(item.cloud.positions):
        return data_sets.first_points(item, count)
    seed = details(dataset, item.name)["seeds"]["points"]
    drawn = surface_points.sample_surface(mesh_of(dataset, item, meshes), count, seed, dataset.spread)
    return PointCloud(
        positions=drawn.positions,
        base_color=drawn.base_color,
        roughness=drawn.roughness,
        metallic=drawn.metallic,
        mask=np.ones(count, bool),
    )


def shown_object(names: Sequence[str]) -> str:
    """The object of the pictures: the middle one."""
    return names[len(names) // 2]


def mean(scores: Scores, metric: str) -> float:
    """Mean over all views."""
    return float(np.mean([value for found in scores.values() for value in found[metric]]))


def curve(method: Method, scores: dict[int, Scores]) -> dict[str, list[dict]]:
    """Each metric at each count: mean over all views, and its bootstrap interval over objects."""
    return {
        metric: [
            {
                "points": count,
                "mean": mean(found, metric),
                "interval": summary.interval([np.array(row[metric]) for row in found.values()]),
            }
            for count, found in scores.items()
        ]
        for metric in METRICS
        if metric != "iou" or method.has_opacity
    }


def shown_count(counts: Sequence[int], config: TrainConfig) -> int:
    """The count of the table of classes: the nearest to that of the network's evaluation."""
    return min(counts, key=lambda count: abs(np.log(count / config.test_points)))


def by_class(scores: dict[str, Scores]) -> dict[str, dict]:
    """For each class its number of objects, each method's mean PSNR over views, and on how many objects it is best."""
    first = next(iter(scores.values()))
    psnr = {label: {name: np.mean(found[name]["psnr"]) for name in first} for label, found in scores.items()}
    best = {name: max(psnr, key=lambda label: psnr[label][name]) for name in first}
    return {
        category: {
            "objects": len(names),
            "psnr": {label: float(np.mean([found[name] for name in names])) for label, found in psnr.items()},
            "best on": {label: sum(best[name] == label for name in names) for label in psnr},
        }
        for category, names in evaluation.classes_of(first).items()
    }


def strip(
    options: PointCount, dataset: data_sets.Dataset, name: str, labels: Sequence[str], counts: Sequence[int]
) -> np.ndarray:
    """One object: a row for each method, a column for each count, and the reference before them."""
    reference = data_sets.on_white(data_sets.read_object(dataset, name).images[0])
    rows = [
        [reference, *(results_folder.READERS[".png"](options.out / label / f"{count}.png") for count in counts)]
        for label in labels
    ]
    return figures.grid(rows, [name, *(f"{count:,} points" for count in counts)], labels, 128)


if __name__ == "__main__":
    entry_point.run(main, PointCount, "studies.point_count")
