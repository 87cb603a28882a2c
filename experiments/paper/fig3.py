"""Figure 3, and beyond: depth maps of unseen objects beside the true depth, their errors, and floaters.

    python -m experiments.paper.fig3 --data DIR --out DIR --runs RUN ...

The truth is ray casting of the very meshes that the references were rendered from, made again from the data set's
records, along the rays of each method: its own pixels, through its own pixel centres.

    OUT/truth/SIZE/ID.npz      true distances of all views, inf beside the object
    OUT/depths/METHOD/ID.npz   a method's depth and opacity
    OUT/results.json           every metric, with intervals, and the conditions
    OUT/table.md  OUT/fig3_depth.png

What is there is kept, so the same command goes on where it was stopped.  It draws no random numbers.

A pixel of a method is opaque where its opacity is above a half, and lies in the silhouette where the pixel's ray meets
the object.  Distances are along the rays, in half diagonals of the object's box.

error, median, bias   mean and median of |depth - truth|, and mean of depth - truth, where opaque in the silhouette
surface               as error, of the depth without the share of what shines through (`without_background`)
missed                share of the silhouette that is not opaque
floaters              opaque pixels outside the silhouette, for each 1000 pixels outside
far_floaters          the same, of those farther from it than 1/32 of the picture: not its blurred edge
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from data_gen.render import views
from data_gen.render.variant import choose_variant, mitsuba_module
from experiments import entry_point
from experiments.comparison import contenders, figures, results_folder
from experiments.comparison.contenders import Method
from experiments.comparison.results_folder import load_or_make
from experiments.comparison.study_objects import cast_views, cut, mesh_of, test_objects
from spnr_jax import cli
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import depth_image, png
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.picture_scores import means
from spnr_jax.scoring.report import Table, number, text

OPAQUE = 0.5
EDGE = 1 / 32  # of the picture's width
METRICS = {  # head, decimals, and what the numbers are multiplied by
    "error": ("Mean error", 4, 1),
    "median": ("Median error", 4, 1),
    "bias": ("Mean signed error", 4, 1),
    "surface": ("Mean error of what is opaque", 4, 1),
    "missed": ("Missed, %", 2, 100),
    "floaters": ("Floaters, per 1000", 2, 1),
    "far_floaters": ("of them far, per 1000", 2, 1),
}

FLOATER, MISSED = np.array([0.85, 0.1, 0.1]), np.array([0.15, 0.35, 0.85])
WORST = 0.2  # error, in half diagonals, that the picture shows black
NOTE = (
    "Distances are along the rays, in half diagonals of the object's box. Means over views with 95 % bootstrap "
    "intervals over objects. Errors where a method is opaque inside the true silhouette: of the depth as it is "
    "rendered, which counts what nothing stops at the far side of the box, and of what is opaque alone. Floaters are "
    "opaque pixels outside the silhouette, far ones farther from it than 1/32 of the picture."
)
PICTURE = f"In the picture: errors in grey, black from {WORST:g} on; floaters red, missed pixels blue."

Maps = Float[np.ndarray, "views height width"]


@dataclass(frozen=True, kw_only=True)
class Fig3:
    """Depth maps of unseen objects, and how far they are from the truth."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results; the same command goes on there."""
    runs: tuple[Path, ...]
    """Networks: run folders, files of weights, or `surfels`, the network of the package."""
    meshes: Path | None = None
    """Folder of the mesh files that the data set was made from, if it was."""
    objects: int | None = None
    """Test objects, spread over the split (default: all)."""
    shown: int = 8
    """Objects in the picture."""
    variant: str = "auto"
    """Mitsuba variant: scalar_rgb, llvm_ad_rgb, or auto for the faster one that works here."""
    quick: bool = False
    """A check that everything works: two objects."""


