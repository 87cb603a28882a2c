"""One camera, and the light goes around: how well do pictures follow?  And one object under eight lights.

    python -m experiments.studies.relighting_turns --data DIR --meshes MESHES --out OUT \\
        --lights venice_sunset_1k.hdr studio_small_03_1k.hdr room studio sunset night [--turning 2] [--shown NAME]

References are made by Mitsuba as those of the data set, under other maps: files, or names of the package's lights,
normalised as those of lit data sets.  Rows are those of `relighting.py`.

    OUT/results.json  OUT/table.md .csv .tex     dB inside over the turn, the worst step, how steps tell the change
    OUT/gallery.png                              one object under the lights, references above ours
    OUT/film.gif                                 the first light goes around it
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from data_gen.render import light
from experiments import entry_point
from experiments.comparison import figures, relit, results_folder, source_meshes
from experiments.comparison.object_views import Picture, on_white, told, view_of
from experiments.studies.relighting import METHODS, NETWORK, correlation, draw, log_light
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets, images
from spnr_jax.formats.light_files import read_envmap
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Volume
from spnr_jax.method.model import Model
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.picture_scores import sharpness
from spnr_jax.scoring.score_tables import Table, mean_row
from spnr_jax.surfels import envmaps, skies
from spnr_jax.surfels.lighting import light_of
from spnr_jax.training.weights import load

HEADS = ("inside, dB", "best step", "worst step", "change: correlation")
FPS = 10


@dataclass(frozen=True, kw_only=True)
class TurnsStudy:
    """A light that goes around objects, one camera each."""

    data: Path
    """Folder of a data set; its lights do not matter."""
    out: Path
    """Folder of the results; the same command goes on there."""
    lights: tuple[str, ...]
    """Maps (.hdr, .exr) or names of the package's lights, for the gallery; the first goes around in the film."""
    turning: int = 2
    """How many of them, the first, go around in the table."""
    meshes: Path | None = None
    """Folder of the mesh files that the data set was made from, if it was."""
    run: str = "surfels"
    """Network: of the package, a run folder or a file of weights."""
    count: int = 16384
    """Points of an object, the first of its file."""
    objects: int = 4
    """Test objects whose light goes around, spread over the list."""
    steps: int = 8
    """Steps of the turn."""
    resolution: int = 128
    """Pixels along each side of the pictures in the table."""
    shown: str | None = None
    """Object of gallery and film (default: the first)."""
    view: int = 0
    """View of every object."""
    size: int = 192
    """Pixels along each side in gallery and film."""
    frames: int = 24
    """Frames of the film."""
    spp: int = 64
    """Samples a pixel of the references."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """An object before its camera."""

    name: str
    camera: Camera
    mesh: Asset
    volume: Volume


def main(options: TurnsStudy) -> None:
    """Draws, scores and writes."""
    relit.prepare()
    dataset, model = data_sets.open_dataset(options.data), load(options.run)
    asked = {name: getattr(options, name) for name in ("run", "count", "steps", "resolution", "view", "spp")}
    results_folder.claim(options.out, "turned lights", asked, dataset)
    maps = {Path(name).stem: read_map(name) for name in options.lights}
    names = evaluation.spread(dataset.splits["test"], options.objects)
    rows: dict[str, list[list[float]]] = {}
    for name in tqdm(names, desc="objects"):
        subject = cache(partial(_subject, options, dataset, name, model))
        for label, envmap in list(maps.items())[: options.turning]:
            place = options.out / "scores" / label / f"{name}.json"
            make = partial(_turned, options, dataset, model, subject, envmap)
            kept = results_folder.kept(place, make)
            for method, row in kept.items():
                rows.setdefault(f"{label}, {method}", []).append(row)
    table = Table(
        title=f"Turned lights, {options.resolution} pixels",
        heads=HEADS,
        rows=tuple(mean_row(label, values, (2, 2, 2, 3)) for label, values in rows.items()),
        note=f"{options.steps} steps around; means over objects with 95 % intervals.",
    )
    results_folder.write(options.out, {"objects": rows, "names": names, "hardware": machine.hardware()}, [table])
    _pictures(options, dataset, model, maps)


def read_map(name: str) -> np.ndarray:
    """A map of a file, or of the package by its name, of the size and brightness of those of lit data sets."""
    named = name in skies.NAMED
    drawn = (
        skies.NAMED[name](light.DRAWN_HEIGHT)
        if named
        else envmaps.resampled(read_envmap(Path(name)), light.DRAWN_HEIGHT)
    )
    return skies.normalised(drawn, light.WHITE_SPHERE_RADIANCE)


def around(envmap: np.ndarray, steps: int) -> list[np.ndarray]:
    """The map turned once around in so many steps."""
    return [relit.turned(envmap, 360 * step / steps) for step in range(steps)]


def _subject(options: TurnsStudy, dataset: data_sets.Dataset, name: str, model: Model) -> Subject:
    item = data_sets.read_object(dataset, name)
    return Subject(
        name=name,
        camera=view_of(item, options.view, None)[0],
        mesh=source_meshes.mesh_of(dataset, item, options.meshes),
        volume=model.encode(told(data_sets.first_points(item, options.count), normals=False)),
    )


def _references(
    options: TurnsStudy, dataset: data_sets.Dataset, subject: Subject, maps: Sequence[np.ndarray], size: int
) -> list[np.ndarray]:
    """Straight-alpha pictures (size, size, 4) of the true mesh under maps."""
    poses = [np.asarray(subject.camera.cam_to_world)] * len(maps)
    return relit.pictures(subject.mesh, poses, maps, relit.view_config(dataset, options.spp, size))


def _drawn(model: Model, subject: Subject, method: str, maps: Sequence[np.ndarray], size: int) -> list[Picture]:
    """What a method shows under maps."""
    camera = cameras.resize(subject.camera, size, size)
    return draw(model, subject.volume, method, [camera] * len(maps), [light_of(envmap) for envmap in maps])


def _turned(
    options: TurnsStudy, dataset: data_sets.Dataset, model: Model, subject_of: Callable[[], Subject], envmap: np.ndarray
) -> dict[str, list[float]]:
    """Decibels inside (mean, best, worst step) and the correlation of changes, by method."""
    subject, maps = subject_of(), around(envmap, options.steps)
    references = _references(options, dataset, subject, maps, options.resolution)
    rows = {}
    for method in METHODS:
        drawn = _drawn(model, subject, method, maps, options.resolution)
        inside = [sharpness(*x, y).psnr_inside for x, y in zip(drawn, references, strict=True)]
        rows[method] = [
            float(np.mean(inside)),
            max(inside),
            min(inside),
            change_score([x for x, _ in drawn], references),
        ]
    return rows


def change_score(drawn: Sequence[np.ndarray], references: Sequence[np.ndarray]) -> float:
    """Correlation, over pixels inside and steps, of the change of log light from a step to the next; 0 of none."""
    solid = np.min([x[..., 3] for x in references], axis=0) > 0.999

    def changes(pictures: Sequence[np.ndarray]) -> np.ndarray:
        logs = [log_light(x, solid) for x in pictures]
        return np.concatenate([after - before for before, after in zip(logs, logs[1:] + logs[:1], strict=True)])

    return correlation(changes(drawn), changes(references))


def _pictures(options: TurnsStudy, dataset: data_sets.Dataset, model: Model, maps: Mapping[str, np.ndarray]) -> None:
    """The gallery and the film, of the network."""
    subject = _subject(options, dataset, options.shown or dataset.splits["test"][0], model)

    def both(shown: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
        references = _references(options, dataset, subject, shown, options.size)
        drawn = _drawn(model, subject, NETWORK, shown, options.size)
        return [[on_white(x)[0] for x in references], [x for x, _ in drawn]]

    sheet = figures.grid(both(list(maps.values())), list(maps), ["reference", "ours"], size=options.size)
    images.write_whole(options.out / "gallery.png", images.png(sheet))
    pairs = zip(*both(around(next(iter(maps.values())), options.frames)), strict=True)
    film = [figures.grid([pair], ["reference", f"ours, {options.count:,} points"], size=options.size) for pair in pairs]
    images.write_turntable(options.out / "film.gif", film, FPS)


if __name__ == "__main__":
    entry_point.run(main, TurnsStudy, "studies.relighting_turns")
