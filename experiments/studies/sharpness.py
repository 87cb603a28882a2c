"""How sharp are pictures at 512 pixels and more, and what do more points bring?

    python -m experiments.studies.sharpness --data DIR --out OUT [--runs surfels small] [--counts 1024 4096 16384 65536]

The networks draw the test objects of a data set (`spnr-data generate --spread even --points 65536 --resolution 512`)
from so many of each object's first points, beside the same discs and light without a network (`draft`), and, if asked
for, trimmed Poisson surfaces in Mitsuba (`--poisson`) and pictures that other programs, Pointersect for one, made of
the same points and cameras (`--elsewhere FOLDER`, its FOLDER/POINTS/ID/000.png, RGBA, a view each).  A ball of one grey
should be smooth, a plate red in front should show no blue.  Two columns are an oracle: the same colours under the
reference's opacity.

    OUT/results.json  OUT/table.md     `scoring/picture_scores.py`, of each network and number of points
    OUT/gallery.png   OUT/ID.png                 references and pictures beside each other, at full size
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from data_gen.store import layout
from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.comparison.object_views import Picture, at, cut, drawn, on_white, told, view_of
from experiments.comparison.poisson import Renderer, trimmed_surface
from spnr_jax.config import Quality
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels import metrics
from spnr_jax.kernels.records import PointCloud
from spnr_jax.method.model import Model
from spnr_jax.methods import method_of
from spnr_jax.scoring.picture_scores import ball, ball_waves, blue_share, flip, plate, sharpness, under_true_opacity
from spnr_jax.scoring.report import Cell, Table, mean_row, number
from spnr_jax.training.weights import load


class Drawn(NamedTuple):
    """Pictures of an object's views, and seconds: to encode it, and of a picture once all is compiled."""

    pictures: list[Picture]
    encode: float | None
    render: float | None


@dataclass(frozen=True)
class Network:
    """A trained network at a quality; `draft` of the one over surfels is discs and light alone."""

    label: str
    model: Model
    quality: Quality

    def draw(self, item: data_sets.ObjectData, resolution: int | None) -> Drawn:
        """The pictures, drawn twice: the second time is measured."""
        self.model.encode(item.cloud)
        begin = perf_counter()
        volume = self.model.encode(item.cloud)
        jax.block_until_ready(jax.tree.leaves(volume.scene))
        encode = perf_counter() - begin
        views = [view_of(item, view, resolution)[0] for view in range(len(item.images))]
        for _ in range(2):
            begin = perf_counter()
            found = drawn(self.model, volume, views, self.quality)
            seconds = (perf_counter() - begin) / len(views)
        size = views[0].height, views[0].width
        return Drawn([(image, resized(opacity, size)) for image, opacity in found], encode, seconds)


@dataclass(frozen=True)
class Poisson:
    """Trimmed Poisson surfaces, path-traced by Mitsuba in the light of the data set."""

    label: str
    renderer: Renderer

    def draw(self, item: data_sets.ObjectData, resolution: int | None) -> Drawn:
        """The pictures; empty ones where the points span no surface."""
        begin = perf_counter()
        asset = trimmed_surface(item.cloud)
        middle = perf_counter()
        rgba = self.renderer.drawn(asset, item) if asset.parts else np.zeros_like(item.images)
        seconds = (perf_counter() - middle) / len(rgba)
        return Drawn([on_white(at(picture, resolution)) for picture in rgba], middle - begin, seconds)


@dataclass(frozen=True)
class Elsewhere:
    """Pictures that another program made of the same points and cameras: FOLDER/POINTS/ID/000.png, a view each."""

    label: str
    folder: Path

    def draw(self, item: data_sets.ObjectData, resolution: int | None) -> Drawn:
        """The pictures, read; UserError for one that is missing or of another size."""
        place, found = self.folder / str(len(item.cloud.positions)) / item.name, []
        for view in range(len(item.images)):
            path = place / f"{view:03d}.png"
            picture = layout.read_image(path)
            if picture.shape != item.images[view].shape:
                raise UserError(
                    f"{path}: {picture.shape}, expected {item.images[view].shape}: RGBA like the references"
                )
            found.append(on_white(at(picture, resolution)))
        return Drawn(found, None, None)


Method = Network | Poisson | Elsewhere


def methods(
    runs: Sequence[str], poisson: bool, folders: Sequence[Path], dataset: data_sets.Dataset
) -> tuple[Method, ...]:
    """The methods of a study by their order in its tables."""
    found: list[Method] = []
    for run in runs:
        model = load(run)
        found.append(Network(run, model, "best"))
        if method_of(model.config).takes_light:
            found.append(Network(f"{run}, discs and light alone", model, "draft"))
    if poisson:
        found.append(Poisson("Poisson, trimmed", Renderer(dataset.settings)))
    return (*found, *(Elsewhere(folder.name, folder) for folder in folders))


