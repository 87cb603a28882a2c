"""How much do the faults of scans cost, and how much of it does cleaning bring back?

    python -m experiments.studies.scans --data DIR --out OUT [--run surfels] [--counts 4096 16384] [--resolution 128]

The points of the test objects (`spnr-data generate --spread even`) are spoiled as scanners spoil them
(training/scan_faults.py), cleaned or not, thinned evenly to so many as `spnr render` does, and drawn.  Noise is the
standard deviation along each axis, in units of the box whose half diagonal is 1; scanners see from random directions.
Rivals draw the same cleaned points: discs and light alone, and of --meshed objects trimmed Poisson surfaces.

    OUT/results.json  OUT/table.md     dB, dB inside, FLIP of each fault, with and without cleaning; of rivals
    OUT/gallery.png                              references and pictures of the first objects, a fault a column
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments import entry_point
from experiments.comparison import contenders, poisson, results_folder, scores
from experiments.comparison.scores import Measured
from experiments.comparison.study_objects import cut
from spnr_jax.devices import runtime
from spnr_jax.formats import data_sets, images
from spnr_jax.formats.data_sets import ObjectData
from spnr_jax.kernels.cleaning import Cleaned, Values, clean_columns
from spnr_jax.kernels.cloud_arrays import farthest_points, normalization
from spnr_jax.kernels.records import PointCloud
from spnr_jax.method.model import Model
from spnr_jax.scoring.evaluation import Pictures
from spnr_jax.scoring.report import Cell, Table, mean_row, number
from spnr_jax.surfels import normals
from spnr_jax.training.scan_faults import Fault, faults
from spnr_jax.training.weights import load

HEADS = ("PSNR, dB", "inside, dB", "FLIP", "cleaned: PSNR, dB", "inside, dB", "FLIP", "points left, %")
COLUMNS = ("psnr", "psnr_inside", "flip")
DECIMALS = (2, 2, 3)
RIVALS = {"auto": "network", "draft": "discs and light alone", "poisson": "trimmed Poisson"}


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
    meshed: int = 0
    """Objects, of these the first, of which Poisson surfaces are drawn, too (extras `data` and `baselines`)."""
    shown: int = 4
    """Objects in the gallery."""


def main(options: ScansStudy) -> None:
    """Draws, scores and writes."""
    dataset = data_sets.open_dataset(options.data)
    names = dataset.splits["test"][: options.objects]
    asked = {"run": options.run, "views": options.views, "resolution": options.resolution}
    results_folder.claim(options.out, "scans", asked, dataset)
    model, meshed, shown = load(options.run), names[: options.meshed], names[: options.shown]
    kinds = faults(options.noise, options.outliers, options.scanners)
    rows = {
        f"{count:,}, {label}": partial(measure, options, model, fault, count)
        for count in options.counts
        for label, fault in kinds.items()
    }
    found = scores.measure_rows(options.out, rows, dataset, names, shown)
    if meshed:
        surface = poisson.Renderer(dataset.settings)
        solved = {
            f"{count:,}, {label}, Poisson": partial(measure_surface, options, surface, fault, count)
            for count in options.counts
            for label, fault in kinds.items()
        }
        for row, objects in scores.measure_rows(options.out, solved, dataset, meshed).items():
            for of, surfaces in zip(found[row.removesuffix(", Poisson")], objects, strict=False):
                of["poisson"] = surfaces["poisson"]
    tables = [_table(options, found), _rivals(options, found)]
    results_folder.write(options.out, {"objects": found, "hardware": runtime.hardware()}, tables)
    if shown:
        largest = {row: rows[row] for row in (f"{max(options.counts):,}, {label}" for label in kinds)}
        size = options.resolution or data_sets.read_object(dataset, names[0]).camera.height
        sheet = scores.gallery(options.out, largest, dataset, shown, options.resolution, size)
        images.write_whole(options.out / "gallery.png", sheet)


def _table(options: ScansStudy, found: Mapping[str, Sequence[dict]]) -> Table:
    """Scores of each fault, without and with cleaning."""
    rows = []
    for row, objects in found.items():
        _, cells = _row(row, objects, ("off", "auto"))
        rows.append((row, (*cells, number(100 * np.mean([of["left"] for of in objects]), 0))))
    count = len(next(iter(found.values())))
    note = "Means over objects with 95 % intervals; points left: of the data set's, before cleaning."
    return Table(title=f"Scans, {count} objects x {options.views} views", heads=HEADS, rows=tuple(rows), note=note)


def _rivals(options: ScansStudy, found: Mapping[str, list[dict]]) -> Table:
    """Scores of all who draw the same cleaned points, over the objects that all of them drew."""
    ways = [way for way in RIVALS if way != "poisson" or options.meshed]
    counted = {row: objects[: options.meshed or len(objects)] for row, objects in found.items()}
    return Table(
        title=f"The same cleaned points drawn otherwise, {len(next(iter(counted.values())))} objects",
        heads=tuple(head for way in ways for head in (f"{RIVALS[way]}: PSNR, dB", "inside, dB", "FLIP")),
        rows=tuple(_row(row, objects, ways) for row, objects in counted.items()),
    )


def _row(row: str, objects: Sequence[dict], ways: Sequence[str]) -> tuple[str, tuple[Cell, ...]]:
    values = [[of[way][column] for way in ways for column in COLUMNS] for of in objects]
    return mean_row(row, values, DECIMALS * len(ways))


def add_fault(cloud: PointCloud, fault: Fault | None) -> tuple[np.ndarray, Values]:
    """Positions in the cloud's units and materials after a fault, the same at every call; normals are dropped."""
    positions = np.asarray(cloud.positions, np.float64)
    values = {name: np.asarray(getattr(cloud, name)) for name in ("base_color", "roughness", "metallic")}
    if fault is None:
        return positions, values
    centre, scale = normalization(positions)
    positions, values = fault((positions - centre) * scale, values, np.random.default_rng(0))
    return positions / scale + centre, values


