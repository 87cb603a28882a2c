"""The engine of the studies: rows of a table, each a way to draw the test objects, measured object by object.

    OUT/scores/ROW/OBJECT.json    what was measured; what is there is kept, so a stopped call goes on
    OUT/scores/ROW/OBJECT.png     the first picture, of the objects that are shown

`score_objects` is the same for methods whose pictures are scored as `spnr evaluate` scores them, in memory.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments.comparison import figures
from experiments.comparison.contenders import Method
from experiments.comparison.results_folder import load_or_make
from experiments.comparison.study_objects import cut
from experiments.comparison.view_scores import measure_sharpness
from spnr_jax.config import TrainConfig
from spnr_jax.formats import data_sets, images
from spnr_jax.formats.data_sets import Dataset, ObjectData
from spnr_jax.kernels import metrics
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.evaluation import Pictures
from spnr_jax.scoring.picture_scores import Scores, flip, interval
from spnr_jax.scoring.report import Cell, Table, number

Measured = tuple[dict[str, Any], np.ndarray]  # what is measured of an object, and its first picture
Measure = Callable[[ObjectData], Measured]
COLUMNS = {  # scores of a view: heads, decimals
    "psnr": ("PSNR, dB", 2),
    "psnr_inside": ("inside, dB", 2),
    "outline_rmse": ("outline RMSE", 3),
    "holes": ("holes, %", 2),
    "detail": ("detail", 3),
    "ssim": ("SSIM", 3),
    "flip": ("FLIP", 4),
    "iou": ("opacity IoU", 3),
}
OPAQUE = 0.5  # opacity of the reference from which a pixel lies inside the silhouette


# --- rows that are kept -----------------------------------------------------------------------------------------------


def measure_rows(
    out: Path, rows: Mapping[str, Measure], dataset: Dataset, names: Sequence[str], shown: Sequence[str] = ()
) -> dict[str, list[dict[str, Any]]]:
    """What is measured of each object, by row; the first pictures of the objects that are shown are kept."""

    def measured(row: str, name: str) -> dict[str, Any]:
        found, picture = rows[row](data_sets.read_object(dataset, name))
        if name in shown:
            images.write_whole(place_of(out, row, name, ".png"), images.png(picture))
        return found

    return {
        row: [
            load_or_make(place_of(out, row, name, ".json"), partial(measured, row, name))
            for name in tqdm(names, desc=row)
        ]
        for row in rows
    }


def place_of(out: Path, row: str, name: str, suffix: str) -> Path:
    """The file of an object in a row."""
    return out / "scores" / row.replace("/", "%2F") / f"{name}{suffix}"


def picture_of(out: Path, row: str, measure: Measure, dataset: Dataset, name: str) -> np.ndarray:
    """The first picture of an object in a row; it is drawn where it was not kept."""
    place = place_of(out, row, name, ".png")
    return load_or_make(place, lambda: images.to_uint8(measure(data_sets.read_object(dataset, name))[1]))


def score_views(item: ObjectData, pictures: Pictures) -> dict[str, list[float]]:
    """The scores of COLUMNS of each view; pictures that are smaller than their references are enlarged."""
    pictures = enlarge(pictures, item.images.shape[1:3])
    views = [
        score_view(np.asarray(image), np.asarray(opacity), reference)
        for image, opacity, reference in zip(pictures.image, pictures.acc, item.images, strict=True)
    ]
    return {name: [view[name] for view in views] for name in COLUMNS}


def enlarge(pictures: Pictures, size: tuple[int, ...]) -> Pictures:
    """Pictures of this size; the opacity of the paper's network has half of it."""
    image, acc = np.clip(np.asarray(pictures.image), 0, 1), np.asarray(pictures.acc)
    if image.shape[1:3] != size:
        image = np.clip(np.asarray(jax.image.resize(image, (len(image), *size, 3), "cubic")), 0, 1)
    if acc.shape[1:3] != size:
        acc = np.asarray(jax.image.resize(acc, (len(acc), *size), "linear"))
    return Pictures(image=image, acc=acc)


