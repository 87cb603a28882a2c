"""How much do the faults of scans cost, and how much of it does cleaning bring back?

    python -m experiments.studies.scans --data DIR --out OUT [--run surfels] [--counts 4096 16384] [--resolution 128]

The points of the test objects (`spnr-data generate --spread even`) are spoiled as scanners spoil them
(training/scan_faults.py), cleaned or not, thinned evenly to so many as `spnr render` does, and drawn.  Noise is the
standard deviation along each axis, in units of the box whose half diagonal is 1; scanners see from random directions.

    OUT/results.json  OUT/table.md .csv .tex     dB, dB inside, FLIP of each fault, with and without cleaning
    OUT/gallery.png                              references and pictures of the first objects, a fault a column
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.comparison.object_views import view_of
from experiments.comparison.result_tables import Cell, Table, number
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels.cleaning import cleaned
from spnr_jax.kernels.cloud_arrays import normalization
from spnr_jax.kernels.records import PointCloud
from spnr_jax.kernels.thinning import farthest_points
from spnr_jax.method.model import Model
from spnr_jax.scoring import intervals
from spnr_jax.scoring.flip import flip
from spnr_jax.scoring.picture_scores import sharpness
from spnr_jax.training.scan_faults import Fault, faults
from spnr_jax.training.weights import load

HEADS = ("PSNR, dB", "inside, dB", "FLIP", "cleaned: PSNR, dB", "inside, dB", "FLIP", "points left, %")
DECIMALS = (2, 2, 3)


@dataclass(frozen=True, kw_only=True)
class ScansStudy:
    """Scores over the faults of scans, with and without cleaning."""

    data: Path
    """Folder of a data set whose points are spread evenly."""
    out: Path
    """Folder of the results; the same command goes on there."""
    run: str = "surfels"
    """Network: of the package, a run folder or a file of weights."""
    counts: tuple[int, ...] = (4096, 16384)
    """Points that are drawn, of all that the data set has."""
    noise: tuple[float, ...] = (0.005, 0.01, 0.02, 0.03)
    """Standard deviations."""
    outliers: tuple[float, ...] = (0.01, 0.02, 0.05)
    """Shares of the points."""
    scanners: tuple[int, ...] = (8, 3, 1)
    """Numbers of virtual scanners: what none of them sees is missing."""
    resolution: int | None = None
    """Pixels along each side: those of the data set, or a whole share of them (default: theirs)."""
    views: int = 2
    """Views of an object."""
    objects: int | None = None
    """Test objects (default: all)."""
    shown: int = 4
    """Objects in the gallery."""


def main(options: ScansStudy) -> None:
    """Draws, scores and writes."""
    dataset = data_sets.open_dataset(options.data)
    names = dataset.splits["test"][: options.objects]
    asked = {"run": options.run, "views": options.views, "resolution": options.resolution}
    results_folder.claim(options.out, "scans", asked, dataset)
    model = load(options.run)
    rows: dict[str, list[dict]] = {}
    for count in options.counts:
        for label, fault in faults(options.noise, options.outliers, options.scanners).items():
            row = f"{count:,}, {label}"
            rows[row] = [
                _kept_scores(options, dataset, name, label, model, fault, count) for name in tqdm(names, desc=row)
            ]
    table = Table(
        title=f"Scans, {len(names)} objects x {options.views} views",
        heads=HEADS,
        rows=tuple((row, _cells(found)) for row, found in rows.items()),
        note="Means over objects with 95 % intervals; points left: of the data set's, before cleaning.",
    )
    results_folder.write(options.out, {"objects": rows, "hardware": machine.hardware()}, [table])
    _gallery(options, dataset, names[: options.shown], model)


def _kept_scores(
    options: ScansStudy,
    dataset: data_sets.Dataset,
    name: str,
    label: str,
    model: Model,
    fault: Fault | None,
    count: int,
) -> dict[str, Any]:
    place = options.out / "scores" / f"{count} {label}".replace(" ", "_") / f"{name}.json"
    return results_folder.kept(
        place, lambda: _scores(options, data_sets.read_object(dataset, name), model, fault, count)
    )


def spoiled(cloud: PointCloud, fault: Fault | None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Positions in the cloud's units and materials after a fault, the same at every call; normals are dropped."""
    positions = np.asarray(cloud.positions, np.float64)
    values = {name: np.asarray(getattr(cloud, name)) for name in ("base_color", "roughness", "metallic")}
    if fault is None:
        return positions, values
    centre, scale = normalization(positions)
    positions, values = fault((positions - centre) * scale, values, np.random.default_rng(0))
    return positions / scale + centre, values


