"""What speed costs in quality: networks asked for pictures in many ways, and which of these nothing beats.

    python -m experiments.studies.speed_accuracy DATA [surfels small poisson_trimmed RUN ...] [--sizes 128 512]

Each network draws test objects at every level of `--quality`, from other numbers of points, and in pictures of fewer
pixels that are enlarged.  Networks of rays also draw with other samples, in all of the box and near the points, and in
bfloat16.  `draft` of the network over surfels is discs and light alone.  What a network with an upsampler draws at the
one size that it has learnt is enlarged (or averaged).  Screened Poisson surfaces are drawn by Mitsuba as the references
were.  Keeps every setting in a file of its own (an interrupted call goes on); writes the tables and front.png.

ms a view   median over objects of the fastest of several drawings of all views, as of a film, the cloud encoded before;
            on a CPU of the processor, all cores together: other work on the machine does not count
s to encode the same for a cloud, once, all compiled
MB          of memory at most above what was held before the picture, the largest over objects
front       settings of a size that no other beats in both PSNR and ms a view; its knee lies farthest above the line
            from its cheapest to its best, PSNR against the logarithm of the time
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from data_gen.render import poisson_surface
from experiments import entry_point
from experiments.comparison import clock, poisson, results_folder
from experiments.comparison.object_views import few, on_white, told, view_of
from experiments.comparison.peak_memory import forget_peak, peak_mb
from experiments.comparison.trained_networks import test_objects
from experiments.studies.speed_accuracy_plot import plot
from experiments.studies.speed_accuracy_report import both, front, knee
from experiments.studies.speed_accuracy_settings import Setting, settings
from spnr_jax import cli
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.kernels import cameras, metrics
from spnr_jax.kernels.records import Camera, Rendering, Volume
from spnr_jax.method.model import Model, Quality
from spnr_jax.scoring.perceptual import flip
from spnr_jax.training.weights import load

Result = TypeVar("Result")
Scores = dict[str, float]
Volumes = dict[tuple[str, int, str], tuple[Volume, float]]  # of object, points, precision: encoded, in so many ms
REPEATS = 2
TIMED_OBJECTS = 4


@dataclass(frozen=True, kw_only=True)
class SpeedAccuracy:
    """Draw with trained networks in many ways, and show quality against cost."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set; its test objects are drawn."""
    runs: tyro.conf.Positional[tuple[str, ...]] = ("surfels", "small")
    """Networks: of the package, run folders (the paper's, published methods) or files of weights; also `poisson` and
    `poisson_trimmed`."""
    out: Path = Path("runs/speed_accuracy")
    """Folder of the results."""
    sizes: tuple[int, ...] = (512, 128)
    """Pixels along each side of the pictures that are looked at: those of the data set, or a whole share of them."""
    counts: tuple[int, ...] = (16384, 1024, 4096, 65536)
    """Points of an object, the first of its file; all settings with the first number, `best` and `draft` with more."""
    objects: int = 8
    """Test objects, evenly out of the split."""
    views: int = 2
    """Views of an object."""
    quick: bool = False
    """A few settings of each network, for a test."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A surface through so many points (`comparison/poisson.py`)."""

    kind: str
    name: str
    points: int
    group: str = "surface"


@dataclass(frozen=True, kw_only=True)
class Job:
    """A setting at a size, and what measures it."""

    number_of_run: int
    run: str
    size: int
    way: Setting | Surface
    make: Callable[[], Scores]

    def row(self) -> dict[str, Any]:
        """What tables and plots call it."""
        return {"run": self.run, "size": self.size, "group": self.way.group, "name": self.way.name}

    def kept(self, out: Path) -> Scores:
        """What was measured; it is measured if it was not."""
        name = f"{self.number_of_run} {self.size} {self.way.points} {self.way.name}.json"
        return results_folder.kept(out / "settings" / name, self.make)


@dataclass
class Drawn:
    """What was measured of one setting, object by object."""

    scores: list[dict[str, float]] = field(default_factory=list)
    view_ms: list[float] = field(default_factory=list)
    encode_s: list[float] = field(default_factory=list)
    mb: list[int] = field(default_factory=list)

    def means(self) -> Scores:
        """Means of the scores, medians of the times, the most memory."""
        found = {name: float(np.mean([of[name] for of in self.scores])) for name in self.scores[0]}
        found |= {"ms_view": float(np.median(self.view_ms)), "s_encode": float(np.median(self.encode_s))}
        return {name: round(value, 4) for name, value in (found | {"mb": max(self.mb)}).items()}


