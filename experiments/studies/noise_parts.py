"""What of a noisy cloud costs the picture: places, colours, normals, or which points are kept?

    python -m experiments.studies.noise_parts --data DIR --out OUT [--resolution 128]

Clouds of the test objects are made noisy, cleaned and thinned as in scans.py; then a part of what is left is put right:

    places             each point is moved to the nearest point of the true surface (the nearest of the data set)
    half of places     half the way there
    best radius        each point is averaged in RADII of the noise, and lies where it came nearest to the true surface:
                       what no rule that chooses a radius for each point can do better
    all places         every cleaned point is moved there before the cloud is thinned
    colours            base colour, roughness and metallic are those of that point
    normals            so are the normals, which else are estimated from all cleaned points
    averaged alone     no cleaning, but the mean of the noisy points in so many voxels

    OUT/results.json  OUT/table.md .csv .tex     dB, dB inside, FLIP
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from experiments import entry_point
from experiments.comparison import results_folder
from experiments.studies.scans import DECIMALS, as_it_is, drawn_of, mean_scores, spoiled, thinned, views_of
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.kernels.cleaning import RADIUS, Values, averaged, cleaned, fringe, fringe_cell, is_noisy, noise, outliers
from spnr_jax.kernels.records import PointCloud
from spnr_jax.kernels.thinning import farthest_points, voxel_keys
from spnr_jax.scoring.score_tables import Table, number
from spnr_jax.surfels.outward import outward_normals
from spnr_jax.training.scan_faults import noisy
from spnr_jax.training.weights import load

MATERIALS = ("base_color", "roughness", "metallic")
RADII = (0.5, 0.7, 1.0, 1.4, 2.0, 3.0)  # standard deviations of the noise; RADIUS is one of them
HALVINGS = 30  # of the interval in which the voxels' side is looked for


@dataclass(frozen=True, kw_only=True)
class NoiseParts:
    """Scores of noisy clouds of which a part was put right."""

    data: Path
    """Folder of a data set whose points are spread evenly."""
    out: Path
    """Folder of the results; the same command goes on there."""
    run: str = "surfels"
    """Network: of the package, a run folder or a file of weights."""
    count: int = 4096
    """Points that are drawn."""
    noise: tuple[float, ...] = (0.01, 0.02)
    """Standard deviations, in units of the box whose half diagonal is 1."""
    resolution: int = 128
    """Pixels along each side: a whole share of the data set's."""
    views: int = 2
    """Views of an object."""
    names: tuple[str, ...] = ()
    """Test objects (default: all)."""


def main(options: NoiseParts) -> None:
    """Draws, scores and writes."""
    dataset = data_sets.open_dataset(options.data)
    names = options.names or tuple(dataset.splits["test"])
    asked = {name: getattr(options, name) for name in ("run", "count", "resolution", "views")}
    results_folder.claim(options.out, "noise_parts", asked, dataset)
    model, rows = load(options.run), dict[str, dict[str, list[float]]]()
    for name in names:
        item = data_sets.read_object(dataset, name)
        views = views_of(item, options.views, options.resolution)
        for row, make in _clouds(item.cloud, options.noise, options.count):
            place = options.out / "scores" / row.replace(" ", "_") / f"{name}.json"
            found = results_folder.kept(place, lambda: mean_scores(drawn_of(model, make(), views), views))  # noqa: B023
            rows.setdefault(row, {})[name] = found
    means = {row: np.mean(list(found.values()), axis=0) for row, found in rows.items()}
    table = Table(
        title=f"What of noise costs the picture, {len(names)} objects x {options.views} views",
        heads=("PSNR, dB", "inside, dB", "FLIP"),
        rows=tuple((row, tuple(map(number, mean, DECIMALS))) for row, mean in means.items()),
    )
    results_folder.write(options.out, {"objects": rows, "hardware": machine.hardware()}, [table])