def as_it_is(positions: np.ndarray, values: Values) -> Cleaned:
    """Points that nothing is done to."""
    return Cleaned(positions, values, [], 0.0)


def thin(points: Cleaned, count: int) -> PointCloud:
    """At most so many points, evenly spread, with normals from all, as `read_cloud` keeps them."""
    if len(points.positions) <= count:
        return normals.thin_cloud(points, np.arange(len(points.positions)))
    return normals.thin_cloud(points, np.sort(farthest_points(points.positions, count, seed=0)))


def measure(options: ScansStudy, model: Model, fault: Fault | None, count: int, item: ObjectData) -> Measured:
    """Mean scores of an object's views without and with cleaning, and the share of its points that is left."""
    dirty = as_it_is(*add_fault(item.cloud, fault))
    clean = clean_columns(dirty.positions, dirty.values)
    seen = cut(item, views=options.views, resolution=options.resolution)

    def draw(points: Cleaned, **quality: Any) -> Pictures:
        return contenders.of_model(model, **quality).show(dataclasses.replace(seen, cloud=thin(points, count)))

    best, draft = draw(clean), draw(clean, quality="draft")
    found = {"auto": scores.mean_of(seen, best, COLUMNS), "draft": scores.mean_of(seen, draft, COLUMNS)}
    found["off"] = scores.mean_of(seen, draw(dirty), COLUMNS) if clean.lines else found["auto"]
    left = len(dirty.positions) / len(item.cloud.positions)
    return found | {"said": clean.lines, "left": left}, np.asarray(best.image[0])


def measure_surface(
    options: ScansStudy, renderer: poisson.Renderer, fault: Fault | None, count: int, item: ObjectData
) -> Measured:
    """Mean scores of the trimmed Poisson surface of the cleaned points."""
    seen = cut(item, views=options.views, resolution=options.resolution)
    seen = dataclasses.replace(seen, cloud=thin(clean_columns(*add_fault(item.cloud, fault)), count))
    pictures = renderer.method("poisson_trimmed").show(seen)
    return {"poisson": scores.mean_of(seen, pictures, COLUMNS)}, np.asarray(pictures.image[0])


if __name__ == "__main__":
    entry_point.run(main, ScansStudy, "studies.scans")