def resized(opacity: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An opacity at the size of its picture: the paper's network has it at half of that."""
    return opacity if opacity.shape == size else np.asarray(jax.image.resize(jnp.asarray(opacity), size, "linear"))


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
KNOWN_SIZE = 512  # pixels along each side of ball and plate
KNOWN_HEADS = ("ball: waves", "plate: blue share")


@dataclass(frozen=True, kw_only=True)
class SharpnessStudy:
    """Sharpness of networks at the size that people look at, over the number of points."""

    data: Path
    """Folder of a data set whose points are spread evenly."""
    out: Path
    """Folder of the results; the same command goes on there."""
    runs: tuple[str, ...] = ("surfels",)
    """Networks: `surfels` of the package, run folders or files of weights."""
    counts: tuple[int, ...] = (1024, 4096, 16384, 65536)
    """Points of an object, the first of its file."""
    resolution: int | None = None
    """Pixels along each side: those of the data set, or a whole share of them (default: theirs)."""
    views: int = 4
    """Views of an object."""
    objects: int | None = None
    """Test objects (default: all)."""
    poisson: bool = False
    """Trimmed Poisson surfaces of the same points, path-traced by Mitsuba, too."""
    elsewhere: tuple[Path, ...] = ()
    """Folders of pictures that other programs made."""
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
    compared = methods(options.runs, options.poisson, options.elsewhere, dataset)
    rows, known = {}, {}
    for method in compared:
        for count in options.counts:
            row = f"{method.label}, {count:,}"
            rows[row] = [
                _kept_scores(options, dataset, name, method, count) for name in tqdm(names, desc=f"{row} points")
            ]
            known[row] = _known(options, method, count)
    _pictures(options, dataset, compared, options.shown or names[:4])
    table = Table(
        title=f"Sharpness, {len(names)} objects x {options.views} views",
        heads=(*HEADS, *KNOWN_HEADS),
        rows=tuple(_row(name, found, known[name]) for name, found in rows.items()),
        note="Means over objects with 95 % intervals; a true plate shows a blue share of .077.",
    )
    results_folder.write(options.out, {"objects": rows, "known": known, "hardware": runtime.hardware()}, [table])


def _kept_scores(
    options: SharpnessStudy, dataset: data_sets.Dataset, name: str, method: Method, count: int
) -> dict[str, float | None]:
    """Mean scores of an object's views, seconds to encode it and to draw one."""

    def make() -> dict[str, float | None]:
        item = cut(data_sets.read_object(dataset, name), count, options.views, options.normals)
        drawn = method.draw(item, options.resolution)
        scores = [
            all_scores(*picture, view_of(item, view, options.resolution)[1])
            for view, picture in enumerate(drawn.pictures)
        ]
        means = {column: _mean(np.array([of[column] for of in scores])) for column in COLUMNS}
        return means | {"encode": drawn.encode, "render": drawn.render}

    return results_folder.kept(options.out / "scores" / _folder(method) / f"{name}_{count}.json", make)


def _folder(method: Method) -> str:
    return method.label.replace("/", "_")


def _mean(values: np.ndarray) -> float | None:
    """The mean of the numbers among them."""
    numbers = values[~np.isnan(values)]
    return float(numbers.mean()) if len(numbers) else None


def all_scores(image: np.ndarray, opacity: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """The scores of a picture by the names in COLUMNS."""
    white = on_white(reference)[0]
    oracle = sharpness(under_true_opacity(image, opacity, reference), reference[..., 3], reference)
    return sharpness(image, opacity, reference)._asdict() | {
        "ssim": float(metrics.ssim(jnp.asarray(image), jnp.asarray(white))),
        "flip": float(flip(image, white)),
        "psnr_true_opacity": oracle.psnr,
        "inside_true_opacity": oracle.psnr_inside,
    }


def _known(options: SharpnessStudy, method: Method, count: int) -> dict[str, float | None]:
    """Scores of the ball and the plate, of networks."""
    if not isinstance(method, Network):
        return {}

    def of(cloud: PointCloud, score: Any, **view: float) -> float | None:
        model = method.model
        volume = model.encode(told(cloud, options.normals))
        rendering = model.render(volume, model.camera(volume, resolution=KNOWN_SIZE, **view), method.quality)
        image = np.asarray(rendering.image)
        return _mean(np.array([score(image, resized(np.asarray(rendering.acc), image.shape[:2]))]))

    def make() -> dict[str, float | None]:
        front = {"azimuth": 0.0, "elevation": 0.0}
        return {"ball": of(ball(count), ball_waves), "plate": of(plate(count), blue_share, **front)}

    return results_folder.kept(options.out / "known" / _folder(method) / f"{count}.json", make)


def _row(
    name: str, found: Sequence[Mapping[str, float | None]], known: Mapping[str, float | None]
) -> tuple[str, tuple[Cell, ...]]:
    columns = COLUMNS.items()
    _, cells = mean_row(name, [[of[column] for column, _ in columns] for of in found], [n for _, (_, n) in columns])
    seconds = ([x for of in found if (x := of[what]) is not None] for what in ("encode", "render"))
    times = (number(float(np.median(taken)) if taken else None, 2) for taken in seconds)
    return name, (*cells, *times, number(known.get("ball"), 4), number(known.get("plate"), 3))


def _pictures(
    options: SharpnessStudy, dataset: data_sets.Dataset, compared: Sequence[Method], names: Sequence[str]
) -> None:
    """A sheet of each shown object at full size, and one of all, smaller."""
    cells = []
    heads = ["reference", *(f"{method.label}, {count:,} points" for method in compared for count in options.counts)]
    for name in names:
        item = data_sets.read_object(dataset, name)
        row = [
            method.draw(cut(item, count, 1, options.normals), options.resolution).pictures[0][0]
            for method in compared
            for count in options.counts
        ]
        cells.append([on_white(view_of(item, 0, options.resolution)[1])[0], *row])
        full = figures.grid([cells[-1]], heads, size=cells[-1][0].shape[0])
        images.write_whole(options.out / f"{name}.png", images.png(full))
    images.write_whole(options.out / "gallery.png", images.png(figures.grid(cells, heads, names, size=192)))


if __name__ == "__main__":
    entry_point.run(main, SharpnessStudy, "studies.sharpness")
