"""How well does the network draw an object in a light that it never saw?

    python -m experiments.studies.relighting --data ROOM VENICE STUDIO --out OUT [--run surfels] [--counts 1024 16384]

Each data set holds the same objects under one kind of light (`spnr-data generate --lights FOLDER_OF_ONE_MAP`, or
`--lights room`), turned for every view and kept beside it.  Beside the network: the same discs and light alone, with
and without the visibility of the points (split-sum shading, Karis 2013).  Nothing is rescaled to the reference.

    OUT/results.json  OUT/table.md     dB, dB inside, FLIP, log error of linear light, of each light; margins
    OUT/gallery.png                              references over pictures, an object a row, a light a column
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.comparison.object_views import Picture, drawn, on_white, told, view_of, view_scores
from spnr_jax.config import Quality
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels.colors import srgb_to_linear
from spnr_jax.kernels.records import Camera, Light, Volume
from spnr_jax.method.model import Model
from spnr_jax.scoring.report import Table, mean_row
from spnr_jax.training.weights import load

HEADS = ("PSNR, dB", "inside, dB", "FLIP", "log error")
DECIMALS = (2, 2, 3, 3)
DARK = 1e-3  # linear light below which the logarithm is not taken
GALLERY = 8  # objects in the gallery
NETWORK, DISCS, UNSHADOWED = "network", "discs and light", "discs and light, nothing hides anything"
METHODS: dict[str, Quality] = {NETWORK: "best", DISCS: "draft", UNSHADOWED: "draft"}
ROOM = "room"
Found = dict[tuple[str, int], list[dict[str, list[float]]]]  # light, points -> objects: method -> scores


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
    found: Found = {}
    shown: list[list[np.ndarray]] = []
    for folder in options.data:
        dataset = data_sets.open_dataset(folder)
        names = dataset.splits["test"][: options.objects]
        light = name_of(dataset)
        asked = {"run": options.run, "views": options.views, "objects": list(names), "resolution": options.resolution}
        results_folder.claim(options.out / "scores" / light, "relighting", asked, dataset)
        for count in options.counts:
            found[light, count] = [
                _kept(options, dataset, name, light, count, model)
                for name in tqdm(names, desc=f"{light}, {count:,} points")
            ]
        shown += [[picture for name in names[:GALLERY] for picture in _shown(options, dataset, name, light)]]
    _write(options.out, found, shown)


def name_of(dataset: data_sets.Dataset) -> str:
    """The light of a data set; ValueError if its views have none of their own."""
    if not data_sets.has_lights(dataset):
        raise UserError(f"{dataset.folder}: its views have no light of their own; generate it with --lights")
    kinds = dataset.settings["environment_map"]["kinds"]
    return " and ".join(Path(name).stem for kind in kinds for name in kind.get("sha256", {kind["name"]: None}))


def _place(options: RelightingStudy, light: str, name: str, count: int) -> Path:
    return options.out / "scores" / light / f"{name}_{count}.json"


def _kept(
    options: RelightingStudy, dataset: data_sets.Dataset, name: str, light: str, count: int, model: Model
) -> dict[str, list[float]]:
    """Mean scores of an object's views, by method; the network's first picture is kept beside them."""
    place = _place(options, light, name, count)

    def make() -> dict[str, list[float]]:
        item = data_sets.read_object(dataset, name)
        lights = (item.own_lights or [])[: options.views]
        cameras, references = zip(
            *(view_of(item, view, options.resolution) for view in range(len(lights))), strict=True
        )
        volume = model.encode(told(data_sets.first_points(item, count), normals=False))
        found = {method: draw(model, volume, method, cameras, lights) for method in METHODS}
        images.write_whole(place.with_suffix(".png"), images.png(found[NETWORK][0][0]))
        return {
            method: np.mean([scores(*picture, y) for picture, y in zip(of, references, strict=True)], axis=0).tolist()
            for method, of in found.items()
        }

    return results_folder.kept(place, make)


def draw(
    model: Model, volume: Volume, method: str, cameras: Sequence[Camera], lights: Sequence[Light]
) -> list[Picture]:
    """What a method shows of an encoded object, each camera in its light."""
    return drawn(model, unshadowed(volume) if method == UNSHADOWED else volume, cameras, METHODS[method], lights)


def unshadowed(volume: Volume) -> Volume:
    """The volume as if every direction saw every point."""
    surfels = volume.scene.surfels
    surfels = dataclasses.replace(surfels, visible=jnp.ones_like(surfels.visible))
    return dataclasses.replace(volume, scene=dataclasses.replace(volume.scene, surfels=surfels))


def scores(image: np.ndarray, opacity: np.ndarray, reference: np.ndarray) -> list[float]:
    """`view_scores`, and the root mean square of the ratio of linear light inside, in nepers."""
    inside = reference[..., 3] > 0.999
    ours, theirs = (np.log(np.maximum(linear(x), DARK)) for x in (image, on_white(reference)[0]))
    error = float(np.sqrt(np.mean((ours - theirs)[inside] ** 2))) if inside.any() else 0.0
    return [*view_scores(image, opacity, reference), error]


def linear(image: np.ndarray) -> np.ndarray:
    """Linear light of an sRGB picture."""
    return np.asarray(srgb_to_linear(jnp.asarray(image)))


def _write(out: Path, found: Found, shown: Sequence[Sequence]) -> None:
    """Tables, results.json and the gallery."""
    rows = {
        f"{light}, {count:,}, {method}": [of[method] for of in objects]
        for (light, count), objects in found.items()
        for method in METHODS
    }
    note = "Means over objects with 95 % intervals; pictures are never rescaled."
    table = Table(
        title="Relighting",
        heads=HEADS,
        rows=tuple(mean_row(label, values, DECIMALS) for label, values in rows.items()),
        note=note,
    )
    results = {"objects": rows, "hardware": runtime.hardware()}
    results_folder.write(out, results, [table, _margins(found)])
    columns = [text for light in dict.fromkeys(light for light, _ in found) for text in (f"{light}: reference", "ours")]
    grid = [[picture for of in shown for picture in of[2 * i : 2 * i + 2]] for i in range(min(map(len, shown)) // 2)]
    images.write_whole(out / "gallery.png", images.png(figures.grid(grid, columns, size=256)))


def _margins(found: Found) -> Table:
    """The network beside split-sum shading, discs and light, and itself in the room; objects are paired."""
    rows = []
    for (light, count), objects in found.items():
        own = np.array([of[NETWORK][:2] for of in objects])
        others = [np.array([of[method][:2] for of in objects]) for method in (UNSHADOWED, DISCS)]
        room = found.get((ROOM, count))
        others.append(np.array([of[NETWORK][:2] for of in room]) if room else np.full_like(own, np.nan))
        rows.append(mean_row(f"{light}, {count:,}", np.hstack([own - x for x in others]), (2,) * 6, "+"))
    heads = tuple(
        f"{what}, {than}"
        for than in ("above split-sum", "above discs", "above the room")
        for what in ("PSNR", "inside")
    )
    return Table(title="The network's margins, dB", heads=heads, rows=tuple(rows), note="Of the same objects.")


def _shown(
    options: RelightingStudy, dataset: data_sets.Dataset, name: str, light: str
) -> tuple[np.ndarray, np.ndarray]:
    """Reference and picture of an object's first view."""
    _, reference = view_of(data_sets.read_object(dataset, name), 0, options.resolution)
    place = _place(options, light, name, max(options.counts)).with_suffix(".png")
    return on_white(reference)[0], results_folder.kept(place, lambda: None)


if __name__ == "__main__":
    entry_point.run(main, RelightingStudy, "studies.relighting")
