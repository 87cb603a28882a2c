"""What else draws the same points, and the true mesh with less than light transport, in the lights of `relighting.py`?

    python -m experiments.studies.relighting_beside --data ROOM VENICE STUDIO --maps MAPS --meshes MESHES --out OUT

Beside the network and its discs: trimmed Poisson surfaces in Mitsuba under the very map of each view, and two oracles
in it, the true mesh lit without shadows and with ambient occlusion instead of shadows.  The score of shadows is the
correlation, over the pixels inside, of log(picture / true mesh without shadows) with the same of the reference: 1 says
that what geometry keeps away and throws back is told, 0 that nothing is.

    OUT/results.json  OUT/table.md .csv .tex     scores of each light, row and size; the network's margins
    OUT/NAME.png                                 the first view of an object: a row a light, reference and rows
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from tqdm import tqdm

from experiments import entry_point
from experiments.comparison import figures, poisson, relit, results_folder, source_meshes
from experiments.comparison.object_views import Picture, on_white, smaller, told, view_of
from experiments.studies.relighting import (
    DECIMALS,
    HEADS,
    METHODS,
    NETWORK,
    UNSHADOWED,
    correlation,
    draw,
    log_light,
    name_of,
    scores,
)
from spnr_jax.devices import machine
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets, images
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.kernels.records import Volume
from spnr_jax.method.model import Model
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.score_tables import Table, mean_row
from spnr_jax.training.weights import load

POISSON, NO_SHADOWS, OCCLUSION = "Poisson, trimmed .3", "true mesh, no shadows", "true mesh, ambient occlusion"
CLIPPED = 0.995  # sRGB from which on a pixel says "at least"
SHOWN = 192  # pixels of a picture on a sheet


@dataclass(frozen=True, kw_only=True)
class BesideStudy:
    """The same points by other means, and oracles of the true mesh."""

    data: tuple[Path, ...]
    """Data sets of the same objects, one for each kind of light."""
    maps: Path
    """Folder of the maps that lit them."""
    out: Path
    """Folder of the results; the same command goes on there."""
    meshes: Path | None = None
    """Folder of the mesh files that the data sets were made from, if they were."""
    run: str = "surfels"
    """Network: of the package, a run folder or a file of weights."""
    counts: tuple[int, ...] = (1024, 16384)
    """Points of an object, the first of its file."""
    sizes: tuple[int, ...] = (128, 512)
    """Pixels along each side: those of the data sets, or whole shares of them."""
    views: int = 2
    """Views of an object in each light."""
    objects: int = 6
    """Test objects, spread over the list."""
    spp: int = 16
    """Samples a pixel of Mitsuba's pictures, which have the size of the data sets and are made smaller."""


@dataclass(frozen=True, eq=False)
class Made:
    """What is made of an object once for all lights."""

    positions: np.ndarray
    mesh: Asset
    surfaces: Mapping[int, Asset]
    volumes: Mapping[int, Volume]


Found = dict[str, list[dict[str, dict[str, list[float]]]]]  # light -> objects: row -> size -> scores


def main(options: BesideStudy) -> None:
    """Draws, scores and writes."""
    relit.prepare()
    model = load(options.run)
    datasets = {name_of(dataset): dataset for dataset in map(data_sets.open_dataset, options.data)}
    names = evaluation.spread(next(iter(datasets.values())).splits["test"], options.objects)
    asked = {name: getattr(options, name) for name in ("run", "views", "sizes", "spp", "counts")}
    found: Found = {light: [] for light in datasets}
    for light, dataset in datasets.items():
        results_folder.claim(options.out / "scores" / light, "relighting beside", asked, dataset)
    for name in tqdm(names, desc="objects"):  # the lights inside: they share what is made of an object
        first = next(iter(datasets.values()))
        made = cache(lambda name=name, first=first: _made(options, first, name, model))
        for light, dataset in datasets.items():
            found[light].append(_kept(options, dataset, name, light, made, model))
        sheets = [options.out / "scores" / light / f"{name}.png" for light in datasets]
        whole = np.concatenate([results_folder.kept(sheet, lambda: None) for sheet in sheets])
        images.write_whole(options.out / f"{name}.png", images.png(whole))
    tables = [table for size in map(str, options.sizes) for table in (_table(found, size), _margins(found, size))]
    results_folder.write(options.out, {"objects": found, "names": names, "hardware": machine.hardware()}, tables)


def _made(options: BesideStudy, dataset: data_sets.Dataset, name: str, model: Model) -> Made:
    item = data_sets.read_object(dataset, name)
    clouds = {count: told(data_sets.first_points(item, count), normals=False) for count in options.counts}
    return Made(
        positions=np.asarray(item.cloud.positions),
        mesh=source_meshes.mesh_of(dataset, item, options.meshes),
        surfaces={count: poisson.trimmed_surface(cloud) for count, cloud in clouds.items()},
        volumes={count: model.encode(cloud) for count, cloud in clouds.items()},
    )