def main(options: Fig3) -> None:
    """Makes what is missing of depths and truth, then scores, table and picture."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, 2 if options.quick else options.objects)
    results_folder.claim(options.out, "depths", {}, dataset)
    found, points = all_methods(options, dataset)
    mitsuba_module(choose_variant(options.variant)[0])
    for label, method in found.items():
        results_folder.claim(options.out / "depths" / label, f"depths of {label}", method.identity | {"points": points})
    scores: dict[str, list] = {name: [] for name in found}
    rows, shown = [], evaluation.spread(names, options.shown)
    for count, name in enumerate(names, start=1):
        item = cut(data_sets.read_object(dataset, name), points, normals=True)
        maps = object_maps(options, dataset, item, found)
        for label, (seen, acc, truth) in maps.items():
            scores[label].append(depth_scores(seen, acc, far_side(item.camera, truth.shape[1:]), truth))
        if name in shown:
            rows.append(picture_row(item, maps, scores))
        print(f"{count} of {len(names)}: {name}", flush=True)
    all_results = {
        "methods": {name: summarise(rows) for name, rows in scores.items()},
        "made of": {name: method.identity for name, method in found.items()},
        "points": points,
        "objects": list(names),
        "views": len(next(iter(maps.values()))[2]),
        "pixels": {method: truth.shape[-1] for method, (_, _, truth) in maps.items()},
        "hardware": runtime.hardware(),
        "data": dataset.settings.get("settings", {}),
        "seed": "nothing is drawn: samples lie at the middles of their strata",
    }
    heads = ["Reference", "True depth", *(f"{name}{end}" for name in found for end in (", depth", ", error"))]
    picture = figures.grid([cells for _, cells in rows], heads, [label for label, _ in rows], 128)
    results_folder.write(
        options.out, all_results, [table(all_results)], [NOTE, PICTURE], {"fig3_depth.png": png(picture)}
    )


def all_methods(options: Fig3, dataset: data_sets.Dataset) -> tuple[dict[str, Method], int]:
    """The networks that show depth, and the points that all are given."""
    trained = contenders.networks(options.runs, dataset)
    if left_out := [name for name, network in trained.items() if not network.has_depth]:
        print(f"left out, since they predict no depth: {', '.join(left_out)}")
    found = {name: network.as_method() for name, network in trained.items() if network.has_depth}
    if not found:
        raise UserError("--runs: none of these predicts depth; name a run of another method")
    return found, next(iter(trained.values())).config.test_points


def depths(method: Method, item: data_sets.ObjectData) -> tuple[np.ndarray, np.ndarray]:
    """Depth and opacity (views, h, w) as a method shows them."""
    pictures = method.show(item)
    assert pictures.depth is not None
    return np.asarray(pictures.depth), np.asarray(pictures.acc)


def object_maps(
    options: Fig3, dataset: data_sets.Dataset, item: data_sets.ObjectData, found: dict[str, Method]
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Depth, opacity and true depth (views, h, w) of an object by method; read where they are made."""
    maps = {}
    for name, method in found.items():
        seen, acc = load_or_make(options.out / "depths" / name / f"{item.name}.npz", partial(depths, method, item))
        size, place = seen.shape[1:], options.out / "truth" / f"{seen.shape[-1]}" / f"{item.name}.npz"
        (truth,) = load_or_make(place, partial(true_depth, dataset, item, options.meshes, size))
        maps[name] = (seen, acc, truth)
    return maps


def true_depth(
    dataset: data_sets.Dataset, item: data_sets.ObjectData, meshes: Path | None, size: tuple[int, ...]
) -> tuple[np.ndarray]:
    """Distances (views, *size) to the mesh that the object was made from."""
    cast = views.caster(mesh_of(dataset, item, meshes))
    return (cast_views(cast, cameras.resize(item.camera, *size)),)


def far_side(camera: Camera, size: tuple[int, ...]) -> np.ndarray:
    """Distances (views, *size) to the far side of the box, where rendered depths count what nothing stops."""
    rays = cameras.camera_rays(cameras.resize(camera, *size))
    return np.asarray(cameras.intersect_box(rays.origins, rays.directions)[1])


