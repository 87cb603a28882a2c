"""How sharp are pictures at 512 pixels and more, and what do more points bring?

    python -m experiments.studies.sharpness --data DIR --out OUT [--runs surfels small] [--counts 1024 4096 16384 65536]

The networks draw the test objects of a data set (`spnr-data generate --spread even --points 65536 --resolution 512`)
from so many of each object's first points, beside the same discs and light without a network (`draft`), and, if asked
for, trimmed Poisson surfaces in Mitsuba (`--poisson`).  A ball of one grey should be smooth, a plate red in front
should show no blue.  Two columns are an oracle: the same colours under the reference's opacity.

    OUT/results.json  OUT/table.md     scores of `comparison/view_scores.py` for each network and number of points
    OUT/gallery.png   OUT/ID.png       references and pictures beside each other, at full size
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_erosion, distance_transform_edt, gaussian_filter

from experiments import entry_point
from experiments.comparison import contenders, results_folder, scores
from experiments.comparison.contenders import Method
from experiments.comparison.poisson import Renderer
from experiments.comparison.scores import Measure, Measured
from experiments.comparison.study_objects import cut, test_objects
from experiments.comparison.view_scores import WELL_INSIDE, measure_sharpness
from spnr_jax.config import Quality
from spnr_jax.devices import runtime
from spnr_jax.errors import require, require_at_least
from spnr_jax.formats import data_sets, images
from spnr_jax.formats.data_sets import Dataset, ObjectData
from spnr_jax.kernels.cloud_arrays import make_cloud
from spnr_jax.kernels.imaging import srgb_to_linear
from spnr_jax.kernels.records import PointCloud
from spnr_jax.method.model import Model
from spnr_jax.scoring.evaluation import Pictures, check_known_light
from spnr_jax.scoring.report import Cell, Table, number

COLUMNS = {
    **{name: column for name, column in scores.COLUMNS.items() if name != "iou"},
    "psnr_true_opacity": ("PSNR, true opacity", 2),
    "inside_true_opacity": ("inside, true opacity", 2),
}
KNOWN_SIZE = 512  # pixels along each side of ball and plate
COVERED = 0.3  # opacity above which a pixel's colour is known
WAVES = 8.0  # standard deviation of the Gaussian whose residue are waves
GREY = 0.5  # base colour of the ball
PLATE = (2.0, 1.4, 0.03)  # sides
HEADS = (*(head for head, _ in COLUMNS.values()), "encode, s", "a picture, s", "ball: waves", "plate: blue share")


@dataclass(frozen=True, kw_only=True)
class SharpnessStudy:
    """Sharpness of networks at the size that people look at, over the number of points."""

    data: Path
    """Folder of a data set whose points are spread evenly."""
    out: Path
    """Folder of the results; the same command goes on there."""
    runs: tuple[str, ...] = ("surfels",)
    """Networks: `surfels` of the package, run folders or files of weights."""
    counts: tuple[int, ...] = (1024, 4096, 16384, 65536)
    """Points of an object, the first of its file."""
    resolution: int | None = None
    """Pixels along each side: those of the data set, or a whole share of them (default: theirs)."""
    views: int = 4
    """Views of an object."""
    objects: int | None = None
    """Test objects (default: all)."""
    poisson: bool = False
    """Trimmed Poisson surfaces of the same points, path-traced by Mitsuba, too."""
    envmap: Path | None = None
    """Environment map that lit the data set, for the Poisson surfaces, where it is not the room."""
    normals: bool = False
    """Give the networks the normals of the data set, too; without them they are estimated."""

    def __post_init__(self) -> None:
        require(bool(self.runs) or self.poisson, "--runs: name at least one network, or give --poisson")
        require_at_least(self, 1, "counts", "resolution", "views", "objects")


def main(options: SharpnessStudy) -> None:
    """Draws, scores and writes."""
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, options.objects, max(options.counts), options.resolution)
    models = contenders.of_runs(options.runs)
    for model, _ in models.values():
        check_known_light(model.config, dataset)
    asked = {name: getattr(options, name) for name in ("counts", "views", "resolution", "normals")}
    asked |= {"runs": contenders.checksums(options.runs)}
    results_folder.claim(options.out, "sharpness", asked | {"objects": names}, dataset)
    compared = {label: contenders.of_model(*model) for label, model in models.items()}
    if options.poisson:
        compared["Poisson, trimmed"] = Renderer(dataset.settings, options.envmap).method("poisson_trimmed")
    rows, known = {}, {}
    for label, method in compared.items():
        for count in options.counts:
            row = f"{label}, {count:,}"
            rows[row] = partial(measure, options, method, count)
            known[row] = _score_known(options, label, models[label], count) if label in models else {}
    shown = names[:4]  # at full size
    found = scores.measure_rows(options.out, rows, dataset, names, shown)
    _pictures(options, dataset, rows, shown)
    table = Table(
        title=f"Sharpness, {len(names)} objects x {options.views} views",
        heads=HEADS,
        rows=tuple(_row(row, objects, known[row]) for row, objects in found.items()),
        note="Means over objects, from five on with 95 % intervals; a true plate shows a blue share of 0.077.",
    )
    results_folder.write(
        options.out, {"objects": found, "known": known, "hardware": runtime.describe_hardware()}, [table]
    )


def measure(options: SharpnessStudy, method: Method, count: int, item: ObjectData) -> Measured:
    """Mean scores of an object's views, seconds to encode it and to draw one."""
    item = cut(item, count, options.views, options.resolution, options.normals)
    pictures, seconds = draw_timed(method, item)
    found = scores.score_views(item, pictures) | oracle(item, pictures)
    means = scores.mean_scores({name: found[name] for name in COLUMNS})
    return means | seconds, np.asarray(pictures.image[0])


