"""How well does the network draw an object in a light that it never saw?

    python -m experiments.studies.relighting --data ROOM VENICE STUDIO --out OUT [--run surfels] [--counts 1024 16384]

Each data set holds the same objects under one kind of light (`spnr-data generate --lights FOLDER_OF_ONE_MAP`, or
`--lights room`), turned for every view and kept beside it.  Beside the network: the same discs and light alone, with
and without the visibility of the points (split-sum shading, Karis 2013).  Nothing is rescaled to the reference.

    OUT/results.json  OUT/table.md .csv .tex     dB, dB inside, FLIP, log error of linear light, of each light
    OUT/gallery.png                              references over pictures, an object a row, a light a column
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.comparison.object_views import told, view_of
from experiments.comparison.result_tables import Cell, Table, number
from spnr_jax.devices import machine
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels.colors import srgb_to_linear
from spnr_jax.method.model import Model, Quality, Volume
from spnr_jax.scoring import intervals
from spnr_jax.scoring.flip import flip
from spnr_jax.scoring.picture_scores import sharpness
from spnr_jax.training.weights import load

HEADS = ("PSNR, dB", "inside, dB", "FLIP", "log error")
DECIMALS = (2, 2, 3, 3)
DARK = 1e-3  # linear light below which the logarithm is not taken
GALLERY = 8  # objects in the gallery
UNSHADOWED = "discs and light, nothing hides anything"
METHODS: dict[str, Quality] = {"network": "best", "discs and light": "draft", UNSHADOWED: "draft"}


@dataclass(frozen=True, kw_only=True)
class RelightingStudy:
    """Pictures of objects in lights, scored against references in the same lights."""

    data: tuple[Path, ...]
    """Data sets of the same objects, one for each kind of light."""
    out: Path
    """Folder of the results; the same command goes on there."""
    run: str = "surfels"
    """Network: of the package, a run folder or a file of weights."""
    counts: tuple[int, ...] = (1024, 16384)
    """Points of an object, the first of its file."""
    resolution: int | None = None
    """Pixels along each side: those of the data sets, or a whole share of them (default: theirs)."""
    views: int = 4
    """Views of an object in each light."""
    objects: int | None = None
    """Test objects (default: all)."""


def main(options: RelightingStudy) -> None:
    """Draws, scores and writes."""
    model = load(options.run)
    rows, pictures = {}, {}
    for folder in options.data:
        dataset = data_sets.open_dataset(folder)
        names = dataset.splits["test"][: options.objects]
        light = name_of(dataset)
        asked = {"run": options.run, "views": options.views, "objects": list(names), "resolution": options.resolution}
        results_folder.claim(options.out / "scores" / light, "relighting", asked, dataset)
        for count in options.counts:
            for method in METHODS:
                label = f"{light}, {count:,}, {method}"
                rows[label] = [
                    _kept(options, dataset, name, light, method, count, model) for name in tqdm(names, desc=label)
                ]
        pictures[light] = [_shown(options, dataset, name, max(options.counts), model) for name in names[:GALLERY]]
    table = Table(
        title="Relighting",
        heads=HEADS,
        rows=tuple((label, _cells(found)) for label, found in rows.items()),
        note="Means over objects with 95 % intervals; pictures are never rescaled.",
    )
    results_folder.write(options.out, {"objects": rows, "hardware": machine.hardware()}, [table])
    grid = [[cell for of in pictures.values() for cell in of[i]] for i in range(len(next(iter(pictures.values()))))]
    heads = [text for light in pictures for text in (f"{light}: reference", "ours")]
    images.write_whole(options.out / "gallery.png", images.png(figures.grid(grid, heads, size=256)))


def name_of(dataset: data_sets.Dataset) -> str:
    """The light of a data set; ValueError if its views have none of their own."""
    if not data_sets.has_lights(dataset):
        raise UserError(f"{dataset.folder}: its views have no light of their own; generate it with --lights")
    kinds = dataset.settings["environment_map"]["kinds"]
    return " and ".join(Path(name).stem for kind in kinds for name in kind.get("sha256", {kind["name"]: None}))


def _kept(
    options: RelightingStudy,
    dataset: data_sets.Dataset,
    name: str,
    light: str,
    method: str,
    count: int,
    model: Model,
) -> list[float]:
    """Mean scores of an object's views."""
    place = options.out / "scores" / light / method.replace(" ", "_") / f"{name}_{count}.json"

    def make() -> list[float]:
        drawn = _draw(options, data_sets.read_object(dataset, name), method, count, model)
        return np.mean([scores(*picture) for picture in drawn], axis=0).tolist()

    return results_folder.kept(place, make)


def _draw(
    options: RelightingStudy, item: data_sets.ObjectData, method: str, count: int, model: Model
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Image, opacity and reference of each view."""
    volume = model.encode(told(jax.tree.map(lambda x: x[:count], item.cloud), normals=False))
    volume = unshadowed(volume) if method == UNSHADOWED else volume
    lights = (item.own_lights or [])[: options.views]
    pairs = [view_of(item, view, options.resolution) for view in range(len(lights))]
    found = model.render_each(volume, [camera for camera, _ in pairs], METHODS[method], lights)
    return [(np.asarray(r.image), np.asarray(r.acc), reference) for r, (_, reference) in zip(found, pairs, strict=True)]


def unshadowed(volume: Volume) -> Volume:
    """The volume as if every direction saw every point."""
    surfels = volume.scene.surfels
    surfels = dataclasses.replace(surfels, visible=jnp.ones_like(surfels.visible))
    return dataclasses.replace(volume, scene=dataclasses.replace(volume.scene, surfels=surfels))


def scores(image: np.ndarray, opacity: np.ndarray, reference: np.ndarray) -> list[float]:
    """PSNR, PSNR inside, FLIP on white, and the root mean square of the ratio of linear light inside, in nepers."""
    found, alpha = sharpness(image, opacity, reference), reference[..., 3:]
    white = reference[..., :3] * alpha + 1 - alpha
    inside = alpha[..., 0] > 0.999
    ours, theirs = (np.log(np.maximum(np.asarray(srgb_to_linear(jnp.asarray(x))), DARK)) for x in (image, white))
    error = float(np.sqrt(np.mean((ours - theirs)[inside] ** 2))) if inside.any() else 0.0
    return [found.psnr, found.psnr_inside, float(flip(jnp.asarray(image), jnp.asarray(white))), error]


def _cells(found: Sequence[Sequence[float]]) -> tuple[Cell, ...]:
    columns = np.asarray(found).T
    means = [intervals.interval([np.array([x]) for x in values]) if len(values) > 1 else None for values in columns]
    return tuple(
        number(float(np.mean(values)), decimals, interval)
        for values, decimals, interval in zip(columns, DECIMALS, means, strict=True)
    )


def _shown(
    options: RelightingStudy, dataset: data_sets.Dataset, name: str, count: int, model: Model
) -> tuple[np.ndarray, np.ndarray]:
    """Reference and picture of an object's first view."""
    item = data_sets.read_object(dataset, name)
    (image, _, reference), *_ = _draw(dataclasses.replace(options, views=1), item, "network", count, model)
    alpha = reference[..., 3:]
    return reference[..., :3] * alpha + 1 - alpha, image


if __name__ == "__main__":
    entry_point.run(main, RelightingStudy, "studies.relighting")