def picture_row(item: data_sets.ObjectData, maps: dict, scores: dict[str, list]) -> tuple[str, list[np.ndarray]]:
    """Reference, truth, and depth and error of each method, in the view whose error is the first method's median."""
    first = np.nan_to_num(next(iter(scores.values()))[-1]["error"], nan=np.inf)
    view = evaluation.median_view(first)
    finest = max((truth[view] for _, _, truth in maps.values()), key=len)
    inside = np.isfinite(finest)
    span = (float(finest[inside].min()), float(finest[inside].max())) if inside.any() else (0.0, 1.0)
    cells = [data_sets.on_white(item.images[view])]
    cells.append(depth_image(np.where(inside, finest, 0), inside, span))
    for seen, acc, truth in maps.values():
        cells += [depth_image(seen[view], acc[view], span), error_image(seen[view], acc[view], truth[view])]
    return f"{item.name}, view {view}", cells


def error_image(seen: np.ndarray, acc: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The error in grey (h, w, 3), black from WORST on; floaters red, what is missed blue."""
    inside, opaque = np.isfinite(truth), acc > OPAQUE
    grey = 1 - np.clip(np.abs(seen - np.where(inside, truth, 0)) / WORST, 0, 1)
    picture = np.where((inside & opaque)[..., None], grey[..., None], np.ones(3))
    picture[inside & ~opaque] = MISSED
    picture[~inside & opaque] = FLOATER
    return picture


def depth_scores(depth: Maps, acc: Maps, far: Maps, truth: Maps) -> dict[str, np.ndarray]:
    """Each metric for each view (views,), NaN where there is nothing to measure; the truth is inf beside the object."""
    views = [score(*maps) for maps in zip(depth, acc, far, truth, strict=True)]
    return {name: np.array([view[name] for view in views]) for name in METRICS}


def score(depth: np.ndarray, acc: np.ndarray, far: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """The metrics of one view (height, width)."""
    inside, opaque = np.isfinite(truth), acc > OPAQUE
    both, outside = inside & opaque, np.sum(~inside)
    off = depth[both].astype(np.float64) - truth[both]
    surface = without_background(depth[both], acc[both], far[both])
    distant = distance_transform_edt(~inside) > EDGE * truth.shape[1] if inside.any() else ~inside
    return {
        "error": mean(np.abs(off)),
        "median": float(np.median(np.abs(off))) if off.size else np.nan,
        "bias": mean(off),
        "surface": mean(np.abs(surface - truth[both])),
        "missed": mean(~opaque[inside]),
        "floaters": 1000 * float(np.sum(opaque & ~inside) / outside) if outside else np.nan,
        "far_floaters": 1000 * float(np.sum(opaque & distant) / outside) if outside else np.nan,
    }


def without_background(depth: np.ndarray, acc: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Mean distance of what stops the ray, where the opacity is above 0.

    A rendered depth (`compositing.expected_distance`) counts the light that nothing stops at the far side of the box.
    """
    return (depth.astype(np.float64) - (1 - acc) * far) / acc


def mean(values: np.ndarray) -> float:
    """The mean, NaN of nothing."""
    return float(np.mean(values)) if values.size else np.nan


def summarise(objects: Sequence[dict[str, np.ndarray]]) -> dict[str, dict]:
    """Mean of each metric over all views, with its bootstrap interval over objects; None where nothing was measured."""
    found = means(objects, METRICS)
    return {name: {"mean": found[name], "interval": found[f"{name}_interval"]} for name in METRICS}


def table(found: dict) -> Table:
    """The metrics of every method."""
    rows = []
    for name, row in found["methods"].items():
        cells = [
            number(row[metric]["mean"], decimals, row[metric]["interval"], factor=factor)
            for metric, (_, decimals, factor) in METRICS.items()
        ]
        rows.append((name, (text(found["pixels"][name]), *cells)))
    counts = f"{len(found['objects'])} unseen objects x {found['views']} views, {found['points']} points"
    title = f"{counts}; {found['hardware']}"
    return Table(title=title, heads=("Pixels", *(head for head, _, _ in METRICS.values())), rows=tuple(rows))


if __name__ == "__main__":
    entry_point.run(main, Fig3, "paper.fig3")