def main(options: SpeedAccuracy) -> None:
    """Measures the settings that are not measured, then writes the tables and the plot."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = test_objects(dataset, options.objects)
    asked = {"objects": list(names), "views": options.views, "runs": list(options.runs)}
    results_folder.claim(options.out, "speed_accuracy", asked, dataset)
    numbers = range(len(options.runs))
    jobs = [job for number_of_run in numbers for job in jobs_of(number_of_run, options, dataset, names)]
    for job in sorted(jobs, key=lambda job: job.way.group not in ("level", "surface")):  # the most telling ones first
        scores, what = job.kept(options.out), f"{job.run}, {job.size} px, {job.way.name}"
        print(f"{what}: {scores['psnr']:.2f} dB, {scores['ms_view']:.1f} ms", flush=True)
    rows = [job.row() | job.kept(options.out) for job in jobs]
    found = {"hardware": machine.hardware(), "load": machine.load(), "date": time.strftime("%Y-%m-%d"), "rows": rows}
    tables = [made for size in options.sizes if (of := [r for r in rows if r["size"] == size]) for made in both(of)]
    fronts = [[r for r in rows if r["size"] == size] for size in options.sizes]
    picture = plot([(of, front(of), knee(of, front(of))) for of in fronts if of])
    note = f"{len(names)} objects x {options.views} views, {options.counts[0]:,} points where nothing else is said."
    notes = [note, f"{found['hardware']}, load {found['load']}, {found['date']}."]
    results_folder.write(options.out, found, tables, notes, {"front.png": picture})


def jobs_of(number_of_run: int, options: SpeedAccuracy, dataset: data_sets.Dataset, names: Sequence[str]) -> list[Job]:
    """All settings of a network or a surface at all sizes."""
    run = options.runs[number_of_run]
    seen: dict[str, Any] = {"dataset": dataset, "names": names, "views": options.views}
    counts = options.counts[:1] if options.quick else options.counts
    made: list[tuple[Setting | Surface, Callable[..., Scores]]]
    if run in poisson.SURFACES:
        surfaces = [Surface(kind=run, points=count, name=f"{count:,} points") for count in counts]
        made = [(surface, partial(measure_surface, surface, **seen)) for surface in surfaces]
    else:
        model, volumes = load(run), Volumes({})
        ways = settings(model.config, options.counts)
        ways = ways[:: max(len(ways) // 3, 1)] if options.quick else ways
        made = [(way, partial(measure, model, way, volumes=volumes, **seen)) for way in ways]
    return [
        Job(number_of_run=number_of_run, run=run, size=size, way=way, make=partial(one, size=size))
        for size in options.sizes
        for way, one in made
    ]


def measure(
    model: Model,
    way: Setting,
    dataset: data_sets.Dataset,
    names: Sequence[str],
    views: int,
    volumes: Volumes,
    size: int,
) -> Scores:
    """Mean scores over the objects' pictures, times and memory of one setting at one size."""
    model, found = dataclasses.replace(model, config=way.config), Drawn()
    for number_of_object, name in enumerate(names):
        item = data_sets.read_object(dataset, name)
        cloud = told(data_sets.first_points(item, way.points), normals=False)
        key = name, way.points, getattr(way.config, "precision", "")
        if key not in volumes:  # samples and sizes share it
            model.encode(cloud)
            volumes[key] = timed(partial(model.encode, cloud))
        volume, ms = volumes[key]
        pairs = [view_of(item, view, size) for view in range(min(views, len(item.images)))]
        drawn = max(round(way.share * size / 4) * 4, 16) if way.config.any_size else way.config.image_resolution
        asked = [cameras.resize(camera, drawn, drawn) if drawn != size else camera for camera, _ in pairs]
        film = partial(_film, model, volume, asked, way.quality)
        for rendering, (_, reference) in zip(film(), pairs, strict=True):
            found.scores.append(_scores(np.asarray(rendering.image), np.asarray(rendering.acc), reference))
        found.encode_s.append(ms / 1e3)
        if number_of_object < TIMED_OBJECTS:
            _time_views(found, film)
    return found.means()


def measure_surface(
    surface: Surface, dataset: data_sets.Dataset, names: Sequence[str], views: int, size: int
) -> Scores:
    """The same of a surface through the points, drawn by Mitsuba as the references were; loading it is in its time."""
    described = dataset.settings | {"settings": dataset.settings["settings"] | {"resolution": size}}
    renderer, found = poisson.Renderer(described), Drawn()
    for name in names:
        item = data_sets.read_object(dataset, name)
        cloud = jax.tree.map(lambda x: np.asarray(x)[: surface.points], item.cloud)
        pairs = [view_of(item, view, size) for view in range(min(views, len(item.images)))]
        asset, ms = timed(partial(poisson_surface.reconstruct, cloud, poisson.SURFACES[surface.kind]))
        found.encode_s.append(ms / 1e3)
        forget_peak()
        before = peak_mb()
        pictures, ms = timed(partial(renderer.drawn, asset, few(item, views)))
        found.view_ms.append(ms / len(pairs))
        found.mb.append(peak_mb() - before)
        for picture, (_, reference) in zip(pictures, pairs, strict=True):
            found.scores.append(_scores(data_sets.on_white(picture), picture[..., 3] / 255, reference))
    return found.means()


def _scores(image: np.ndarray, opacity: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Of a picture, enlarged to its reference (RGBA) where it is smaller."""
    shape = reference.shape[:2]
    image = np.clip(np.asarray(jax.image.resize(image, (*shape, 3), "cubic")), 0, 1)
    opacity = np.asarray(jax.image.resize(opacity, shape, "linear"))
    white = on_white(reference)[0]
    return {
        "psnr": float(metrics.psnr(jnp.asarray(image), jnp.asarray(white))),
        "ssim": float(metrics.ssim(jnp.asarray(image), jnp.asarray(white))),
        "flip": float(flip(image, white)),
        "iou": float(metrics.opacity_iou(jnp.asarray(opacity), jnp.asarray(reference[..., 3]))),
    }


def _film(model: Model, volume: Volume, views: Sequence[Camera], quality: Quality) -> list[Rendering]:
    return list(model.render_each(volume, views, quality))


def _time_views(found: Drawn, draw: Callable[[], list[Rendering]]) -> None:
    """Adds time and memory of a view of those that are drawn, which were drawn before."""
    taken = []
    for _ in range(REPEATS):
        views, ms = timed(draw)
        taken.append(ms / len(views))
    found.view_ms.append(min(taken))
    forget_peak()
    before = peak_mb()
    jax.block_until_ready(draw())
    found.mb.append(peak_mb() - before)


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """What the work gives, and its milliseconds: of the processor, where that is what computes."""
    start = clock.now()
    result = jax.block_until_ready(work())
    return result, 1000 * (clock.now() - start)


if __name__ == "__main__":
    entry_point.run(main, SpeedAccuracy, "studies.speed_accuracy")