def draw_timed(method: Method, item: ObjectData) -> tuple[Pictures, dict[str, float]]:
    """The pictures, and seconds to encode and of a view, once all is compiled."""

    def take_time(work: Callable[[], Any]) -> tuple[Any, float]:
        for _ in range(1 + method.compiles):
            begin = perf_counter()
            made = work()
            jax.block_until_ready(jax.tree.leaves(made))
        return made, perf_counter() - begin

    scene, encode = take_time(lambda: method.encode(item))
    pictures, render = take_time(lambda: method.draw(scene, item))
    times = {"encode": encode, "render": render / len(item.images)}
    return scores.enlarge(pictures, item.images.shape[1:3]), times


def under_true_opacity(
    image: Float[np.ndarray, "height width 3"],
    opacity: Float[np.ndarray, "height width"],
    true_opacity: Float[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width 3"]:
    """The picture's own colours under the reference's opacity: what it would be with perfect outlines, no holes.

    Where the picture shows little or nothing it takes the colour of the nearest pixel that it covers.
    """
    color = (image - 1 + opacity[..., None]) / np.maximum(opacity[..., None], COVERED)
    shown = opacity >= COVERED
    if shown.any():
        color = color[tuple(distance_transform_edt(~shown, return_distances=False, return_indices=True))]
    return np.clip(color, 0, 1) * true_opacity[..., None] + 1 - true_opacity[..., None]


def oracle(item: ObjectData, pictures: Pictures) -> dict[str, list[float]]:
    """PSNR of the same colours under the true opacity."""
    found = []
    for image, opacity, rgba in zip(pictures.image, pictures.acc, item.images, strict=True):
        true_opacity = rgba[..., 3].astype(np.float32) / 255
        right = under_true_opacity(np.asarray(image), np.asarray(opacity), true_opacity)
        found.append(measure_sharpness(right, true_opacity, rgba))
    return {
        "psnr_true_opacity": [one.psnr for one in found],
        "inside_true_opacity": [one.psnr_inside for one in found],
    }


def ball(count: int) -> PointCloud:
    """Random points of a grey ball: its picture should be smooth."""
    towards = np.random.default_rng(0).standard_normal((count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return make_cloud(towards, GREY, roughness=0.5, normals=towards)


def ball_waves(image: Float[np.ndarray, "height width 3"], opacity: Float[np.ndarray, "height width"]) -> float:
    """Root mean square of what a wide Gaussian takes away of the ball, away from its outline."""
    inside = binary_erosion(opacity > 0.5, iterations=int(3 * WAVES))
    grey = image.mean(axis=-1)
    return float(np.mean((grey - gaussian_filter(grey, WAVES))[inside] ** 2) ** 0.5) if inside.any() else float("nan")


def plate(count: int) -> PointCloud:
    """Random points of a thin plate, red in front (+z) and blue behind and at the rims."""
    generator = np.random.default_rng(0)
    width, height, depth = PLATE
    areas = np.array([width * height] * 2 + [width * depth] * 2 + [height * depth] * 2)
    side = generator.choice(6, count, p=areas / areas.sum())
    places = generator.uniform(-0.5, 0.5, (count, 3))
    axis, sign = np.array([2, 2, 1, 1, 0, 0])[side], np.where(side % 2 == 0, 0.5, -0.5)
    places[np.arange(count), axis] = sign
    normals = np.zeros((count, 3), np.float32)
    normals[np.arange(count), axis] = 2 * sign
    color = np.where((side == 0)[:, None], [0.8, 0.05, 0.05], [0.05, 0.05, 0.8])
    return make_cloud(places * PLATE, color, roughness=0.5, normals=normals)


def blue_share(image: Float[np.ndarray, "height width 3"], opacity: Float[np.ndarray, "height width"]) -> float:
    """Share of blue in the colour of the plate's front, in linear light; 0.077 is true (its rims are not seen)."""
    inside = binary_erosion(opacity > 0.5, iterations=WELL_INSIDE)
    if not inside.any():
        return float("nan")
    red, _, blue = srgb_to_linear(image)[inside].mean(axis=0)
    return float(blue / (red + blue))


def _score_known(
    options: SharpnessStudy, label: str, model: tuple[Model, Quality], count: int
) -> dict[str, float | None]:
    """Scores of a network's ball and plate."""
    network, quality = model

    def of(cloud: PointCloud, score: Any, **view: float) -> float | None:
        cloud = cloud if options.normals else dataclasses.replace(cloud, normals=None)
        volume = network.encode(cloud)
        rendering = network.render(volume, network.camera(volume, resolution=KNOWN_SIZE, **view), quality)
        one = Pictures(image=np.asarray(rendering.image)[None], acc=np.asarray(rendering.acc)[None])
        one = scores.enlarge(one, one.image.shape[1:3])
        return scores.mean_scores({"": [score(one.image[0], one.acc[0])]})[""]

    def make() -> dict[str, float | None]:
        front = {"azimuth": 0.0, "elevation": 0.0}
        return {"ball": of(ball(count), ball_waves), "plate": of(plate(count), blue_share, **front)}

    place = scores.place_of(options.out, f"known/{label}", str(count), ".json")
    return results_folder.load_or_make(place, make)


def _row(
    row: str, found: Sequence[Mapping[str, float | None]], known: Mapping[str, float | None]
) -> tuple[str, tuple[Cell, ...]]:
    times = (number(float(np.median([of[what] for of in found])), 2) for what in ("encode", "render"))
    cells = scores.score_row(found, COLUMNS)
    return row, (*cells, *times, number(known.get("ball"), 4), number(known.get("plate"), 3))


def _pictures(options: SharpnessStudy, dataset: Dataset, rows: Mapping[str, Measure], names: Sequence[str]) -> None:
    """A sheet of each shown object at full size, and one of all, smaller."""
    draw = partial(scores.gallery, options.out, rows, dataset)
    for name in names:
        size = options.resolution or data_sets.read_object(dataset, name).camera.height
        images.write_whole(options.out / f"{name}.png", draw([name], options.resolution, size))
    images.write_whole(options.out / "gallery.png", draw(names, options.resolution, 192))


if __name__ == "__main__":
    entry_point.run(main, SharpnessStudy, "studies.sharpness")
