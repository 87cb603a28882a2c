"""Figure 3, and beyond: depth maps of unseen objects beside the true depth, their errors, and floaters.

    python -m experiments.paper.fig3 --data DIR --out DIR --runs RUN ...

The truth is ray casting of the very meshes that the references were rendered from, made again from the data set's
records, along the rays of each method: its own pixels, through its own pixel centres.

    OUT/truth/SIZE/ID.npz      true distances of all views, inf beside the object
    OUT/scores/METHOD/ID.json  every metric of an object, and its first view as .png
    OUT/results.json  OUT/table.md  OUT/fig3_depth.png

What is there is kept, so the same command goes on where it was stopped.  It draws no random numbers.

A pixel of a method is opaque where its opacity is above a half, and lies in the silhouette where the pixel's ray meets
the object.  Distances are along the rays, in half diagonals of the object's box.

error, median, bias   mean and median of |depth - truth|, and mean of depth - truth, where opaque in the silhouette
surface               as error, of the depth without the share of what shines through (`without_background`)
missed                percentage of the silhouette that is not opaque
floaters              opaque pixels outside the silhouette, for each 1000 pixels outside
far_floaters          the same, of those farther from it than 1/32 of the picture: not its blurred edge
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt

from data_gen.render import views
from data_gen.render.variant import choose_variant, mitsuba_module
from experiments import entry_point
from experiments.comparison import figures, results_folder, scores
from experiments.comparison.contenders import Method, of_model
from experiments.comparison.scores import Measured
from experiments.comparison.study_objects import cast_views, cut, mesh_of, test_objects
from spnr_jax import cli
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import Dataset, ObjectData
from spnr_jax.formats.images import depth_image, png
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.report import Table
from spnr_jax.training import weights

OPAQUE = 0.5
EDGE = 1 / 32  # of the picture's width
COLUMNS = {  # head, decimals
    "error": ("Mean error", 4),
    "median": ("Median error", 4),
    "bias": ("Mean signed error", 4),
    "surface": ("Mean error of what is opaque", 4),
    "missed": ("Missed, %", 2),
    "floaters": ("Floaters, per 1000", 2),
    "far_floaters": ("of them far, per 1000", 2),
}

FLOATER, MISSED = np.array([0.85, 0.1, 0.1]), np.array([0.15, 0.35, 0.85])
WORST = 0.2  # error, in half diagonals, that the picture shows black
NOTE = (
    "Distances are along the rays, in half diagonals of the object's box. Means over objects with 95 % "
    "intervals. Errors where a method is opaque inside the true silhouette: of the depth as it is "
    "rendered, which counts what nothing stops at the far side of the box, and of what is opaque alone. Floaters are "
    "opaque pixels outside the silhouette, far ones farther from it than 1/32 of the picture."
)
PICTURE = f"In the picture: errors in grey, black from {WORST:g} on; floaters red, missed pixels blue."


@dataclass(frozen=True, kw_only=True)
class Fig3:
    """Depth maps of unseen objects, and how far they are from the truth."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results; the same command goes on there."""
    runs: tuple[str, ...]
    """Networks: run folders, files of weights, or `surfels`, the network of the package."""
    meshes: Path | None = None
    """Folder of the mesh files that the data set was made from, if it was."""
    points: int = 1024
    """Points of an object, the first of its file."""
    objects: int | None = None
    """Test objects, spread over the split (default: all)."""
    shown: int = 8
    """Objects in the picture."""
    variant: str = "auto"
    """Mitsuba variant: scalar_rgb, llvm_ad_rgb, or auto for the faster one that works here."""
    quick: bool = False
    """A check that everything works: two objects."""


def main(options: Fig3) -> None:
    """Makes what is missing of scores and truth, then table and picture."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, 2 if options.quick else options.objects)
    found = all_methods(options.runs)
    asked = {"runs": list(found), "points": options.points, "objects": names}
    results_folder.claim(options.out, "depths", asked, dataset)
    mitsuba_module(choose_variant(options.variant)[0])
    rows = {name: partial(measure, options, dataset, method) for name, method in found.items()}
    shown = evaluation.spread(names, options.shown)
    measured = scores.measure_rows(options.out, rows, dataset, names, shown)
    table = Table(
        title=f"{len(names)} unseen objects, {options.points} points; {runtime.hardware()}",
        heads=tuple(head for head, _ in COLUMNS.values()),
        rows=tuple(scores.score_row(name, objects, COLUMNS) for name, objects in measured.items()),
    )
    cells = []
    for name in shown:
        strips = [scores.picture_of(options.out, row, rows[row], dataset, name) for row in rows]
        thirds = [np.split(strip, 3, axis=1) for strip in strips]  # truth, depth, error
        pictures = [picture for _, *of_method in thirds for picture in of_method]
        cells.append([scores.reference(dataset, name), thirds[0][0], *pictures])
    heads = ["Reference", "True depth", *(f"{name}{end}" for name in found for end in (", depth", ", error"))]
    picture = png(figures.grid(cells, heads, list(shown), 128))
    settings = dataset.settings.get("settings", {})
    results = asked | {"scores": measured, "hardware": runtime.hardware(), "data": settings}
    results_folder.write(options.out, results, [table], [NOTE, PICTURE], {"fig3_depth.png": picture})


def all_methods(runs: tuple[str, ...]) -> dict[str, Method]:
    """The networks that show depth."""
    models = {run: weights.load(run) for run in runs}
    found = {run: of_model(model) for run, model in models.items() if model.config.method != "npbg"}
    if left_out := models.keys() - found:
        print(f"left out, since they predict no depth: {', '.join(sorted(left_out))}")
    if not found:
        raise UserError("--runs: none of these predicts depth; name a run of another method")
    return found


def measure(options: Fig3, dataset: Dataset, method: Method, item: ObjectData) -> Measured:
    """Mean metrics of an object's views; of the first one true depth, depth and error beside each other."""
    item = cut(item, options.points, normals=True)
    pictures = method.show(item)
    assert pictures.depth is not None
    seen, acc = np.asarray(pictures.depth), np.asarray(pictures.acc)
    size, place = seen.shape[1:], options.out / "truth" / f"{seen.shape[-1]}" / f"{item.name}.npz"
    (truth,) = results_folder.load_or_make(place, partial(true_depth, dataset, item, options.meshes, size))
    far = far_side(item.camera, size)
    each = [score(*maps) for maps in zip(seen, acc, far, truth, strict=True)]
    found = scores.mean_scores({name: [of[name] for of in each] for name in COLUMNS})
    inside = np.isfinite(truth[0])
    span = (float(truth[0][inside].min()), float(truth[0][inside].max())) if inside.any() else (0.0, 1.0)
    true = depth_image(np.where(inside, truth[0], 0), inside, span)
    strip = [true, depth_image(seen[0], acc[0], span), error_image(seen[0], acc[0], truth[0])]
    return found, np.concatenate(strip, axis=1)


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


def error_image(seen: np.ndarray, acc: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The error in grey (h, w, 3), black from WORST on; floaters red, what is missed blue."""
    inside, opaque = np.isfinite(truth), acc > OPAQUE
    grey = 1 - np.clip(np.abs(seen - np.where(inside, truth, 0)) / WORST, 0, 1)
    picture = np.where((inside & opaque)[..., None], grey[..., None], np.ones(3))
    picture[inside & ~opaque] = MISSED
    picture[~inside & opaque] = FLOATER
    return picture


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
        "missed": 100 * mean(~opaque[inside]),
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


if __name__ == "__main__":
    entry_point.run(main, Fig3, "paper.fig3")
