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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments import entry_point
from experiments.comparison import figures, poisson, results_folder
from experiments.comparison.object_views import Picture, drawn, few, on_white, view_of, view_scores
from spnr_jax.config import Quality
from spnr_jax.devices import runtime
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels.cleaning import Cleaned, Values, cleaned
from spnr_jax.kernels.cloud_arrays import normalization
from spnr_jax.kernels.records import Camera, PointCloud
from spnr_jax.kernels.thinning import farthest_points
from spnr_jax.method.model import Model
from spnr_jax.scoring.report import Cell, Table, mean_row, number
from spnr_jax.surfels import outward
from spnr_jax.training.scan_faults import Fault, faults
from spnr_jax.training.weights import load

HEADS = ("PSNR, dB", "inside, dB", "FLIP", "cleaned: PSNR, dB", "inside, dB", "FLIP", "points left, %")
DECIMALS = (2, 2, 3)
View = tuple[Camera, np.ndarray]  # and its reference
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
    model, meshed = load(options.run), names[: options.meshed]
    surface = poisson.Renderer(dataset.settings) if meshed else None
    rows: dict[str, list[dict]] = {}
    for count in options.counts:
        for label, fault in faults(options.noise, options.outliers, options.scanners).items():
            row, place = f"{count:,}, {label}", options.out / "scores" / f"{count} {label}".replace(" ", "_")
            rows[row] = [
                _kept(place, dataset, name, partial(_scores, options, model, fault, count))
                for name in tqdm(names, desc=row)
            ]
            if surface is not None:
                for name, found in zip(meshed, rows[row], strict=False):
                    scores = partial(_poisson_scores, options, surface, fault, count)
                    found["poisson"] = _kept(place / "poisson", dataset, name, scores)
    table = Table(
        title=f"Scans, {len(names)} objects x {options.views} views",
        heads=HEADS,
        rows=tuple(
            (row, (*_row(row, found, ("off", "auto"))[1], number(100 * np.mean([of["left"] for of in found]), 0)))
            for row, found in rows.items()
        ),
        note="Means over objects with 95 % intervals; points left: of the data set's, before cleaning.",
    )
    hardware = runtime.hardware()
    results_folder.write(options.out, {"objects": rows, "hardware": hardware}, [table, _rivals(options, rows)])
    if options.shown:
        _gallery(options, dataset, names[: options.shown], model)


def _rivals(options: ScansStudy, rows: dict[str, list[dict]]) -> Table:
    """Scores of all who draw the same cleaned points, over the objects that all of them drew."""
    ways = [way for way in RIVALS if way != "poisson" or options.meshed]
    counted = {row: found[: options.meshed or len(found)] for row, found in rows.items()}
    return Table(
        title=f"The same cleaned points drawn otherwise, {len(next(iter(counted.values())))} objects",
        heads=tuple(head for way in ways for head in (f"{RIVALS[way]}: PSNR, dB", "inside, dB", "FLIP")),
        rows=tuple(_row(row, found, ways) for row, found in counted.items()),
    )


def _kept(place: Path, dataset: data_sets.Dataset, name: str, scores: Callable[[data_sets.ObjectData], Any]) -> Any:
    return results_folder.kept(place / f"{name}.json", lambda: scores(data_sets.read_object(dataset, name)))


def spoiled(cloud: PointCloud, fault: Fault | None) -> tuple[np.ndarray, Values]:
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


def thinned(points: Cleaned, count: int) -> PointCloud:
    """At most so many points, evenly spread, with normals from all, as `read_cloud` keeps them."""
    if len(points.positions) <= count:
        return outward.thinned(points, np.arange(len(points.positions)))
    return outward.thinned(points, np.sort(farthest_points(points.positions, count, seed=0)))


def _scores(
    options: ScansStudy, model: Model, fault: Fault | None, count: int, item: data_sets.ObjectData
) -> dict[str, Any]:
    """Mean scores of an object's views without and with cleaning, and the share of its points that is left."""
    dirty = as_it_is(*spoiled(item.cloud, fault))
    clean = cleaned(dirty.positions, dirty.values)
    cloud = thinned(clean, count)
    views = views_of(item, options.views, options.resolution)
    auto, draft = (mean_scores(drawn_of(model, cloud, views, quality), views) for quality in ("best", "draft"))
    off = mean_scores(drawn_of(model, thinned(dirty, count), views), views) if clean.lines else auto
    left = len(dirty.positions) / len(item.cloud.positions)
    return {"off": off, "auto": auto, "draft": draft, "said": clean.lines, "left": left}


def _poisson_scores(
    options: ScansStudy, renderer: poisson.Renderer, fault: Fault | None, count: int, item: data_sets.ObjectData
) -> list[float]:
    """Mean scores of the trimmed Poisson surface of the cleaned points."""
    cloud = thinned(cleaned(*spoiled(item.cloud, fault)), count)
    seen = dataclasses.replace(few(item, options.views), cloud=cloud)
    pictures, _ = renderer.pictures(seen, count, poisson.SURFACES["poisson_trimmed"])
    made, views = (
        views_of(x, options.views, options.resolution) for x in (dataclasses.replace(seen, images=pictures), item)
    )
    return mean_scores([on_white(rgba) for _, rgba in made], views)


def views_of(item: data_sets.ObjectData, views: int, resolution: int | None) -> list[View]:
    """The first views of an object at a resolution, None for its own."""
    return [view_of(item, view, resolution) for view in range(min(views, len(item.images)))]


def drawn_of(model: Model, cloud: PointCloud, views: Sequence[View], quality: Quality = "best") -> list[Picture]:
    """Pictures of a cloud from cameras."""
    return drawn(model, model.encode(cloud), [camera for camera, _ in views], quality)


def mean_scores(drawn: Sequence[Picture], views: Sequence[View]) -> list[float]:
    """Mean PSNR, PSNR inside and FLIP of pictures."""
    found = [view_scores(*picture, reference) for picture, (_, reference) in zip(drawn, views, strict=True)]
    return np.nanmean(found, axis=0).tolist()


def _row(row: str, found: Sequence[dict], ways: Sequence[str]) -> tuple[str, tuple[Cell, ...]]:
    return mean_row(row, [[x for way in ways for x in scores[way]] for scores in found], DECIMALS * len(ways))


def _gallery(options: ScansStudy, dataset: data_sets.Dataset, names: Sequence[str], model: Model) -> None:
    """References, and pictures of the cleaned clouds of the largest count."""
    kinds = faults(options.noise, options.outliers, options.scanners)
    cells = []
    for name in names:
        item = data_sets.read_object(dataset, name)

        def picture(label: str, name: str = name, item: data_sets.ObjectData = item) -> np.ndarray:
            def make() -> np.ndarray:
                cloud = thinned(cleaned(*spoiled(item.cloud, kinds[label])), max(options.counts))
                return images.to_uint8(drawn_of(model, cloud, views_of(item, 1, options.resolution))[0][0])

            return results_folder.kept(options.out / "pictures" / f"{name}_{label}.png".replace(" ", "_"), make)

        reference = view_of(item, 0, options.resolution)[1]
        cells.append([on_white(reference)[0], *map(picture, kinds)])
    sheet = figures.grid(cells, ["reference", *kinds], names, size=cells[0][0].shape[0])
    images.write_whole(options.out / "gallery.png", images.png(sheet))


if __name__ == "__main__":
    entry_point.run(main, ScansStudy, "studies.scans")