def _kept(
    options: BesideStudy,
    dataset: data_sets.Dataset,
    name: str,
    light: str,
    made: Callable[[], Made],
    model: Model,
) -> dict[str, dict[str, list[float]]]:
    """Mean scores of an object's views by row and size; a sheet of its first view is kept beside them."""
    place = options.out / "scores" / light / f"{name}.json"

    def make() -> dict[str, dict[str, list[float]]]:
        item = data_sets.read_object(dataset, name)
        if not np.array_equal(np.asarray(item.cloud.positions), made().positions):
            raise UserError(f"{dataset.folder}: has other points of {name} than the first data set")
        mitsuba = _by_mitsuba(options, dataset, item, made())
        rows: dict[str, dict[str, list[float]]] = {}
        for size in options.sizes:
            references = [view_of(item, view, size)[1] for view in range(options.views)]
            side = item.camera.height // size
            reduced = {label: [smaller(x, side) if side > 1 else x for x in of] for label, of in mitsuba.items()}
            bare = reduced[NO_SHADOWS]
            drawn = {label: [on_white(x) for x in of] for label, of in reduced.items()}
            drawn = _ours(options, item, made(), model, size) | drawn
            for label, of in drawn.items():
                rows.setdefault(label, {})[str(size)] = _mean_scores(of, references, bare)
        images.write_whole(place.with_suffix(".png"), images.png(_sheet(light, references[0], drawn)))
        return rows

    return results_folder.kept(place, make)


def _by_mitsuba(
    options: BesideStudy, dataset: data_sets.Dataset, item: data_sets.ObjectData, made: Made
) -> dict[str, list[np.ndarray]]:
    """Straight-alpha pictures of the first views, of surfaces and oracles."""
    poses = list(np.asarray(item.camera.cam_to_world)[: options.views])
    maps = relit.maps_of(dataset, item, options.maps)[: options.views]
    view = relit.view_config(dataset, options.spp)
    surfaces = {f"{POISSON}, {n:,}": relit.pictures(x, poses, maps, view) for n, x in made.surfaces.items()}
    oracles = {
        NO_SHADOWS: relit.pictures(made.mesh, poses, maps, view, "unshadowed"),
        OCCLUSION: relit.pictures(made.mesh, poses, maps, view, "occlusion"),
    }
    return surfaces | oracles


def _ours(
    options: BesideStudy, item: data_sets.ObjectData, made: Made, model: Model, size: int
) -> dict[str, list[Picture]]:
    cameras = [view_of(item, view, size)[0] for view in range(options.views)]
    lights = (item.own_lights or [])[: options.views]
    return {
        f"{method}, {count:,}": draw(model, volume, method, cameras, lights)
        for count, volume in made.volumes.items()
        for method in METHODS
    }


def _mean_scores(drawn: Sequence[Picture], references: Sequence[np.ndarray], bare: Sequence[np.ndarray]) -> list[float]:
    """Those of `relighting.scores` and that of shadows, means over views."""
    found = [
        [*scores(*picture, reference), shadow_score(picture[0], reference, unlit)]
        for picture, reference, unlit in zip(drawn, references, bare, strict=True)
    ]
    return np.mean(found, axis=0).tolist()


def shadow_score(image: np.ndarray, reference: np.ndarray, bare: np.ndarray) -> float:
    """Correlation of what shadows and bounces change, in the picture (on white) and in the reference, over pixels.

    log(picture / bare) beside log(reference / bare), mean light of the colours, where the reference is solid and
    neither it nor the true mesh without shadows (straight alpha both) is clipped.  0 where one of the two is flat.
    """
    solid = np.minimum(reference[..., 3], bare[..., 3]) > 0.999
    clear = solid & (np.maximum(reference, bare)[..., :3].max(axis=-1) < CLIPPED)
    ours, theirs, without = (log_light(x, clear) for x in (image, reference, bare))
    return correlation(ours - without, theirs - without)


def _sheet(light: str, reference: np.ndarray, drawn: Mapping[str, Sequence[Picture]]) -> np.ndarray:
    cells = [on_white(reference)[0], *(of[0][0] for of in drawn.values())]
    return figures.grid([cells], ["reference", *drawn], [light], size=SHOWN)


def _table(found: Found, size: str) -> Table:
    rows = [
        mean_row(f"{light}, {label}", [of[label][size] for of in objects], (*DECIMALS, 2))
        for light, objects in found.items()
        for label in objects[0]
    ]
    note = "Means over objects with 95 % intervals; pictures are never rescaled."
    return Table(title=f"Beside, {size} pixels", heads=(*HEADS, "shadows"), rows=tuple(rows), note=note)


def _margins(found: Found, size: str) -> Table:
    """The network's decibels, of whole pictures and inside, above those of the other rows."""
    rows = []
    for light, objects in found.items():
        for label in objects[0]:
            name, _, count = label.partition(", ")
            if name != NETWORK:
                continue
            others = (f"{UNSHADOWED}, {count}", f"{POISSON}, {count}", NO_SHADOWS, OCCLUSION)
            values = [[of[label][size][i] - of[x][size][i] for x in others for i in (0, 1)] for of in objects]
            rows.append(mean_row(f"{light}, {count}", values, (2,) * 8, "+"))
    heads = tuple(
        f"{what}, above {x}" for x in ("split-sum", POISSON, NO_SHADOWS, OCCLUSION) for what in ("PSNR", "inside")
    )
    return Table(
        title=f"The network's margins, {size} pixels, dB", heads=heads, rows=tuple(rows), note="Of the same objects."
    )


if __name__ == "__main__":
    entry_point.run(main, BesideStudy, "studies.relighting_beside")
