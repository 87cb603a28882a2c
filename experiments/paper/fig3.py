"""Figure 3: depth maps of unseen objects, how far they are from the points of the surface, and floaters.

    python -m experiments.paper.fig3 --data DIR --out DIR --runs RUN ...

    OUT/scores/METHOD/ID.json  every metric of an object, and its first depth map as .png
    OUT/results.json  OUT/table.md  OUT/fig3_depth.png

What is there is kept, so the same command goes on where it was stopped.  It draws no random numbers.

The truth are the points of the data set that the eye sees, also those that the network is not given.  Distances are
along the rays, in half diagonals of the object's box; a pixel is opaque where a method's opacity is above a half.

error, median, bias   mean and median of |depth - truth|, and mean of depth - truth, at opaque pixels with such a point
missed                percentage of the reference's opaque pixels that are not opaque
floaters              opaque pixels where the reference is empty, for each 1000 empty ones
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull

from experiments import entry_point
from experiments.comparison import results_folder, scores
from experiments.comparison.contenders import Method, checksums, of_model
from experiments.comparison.scores import OPAQUE, Measured
from experiments.comparison.study_objects import cut, each_view, test_objects
from experiments.comparison.view_scores import mean
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError, require_at_least
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import ObjectData
from spnr_jax.formats.images import depth_image
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.evaluation import Pictures
from spnr_jax.training import weights

COLUMNS = {  # head, decimals
    "error": ("Mean error", 4),
    "median": ("Median error", 4),
    "bias": ("Mean signed error", 4),
    "missed": ("Missed, %", 2),
    "floaters": ("Floaters, per 1000", 2),
}
SPHERE = 10  # radius, in distances of the farthest point, of the sphere that tells which points the eye sees
NOTE = (
    "Distances are along the rays, in half diagonals of the object's box. Means over objects, from five on with 95 % "
    "intervals. Errors at opaque pixels that see a point of the data set; floaters are opaque pixels where the "
    "reference is empty."
)


@dataclass(frozen=True, kw_only=True)
class Fig3:
    """Depth maps of unseen objects, and how far they are from the points of the surface."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results; the same command goes on there."""
    runs: tuple[str, ...]
    """Networks: run folders, files of weights, or `surfels`, the network of the package."""
    points: int = 1024
    """Points of an object that the networks are given, the first of its file."""
    objects: int | None = None
    """Test objects, spread over the split (default: all)."""
    shown: int = 8
    """Objects in the picture."""
    quick: bool = False
    """A check that everything works: two objects."""

    def __post_init__(self) -> None:
        require_at_least(self, 1, "points", "objects", "shown")


def main(options: Fig3) -> None:
    """Makes what is missing of the scores, then table and picture."""
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, 2 if options.quick else options.objects, options.points)
    found = all_methods(options.runs)
    asked = {"runs": checksums(options.runs), "points": options.points, "objects": names, "normals": False}
    results_folder.claim(options.out, "depths", asked, dataset)
    rows = {name: partial(measure, options.points, method) for name, method in found.items()}
    shown = evaluation.pick_evenly(names, options.shown)
    measured = scores.measure_rows(options.out, rows, dataset, names, shown)
    title = f"{len(names)} unseen objects, {options.points} points; {runtime.describe_hardware()}"
    table = scores.score_table(title, measured, COLUMNS)
    results = asked | {"scores": measured, "hardware": runtime.describe_hardware()}
    results["data"] = dataset.settings.get("settings", {})
    picture = scores.gallery(options.out, rows, dataset, shown, None, 128)
    results_folder.write(options.out, results, [table], [NOTE], {"fig3_depth.png": picture})


def all_methods(runs: tuple[str, ...]) -> dict[str, Method]:
    """The networks that show depth."""
    models = {run: weights.load(run) for run in runs}
    found = {run: of_model(model) for run, model in models.items() if model.config.method != "npbg"}
    if left_out := models.keys() - found:
        print(f"left out, since they predict no depth: {', '.join(sorted(left_out))}")
    if not found:
        raise UserError("--runs: none of these predicts depth; name a run of another method")
    return found


def measure(points: int, method: Method, item: ObjectData) -> Measured:
    """Mean metrics of an object's views, and the depth map of the first."""
    pictures = method.show(cut(item, points))
    each = score(item, pictures)
    found = scores.mean_scores({name: [of[name] for of in each] for name in COLUMNS})
    assert pictures.depth is not None
    return found, depth_image(np.asarray(pictures.depth)[0], np.asarray(pictures.acc)[0])


def score(item: ObjectData, pictures: Pictures) -> list[dict[str, float]]:
    """The metrics of each view."""
    depth, opaque = np.asarray(pictures.depth, np.float64), np.asarray(pictures.acc) > OPAQUE
    enlarged = np.asarray(scores.enlarge(pictures, item.images.shape[1:3]).acc) > OPAQUE
    found = []
    for view, camera in enumerate(each_view(item)):
        truth = true_depth(np.asarray(item.cloud.positions), camera, depth.shape[1:])
        known, alpha = np.isfinite(truth), item.images[view, ..., 3]
        off = (depth[view] - np.where(known, truth, 0))[known & opaque[view]]
        found.append(
            {
                "error": mean(np.abs(off)),
                "median": float(np.median(np.abs(off))) if off.size else np.nan,
                "bias": mean(off),
                "missed": 100 * mean(~enlarged[view][alpha == 255]),
                "floaters": 1000 * mean(enlarged[view][alpha == 0]),
            }
        )
    return found


def true_depth(positions: np.ndarray, camera: Camera, size: tuple[int, ...]) -> np.ndarray:
    """Distance (*size) of the nearest point (n, 3) in each pixel, of those that the eye sees; inf without one."""
    seen = positions[visible_points(positions - np.asarray(camera.cam_to_world)[:, 3])]
    pixels, distance = map(np.asarray, cameras.project(cameras.resize(camera, *size), jnp.asarray(seen)))
    inside = np.all((pixels >= 0) & (pixels < size[::-1]), axis=1)  # a point behind the eye has no pixel
    columns, rows = pixels[inside].astype(int).T
    truth = np.full(size, np.inf)
    np.minimum.at(truth, (rows, columns), distance[inside])
    return truth


def visible_points(positions: np.ndarray) -> np.ndarray:
    """Which points (n, 3) an eye at 0 sees: those on the hull of their images in a sphere (Katz et al., 2007)."""
    far = np.linalg.norm(positions, axis=1, keepdims=True)
    hull = ConvexHull(np.concatenate([positions * (2 * SPHERE * far.max() / far - 1), np.zeros((1, 3))])).vertices
    return hull[hull < len(positions)]


if __name__ == "__main__":
    entry_point.run(main, Fig3, "paper.fig3")