def _clouds(true: PointCloud, noise: tuple[float, ...], count: int) -> Iterator[tuple[str, Callable[[], PointCloud]]]:
    """A row's name, and what makes its cloud."""
    positions, values = spoiled(true, None)
    normals, surface = {"normals": np.asarray(true.normals)}, cKDTree(true.positions)
    yield "clean", partial(thinned, as_it_is(positions, values), count)
    yield "clean, with normals", partial(thinned, as_it_is(positions, values | normals), count)
    for sigma in noise:
        points = spoiled(true, partial(noisy, sigma=sigma))
        clean = cleaned(*points)
        dirty = thinned(clean, count)
        right = _nearest(true, surface, np.asarray(dirty.positions))
        colours = {name: right[name] for name in MATERIALS}
        parts = {
            "cleaned": {},
            "places put right": {"positions": right["positions"]},
            "half of places put right": {"positions": (right["positions"] + np.asarray(dirty.positions)) / 2},
            "colours put right": colours,
            "places and colours put right": colours | {"positions": right["positions"]},
            "normals put right": {"normals": right["normals"]},
            "places and normals put right": {name: right[name] for name in ("positions", "normals")},
        }
        for name, part in parts.items():
            yield f"{sigma:.1%}, {name}", partial(dataclasses.replace, dirty, **part)
        all_right = _nearest(true, surface, clean.positions)
        places, normals = all_right["positions"], {"normals": all_right["normals"]}
        yield f"{sigma:.1%}, all places put right", partial(thinned, as_it_is(places, clean.values), count)
        of_all = as_it_is(places, clean.values | normals)
        yield f"{sigma:.1%}, all places and normals put right", partial(thinned, of_all, count)
        yield f"{sigma:.1%}, best radius", partial(_best_radius, *points, count, surface)
        yield f"{sigma:.1%}, averaged alone", partial(_averaged, *points, count)


def _nearest(true: PointCloud, surface: cKDTree, positions: np.ndarray) -> Values:
    """Places, normals and materials of the points of the true surface that are nearest to some."""
    rows = surface.query(np.asarray(positions, np.float64))[1]
    return {name: np.asarray(getattr(true, name))[rows] for name in ("positions", "normals", *MATERIALS)}


def _best_radius(positions: np.ndarray, values: Values, count: int, surface: cKDTree) -> PointCloud:
    """The points that cleaning and thinning keep, each averaged in the radius that brings it nearest to the surface."""
    left = ~outliers(positions)
    positions, values = positions[left], {name: column[left] for name, column in values.items()}
    sigma, spacing = noise(positions)
    if not is_noisy(sigma, spacing):
        return thinned(as_it_is(positions, values), count)
    found = [averaged(positions, values, sigma, spacing, radius) for radius in RADII]
    moved = found[RADII.index(RADIUS)][0]
    kept = np.flatnonzero(~fringe(moved, fringe_cell(sigma, spacing)))
    rows = kept[np.sort(farthest_points(moved[kept], count, seed=0))]
    best = np.argmin([surface.query(places[rows])[0] for places, _ in found], axis=0)

    def chosen(columns: list[np.ndarray]) -> np.ndarray:
        return np.stack([column[rows] for column in columns])[best, np.arange(len(rows))].astype(np.float32)

    means = {name: chosen([columns[name] for _, columns in found]) for name in values}
    colors, numbers = values["base_color"][kept], np.searchsorted(kept, rows)
    means["normals"] = outward_normals(moved[kept], colors, numbers, sigma).astype(np.float32)
    return PointCloud(positions=chosen([places for places, _ in found]), mask=np.ones(len(rows), bool), **means)


def _averaged(positions: np.ndarray, values: Values, count: int) -> PointCloud:
    """Means of at most so many voxels."""
    low, high = 1e-3 * np.ptp(positions), np.ptp(positions)
    for _ in range(HALVINGS):
        side = np.sqrt(low * high)
        many = len(np.unique(voxel_keys(positions - positions.min(axis=0), side))) > count
        low, high = (side, high) if many else (low, side)
    voxel = np.unique(voxel_keys(positions - positions.min(axis=0), high), return_inverse=True)[1].ravel()
    points = np.bincount(voxel)

    def mean(column: np.ndarray) -> np.ndarray:
        sums = np.zeros((len(points), *column.shape[1:]))
        np.add.at(sums, voxel, column)
        return sums / points.reshape(-1, *[1] * (column.ndim - 1))

    return thinned(as_it_is(mean(positions), {name: mean(column) for name, column in values.items()}), count)


if __name__ == "__main__":
    entry_point.run(main, NoiseParts, "studies.noise_parts")