def thinned(positions: np.ndarray, values: dict[str, np.ndarray], count: int) -> PointCloud:
    """At most so many points, as `read_cloud` keeps them."""
    kept = np.arange(len(positions))
    if len(positions) > count:
        kept = np.sort(farthest_points(positions, count, seed=0))
    columns = {name: np.asarray(column[kept], np.float32) for name, column in values.items()}
    return PointCloud(positions=positions[kept].astype(np.float32), mask=np.ones(len(kept), bool), **columns)


def _scores(
    options: ScansStudy, item: data_sets.ObjectData, model: Model, fault: Fault | None, count: int
) -> dict[str, Any]:
    """Mean scores of an object's views without and with cleaning, and the share of its points that is left."""
    positions, values = spoiled(item.cloud, fault)
    off = _mean_scores(options, item, model, thinned(positions, values, count))
    done = cleaned(positions, values)
    auto = _mean_scores(options, item, model, thinned(*done[:2], count)) if done[2] else off
    return {"off": off, "auto": auto, "said": done[2], "left": len(positions) / len(item.cloud.positions)}


def _mean_scores(options: ScansStudy, item: data_sets.ObjectData, model: Model, cloud: PointCloud) -> list[float]:
    found = []
    for image, opacity, reference in _drawn(options, item, model, cloud, options.views):
        scores, alpha = sharpness(image, opacity, reference), reference[..., 3:]
        white = reference[..., :3] * alpha + 1 - alpha
        found.append([scores.psnr, scores.psnr_inside, float(flip(jnp.asarray(image), jnp.asarray(white)))])
    return np.nanmean(found, axis=0).tolist()


def _drawn(
    options: ScansStudy, item: data_sets.ObjectData, model: Model, cloud: PointCloud, views: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Image, opacity and reference of an object's first views."""
    pairs = [view_of(item, view, options.resolution) for view in range(min(views, len(item.images)))]
    found = model.render_each(model.encode(cloud), [camera for camera, _ in pairs])
    return [(np.asarray(r.image), np.asarray(r.acc), reference) for r, (_, reference) in zip(found, pairs, strict=True)]


def _cells(found: Sequence[dict]) -> tuple[Cell, ...]:
    cells = []
    for way in ("off", "auto"):
        for values, decimals in zip(np.array([scores[way] for scores in found]).T, DECIMALS, strict=True):
            interval = intervals.interval([np.array([x]) for x in values]) if len(values) > 1 else None
            cells.append(number(float(np.mean(values)), decimals, interval))
    return (*cells, number(100 * float(np.mean([scores["left"] for scores in found])), 0))


def _gallery(options: ScansStudy, dataset: data_sets.Dataset, names: Sequence[str], model: Model) -> None:
    """References, and pictures of the cleaned clouds of the largest count."""
    kinds = faults(options.noise, options.outliers, options.scanners)
    cells = []
    for name in names:
        item = data_sets.read_object(dataset, name)

        def picture(label: str, name: str = name, item: data_sets.ObjectData = item) -> np.ndarray:
            def make() -> np.ndarray:
                positions, values, _ = cleaned(*spoiled(item.cloud, kinds[label]))
                cloud = thinned(positions, values, max(options.counts))
                return images.to_uint8(_drawn(options, item, model, cloud, 1)[0][0])

            return results_folder.kept(options.out / "pictures" / f"{name}_{label}.png".replace(" ", "_"), make)

        reference = view_of(item, 0, options.resolution)[1]
        alpha = reference[..., 3:]
        cells.append([reference[..., :3] * alpha + 1 - alpha, *map(picture, kinds)])
    sheet = figures.grid(cells, ["reference", *kinds], names, size=cells[0][0].shape[0])
    images.write_whole(options.out / "gallery.png", images.png(sheet))


if __name__ == "__main__":
    entry_point.run(main, ScansStudy, "studies.scans")