def score_view(image: np.ndarray, opacity: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """The scores of COLUMNS of a picture beside its reference (8-bit RGBA); NaN where nothing is measured."""
    white = data_sets.on_white(reference)
    return measure_sharpness(image, opacity, reference)._asdict() | {
        "ssim": float(metrics.ssim(jnp.asarray(image), jnp.asarray(white))),
        "flip": float(flip(image, white)),
        "iou": float(metrics.opacity_iou(jnp.asarray(opacity), jnp.asarray(reference[..., 3] / np.float32(255)))),
    }


def mean_scores(scores: Mapping[str, Sequence[float]]) -> dict[str, float | None]:
    """The mean of each score over the views that have one."""
    found = {}
    for name, values in scores.items():
        known = [value for value in values if not np.isnan(value)]
        found[name] = float(np.mean(known)) if known else None
    return found


def score_table(
    title: str, rows: Mapping[str, Sequence[Mapping[str, Any]]], columns: Mapping[str, tuple[str, int]], note: str = ""
) -> Table:
    """A table of rows of objects under the heads of their columns."""
    heads = tuple(head for head, _ in columns.values())
    made = tuple((label, score_row(objects, columns)) for label, objects in rows.items())
    return Table(title=title, heads=heads, rows=made, note=note)


def score_row(objects: Sequence[Mapping[str, Any]], columns: Mapping[str, tuple[str, int]]) -> tuple[Cell, ...]:
    """The cells of means over objects with intervals; None and NaN are left out."""
    cells = []
    for name, (_, decimals) in columns.items():
        values = np.array([of.get(name) for of in objects], float)
        known = values[~np.isnan(values)]
        mean, ends = (float(known.mean()), interval([x[None] for x in known])) if len(known) else (None, None)
        cells.append(number(mean, decimals, ends))
    return tuple(cells)


def gallery(
    out: Path, rows: Mapping[str, Measure], dataset: Dataset, names: Sequence[str], resolution: int | None, size: int
) -> bytes:
    """PNG: an object a row, its first reference and the picture of each row of the table."""
    cells = [
        [reference(dataset, name, resolution), *(picture_of(out, row, rows[row], dataset, name) for row in rows)]
        for name in names
    ]
    return images.png(figures.grid(cells, ["reference", *rows], names, size=size))


def reference(dataset: Dataset, name: str, resolution: int | None) -> np.ndarray:
    """The first reference of an object on white."""
    return data_sets.on_white(cut(data_sets.read_object(dataset, name), views=1, resolution=resolution).images[0])


# --- methods side by side, in memory ----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Shown:
    """One view of one object: reference and the picture of each method (height, width, 3)."""

    name: str
    view: int
    reference: np.ndarray
    images: dict[str, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Scored:
    """Scores by object and method, the objects to look at, and each method's seconds per view by object."""

    scores: dict[str, dict[str, Scores]]
    shown: list[Shown]
    seconds: dict[str, list[float]]


def score_objects(
    methods: Mapping[str, Method],
    config: TrainConfig,
    dataset: Dataset,
    names: tuple[str, ...],
    num_shown: int,
    more: Callable[[ObjectData, Pictures], Scores] | None = None,
) -> Scored:
    """All methods on these objects; points and image size are the config's.

    `more` scores a method's pictures of an object in other ways, too.
    """
    seconds: dict[str, list[float]] = {method: [] for method in methods}
    shows = {label: time_views(method, seconds[label]) for label, method in methods.items()}
    scores, shown, to_show = {}, [], evaluation.pick_evenly(names, num_shown)
    for name in tqdm(names, desc="scoring"):
        item = data_sets.read_object(dataset, name)
        result = evaluation.evaluate_object(shows, config, item)
        for label, pictures in result.pictures.items():
            if not methods[label].has_opacity:
                del result.scores[label]["iou"]  # it predicts colours alone
            if more:
                result.scores[label] |= more(item, pictures)
        scores[name] = result.scores
        if name in to_show:
            shown.append(choose_view(result))
    return Scored(scores=scores, shown=shown, seconds=seconds)


def time_views(method: Method, seconds: list[float]) -> evaluation.Draw:
    """The method, noting the seconds per view until the pictures lie on the host."""

    def measured(item: ObjectData) -> Pictures:
        start = time.monotonic()
        pictures = method.show(item)
        seconds.append((time.monotonic() - start) / len(pictures.image))
        return pictures

    return measured


def choose_view(result: evaluation.ObjectResult) -> Shown:
    """The view whose PSNR is the median of the first method's."""
    view = evaluation.median_view(next(iter(result.scores.values()))["psnr"])
    return Shown(
        name=result.name,
        view=view,
        reference=result.reference[view],
        images={method: np.asarray(pictures.image[view]) for method, pictures in result.pictures.items()},
    )
