"""How well does the network draw an object in a light that it never saw?

    python -m experiments.studies.relighting --data ROOM VENICE STUDIO --out OUT [--run surfels] [--counts 1024 16384]

Each data set holds the same objects under one kind of light (`spnr-data generate --lights FOLDER_OF_ONE_MAP`, or
`--lights room`), turned for every view and kept beside it.  Beside the network: the same discs and light alone, with
and without the visibility of the points (split-sum shading, Karis 2013).  Nothing is rescaled to the reference.

    OUT/results.json  OUT/table.md     dB, dB inside, FLIP, log error of linear light, of each light
    OUT/gallery.png                    reference and picture of each light side by side, an object a row
"""

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from experiments import entry_point
from experiments.comparison import figures, results_folder, scores
from experiments.comparison.contenders import checksums, draw_volume
from experiments.comparison.scores import Measured
from experiments.comparison.study_objects import cut, test_objects
from experiments.comparison.view_scores import mean
from spnr_jax.config import Quality
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError, require, require_at_least
from spnr_jax.formats import data_sets, images
from spnr_jax.formats.data_sets import ObjectData
from spnr_jax.kernels.imaging import srgb_to_linear
from spnr_jax.kernels.records import SurfelScene
from spnr_jax.method.model import Model
from spnr_jax.scoring.evaluation import Pictures, check_known_light
from spnr_jax.training.weights import load

COLUMNS = {
    "psnr": ("PSNR, dB", 2),
    "psnr_inside": ("inside, dB", 2),
    "flip": ("FLIP", 3),
    "log_error": ("log error", 3),
}
DARK = 1e-3  # linear light below which the logarithm is not taken
GALLERY = 8  # objects in the gallery
NETWORK, DISCS, UNSHADOWED = "network", "discs and light", "discs and light, nothing hides anything"
METHODS: dict[str, Quality] = {NETWORK: "best", DISCS: "draft", UNSHADOWED: "draft"}
Found = dict[tuple[str, int], list[dict[str, dict[str, float]]]]  # light, points -> objects: method -> scores


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

    def __post_init__(self) -> None:
        require(bool(self.data), "--data: name at least one data set")
        require_at_least(self, 1, "counts", "resolution", "views", "objects")


def main(options: RelightingStudy) -> None:
    """Draws, scores and writes."""
    model, run = load(options.run), checksums((options.run,))
    found: Found = {}
    columns: dict[str, list[np.ndarray]] = {}
    datasets = [data_sets.open_dataset(folder) for folder in options.data]
    asked = options.objects, max(options.counts), options.resolution
    names, *others = (test_objects(dataset, *asked) for dataset in datasets)
    if any(other != names for other in others):
        raise UserError("--data: expected data sets of the same test objects, these hold others")
    for dataset in datasets:
        check_known_light(model.config, dataset)
        light = name_of(dataset)
        claimed = {"run": run, "views": options.views, "objects": names, "resolution": options.resolution}
        results_folder.claim(options.out / "scores" / light, "relighting", claimed, dataset)
        rows = {f"{light}/{count:,} points": partial(measure, options, model, count) for count in options.counts}
        measured = scores.measure_rows(options.out, rows, dataset, names, names[:GALLERY])
        found |= {(light, count): of for count, of in zip(options.counts, measured.values(), strict=True)}
        row = f"{light}/{max(options.counts):,} points"
        picture = partial(scores.picture_of, options.out, row, rows[row], dataset)
        references = [scores.reference(dataset, name, options.resolution) for name in names[:GALLERY]]
        columns |= {f"{light}: reference": references, f"{light}: ours": [picture(name) for name in names[:GALLERY]]}
    _write(options.out, found)
    cells = list(zip(*columns.values(), strict=True))
    images.write_whole(options.out / "gallery.png", images.png(figures.grid(cells, list(columns), names, 256)))


def name_of(dataset: data_sets.Dataset) -> str:
    """The light of a data set; ValueError if its views have none of their own."""
    if not data_sets.has_lights(dataset):
        raise UserError(f"{dataset.folder}: its views have no light of their own; generate it with --lights")
    kinds = dataset.settings["environment_map"]["kinds"]
    return " and ".join(Path(name).stem for kind in kinds for name in kind.get("sha256", {kind["name"]: None}))


def measure(options: RelightingStudy, model: Model, count: int, item: ObjectData) -> Measured:
    """Mean scores of an object's views, by method, and the network's first picture."""
    item = cut(item, count, options.views, options.resolution)
    lit = model.encode(item.cloud)
    assert isinstance(lit, SurfelScene), "networks of surfels alone take a light"
    found: dict[str, dict] = {}
    drawn: dict[str, Pictures] = {}
    for method, quality in METHODS.items():
        scene = remove_shadows(lit) if method == UNSHADOWED else lit
        pictures = drawn[method] = draw_volume(model, scene, item, quality)
        of_views = scores.score_views(item, pictures) | {"log_error": log_errors(item, pictures)}
        found[method] = scores.mean_scores({name: of_views[name] for name in COLUMNS})
    return found, np.asarray(drawn[NETWORK].image[0])


def remove_shadows(scene: SurfelScene) -> SurfelScene:
    """The scene as if every direction saw every point."""
    surfels = dataclasses.replace(scene.surfels, visibility=jnp.ones_like(scene.surfels.visibility))
    return dataclasses.replace(scene, surfels=surfels)


def log_errors(item: ObjectData, pictures: Pictures) -> list[float]:
    """Root mean square of the logarithm of the ratio of linear light inside, of each view, in nepers, or NaN."""
    found = []
    for image, rgba in zip(pictures.image, item.images, strict=True):
        ours, theirs = (np.log(np.maximum(srgb_to_linear(x), DARK)) for x in (image, data_sets.on_white(rgba)))
        found.append(mean((ours - theirs)[rgba[..., 3] == 255] ** 2) ** 0.5)
    return found


def _write(out: Path, found: Found) -> None:
    """Tables and results.json."""
    rows = {
        f"{light}, {count:,}, {method}": [of[method] for of in objects]
        for (light, count), objects in found.items()
        for method in METHODS
    }
    note = "Means over objects, from five on with 95 % intervals; pictures are never rescaled."
    table = scores.score_table("Relighting", rows, COLUMNS, note)
    results_folder.write(out, {"objects": rows, "hardware": runtime.describe_hardware()}, [table])


if __name__ == "__main__":
    entry_point.run(main, RelightingStudy, "studies.relighting")
