"""How sharp are pictures at 512 pixels and more, and what do more points bring?

    python -m experiments.studies.sharpness --data DIR --out OUT [--runs surfels small] [--counts 1024 4096 16384 65536]

The networks draw the test objects of a data set (`spnr-data generate --spread even --points 65536 --resolution 512`)
from so many of each object's first points, beside the same discs and light without a network (`draft`).  A ball of one
grey should be smooth, a plate red in front should show no blue.  Two columns are an oracle: the same colours under the
reference's opacity.

    OUT/results.json  OUT/table.md .csv .tex     `scoring/picture_scores.py`, of each network and number of points
    OUT/gallery.png   OUT/ID.png                 references and pictures beside each other, at full size
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.comparison.result_tables import Cell, Table, number
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels import cameras, metrics
from spnr_jax.kernels.records import Camera, PointCloud
from spnr_jax.kernels.resizing import mean_of_squares
from spnr_jax.method.model import Model, Quality
from spnr_jax.model_config import SurfelConfig
from spnr_jax.scoring import intervals
from spnr_jax.scoring.flip import flip
from spnr_jax.scoring.picture_scores import ball, ball_waves, blue_share, plate, sharpness, under_true_opacity
from spnr_jax.training.weights import load

COLUMNS = {  # scores of a view: heads, decimals
    "psnr": ("PSNR, dB", 2),
    "psnr_inside": ("inside, dB", 2),
    "outline_rmse": ("outline RMSE", 3),
    "holes": ("holes, %", 2),
    "detail": ("detail", 3),
    "ssim": ("SSIM", 3),
    "flip": ("FLIP", 4),
    "psnr_true_opacity": ("PSNR, true opacity", 2),
    "inside_true_opacity": ("inside, true opacity", 2),
}
HEADS = (*(head for head, _ in COLUMNS.values()), "encode, s", "a picture, s")
KNOWN_HEADS = ("ball: waves", "plate: blue share")


@dataclass(frozen=True, kw_only=True)
class SharpnessStudy:
    """Sharpness of networks at the size that people look at, over the number of points."""

    data: Path
    """Folder of a data set whose points are spread evenly."""
    out: Path
    """Folder of the results; the same command goes on there."""
    runs: tuple[str, ...] = ("surfels", "small")
    """Networks: of the package, run folders or files of weights."""
    counts: tuple[int, ...] = (1024, 4096, 16384, 65536)
    """Points of an object, the first of its file."""
    resolution: int | None = None
    """Pixels along each side: those of the data set, or a whole share of them (default: theirs)."""
    views: int = 4
    """Views of an object."""
    objects: int | None = None
    """Test objects (default: all)."""
    normals: bool = False
    """Give the networks the normals of the data set, too; without them they are estimated."""
    shown: tuple[str, ...] = ()
    """Objects whose pictures are written at full size (default: the first four)."""


def main(options: SharpnessStudy) -> None:
    """Draws, scores and writes."""
    dataset = data_sets.open_dataset(options.data)
    names = dataset.splits["test"][: options.objects]
    asked = {"runs": list(options.runs), "counts": list(options.counts), "views": options.views, "objects": list(names)}
    results_folder.claim(
        options.out, "sharpness", asked | {"resolution": options.resolution, "normals": options.normals}, dataset
    )
    rows, known = {}, {}
    for label, model, quality in _methods(options.runs):
        for count in options.counts:
            rows[f"{label}, {count:,}"] = [
                _kept_scores(options, dataset, name, label, model, quality, count)
                for name in tqdm(names, desc=f"{label}, {count:,} points")
            ]
            known[f"{label}, {count:,}"] = _known(options, label, model, quality, count)
    _pictures(options, dataset, options.shown or names[:4])
    table = Table(
        title=f"Sharpness, {len(names)} objects x {options.views} views",
        heads=(*HEADS, *KNOWN_HEADS),
        rows=tuple((name, _cells(found, known[name])) for name, found in rows.items()),
        note="Means over objects with 95 % intervals; a true plate shows a blue share of .077.",
    )
    results_folder.write(options.out, {"objects": rows, "known": known, "hardware": machine.hardware()}, [table])


def _levels(model: Model) -> tuple[Quality, ...]:
    return ("best", "draft") if isinstance(model.config, SurfelConfig) else ("best",)


def _methods(runs: Sequence[str]) -> list[tuple[str, Model, Quality]]:
    """Label, network and quality of every row of the table."""
    found = []
    for run in runs:
        model = load(run)
        for quality in _levels(model):
            found.append((run if quality == "best" else f"{run}, discs and light alone", model, quality))
    return found


def _kept_scores(
    options: SharpnessStudy,
    dataset: data_sets.Dataset,
    name: str,
    label: str,
    model: Model,
    quality: Quality,
    count: int,
) -> dict[str, float]:
    place = options.out / "scores" / label.replace("/", "_") / f"{name}_{count}.json"
    return results_folder.kept(
        place, lambda: _scores(options, data_sets.read_object(dataset, name), model, quality, count)
    )


def _scores(
    options: SharpnessStudy, item: data_sets.ObjectData, model: Model, quality: Quality, count: int
) -> dict[str, float]:
    """Mean scores of an object's views, seconds to encode it and to draw one."""
    drawn, seconds = _draw(options, item, model, quality, count)
    scores = [all_scores(*picture) for picture in drawn]
    means = {name: float(np.nanmean([of[name] for of in scores])) for name in COLUMNS}
    return means | dict(zip(("encode", "render"), seconds, strict=True))


def _draw(
    options: SharpnessStudy, item: data_sets.ObjectData, model: Model, quality: Quality, count: int
) -> tuple[list[tuple[np.ndarray, np.ndarray, np.ndarray]], tuple[float, float]]:
    """Image, opacity and reference of each view; seconds to encode, and of a picture once all is compiled."""
    cloud = told(jax.tree.map(lambda x: x[:count], item.cloud), options.normals)
    model.encode(cloud)
    begin = perf_counter()
    volume = model.encode(cloud)
    jax.block_until_ready(jax.tree.leaves(volume.scene))
    encode = perf_counter() - begin
    pairs = [view_of(item, view, options.resolution) for view in range(min(options.views, len(item.images)))]
    views = [camera for camera, _ in pairs]
    for _ in range(2):
        begin = perf_counter()
        found = [(np.asarray(r.image), np.asarray(r.acc)) for r in model.render_each(volume, views, quality)]
        seconds = (perf_counter() - begin) / len(views)
    drawn = [(image, opacity, reference) for (image, opacity), (_, reference) in zip(found, pairs, strict=True)]
    return drawn, (encode, seconds)


def all_scores(image: np.ndarray, opacity: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """The scores of a picture by the names in COLUMNS."""
    white = reference[..., :3] * reference[..., 3:] + 1 - reference[..., 3:]
    oracle = sharpness(under_true_opacity(image, opacity, reference), reference[..., 3], reference)
    return sharpness(image, opacity, reference)._asdict() | {
        "ssim": float(metrics.ssim(jnp.asarray(image), jnp.asarray(white))),
        "flip": float(flip(jnp.asarray(image), jnp.asarray(white))),
        "psnr_true_opacity": oracle.psnr,
        "inside_true_opacity": oracle.psnr_inside,
    }


def told(cloud: PointCloud, normals: bool) -> PointCloud:
    """The cloud with its normals or without."""
    return cloud if normals else dataclasses.replace(cloud, normals=None)


def view_of(item: data_sets.ObjectData, view: int, resolution: int | None) -> tuple[Camera, np.ndarray]:
    """Camera and reference of a view at a resolution, None for its own."""
    reference = item.images[view].astype(np.float32) / 255
    camera = jax.tree.map(lambda x: x[view], item.camera)
    if resolution and resolution != camera.height:
        reference = smaller(reference, camera.height // resolution)
        camera = cameras.resize(camera, resolution, resolution)
    return camera, reference


def smaller(reference: np.ndarray, side: int) -> np.ndarray:
    """The mean of squares of pixels, colours weighted by their opacity."""
    weighted = np.concatenate([reference[..., :3] * reference[..., 3:], reference[..., 3:]], axis=-1)
    weighted = np.asarray(mean_of_squares(jnp.asarray(weighted), side))
    return np.concatenate([weighted[..., :3] / np.maximum(weighted[..., 3:], 1e-4), weighted[..., 3:]], axis=-1)


def _known(options: SharpnessStudy, label: str, model: Model, quality: Quality, count: int) -> dict[str, float]:
    """Scores of the ball and the plate."""

    def of(cloud: PointCloud, score: Any, **view: float) -> float:
        volume = model.encode(told(cloud, options.normals))
        rendering = model.render(volume, model.camera(volume, resolution=512, **view), quality)
        return float(score(np.asarray(rendering.image), np.asarray(rendering.acc)))

    def make() -> dict[str, float]:
        front = {"azimuth": 0.0, "elevation": 0.0}
        return {"ball": of(ball(count), ball_waves), "plate": of(plate(count), blue_share, **front)}

    return results_folder.kept(options.out / "known" / label.replace("/", "_") / f"{count}.json", make)


def _cells(found: Sequence[Mapping[str, float]], known: Mapping[str, float]) -> tuple[Cell, ...]:
    cells = []
    for name, (_, decimals) in COLUMNS.items():
        values = [scores[name] for scores in found if not np.isnan(scores[name])]
        interval = intervals.interval([np.array([value]) for value in values]) if len(values) > 1 else None
        cells.append(number(float(np.mean(values)) if values else None, decimals, interval))
    cells += [number(float(np.median([scores[name] for scores in found])), 2) for name in ("encode", "render")]
    return (*cells, number(known["ball"], 4), number(known["plate"], 3))


def _pictures(options: SharpnessStudy, dataset: data_sets.Dataset, names: Sequence[str]) -> None:
    """A sheet of each shown object at full size, and one of all, smaller."""
    cells = []
    methods = _methods(options.runs)
    heads = ["reference", *(f"{label}, {count:,} points" for label, _, _ in methods for count in options.counts)]
    for name in names:
        item = data_sets.read_object(dataset, name)
        row = []
        for _, model, quality in methods:
            for count in options.counts:
                (image, _, reference), *_ = _draw(options, item, model, quality, count)[0]
                row.append(image)
        alpha = reference[..., 3:]
        cells.append([reference[..., :3] * alpha + 1 - alpha, *row])
        full = figures.grid([cells[-1]], heads, size=cells[-1][0].shape[0])
        images.write_whole(options.out / f"{name}.png", images.png(full))
    images.write_whole(options.out / "gallery.png", images.png(figures.grid(cells, heads, names, size=192)))


if __name__ == "__main__":
    entry_point.run(main, SharpnessStudy, "studies.sharpness")
