"""How well does the network draw an object in a light that it never saw?

    python -m experiments.studies.relighting --data ROOM VENICE STUDIO --out OUT --maps MAPS --meshes MESHES
        [--run surfels] [--fixed RUN] [--counts 1024 16384] [--sizes 128 512] [--methods network splats ...]

Each data set holds the same objects, under one kind of light that is turned for every view and kept beside it
(`spnr-data generate --lights FOLDER_OF_ONE_MAP`), or in the one room.  Beside the network (`relighting_methods.py`):
disc splats under split-sum shading, Poisson surfaces in Mitsuba, the true mesh with less than light transport (an
oracle).  Nothing is rescaled to the reference.  Without --maps, the folder of the map files, Mitsuba is left out, and
so is all that needs new references: shadows, turned lights, gallery, film.

    OUT/results.json  OUT/table.md .csv .tex   a table a size, of each light; margins; shadows; turned lights
    OUT/LIGHT.png                              objects: reference and methods
    OUT/gallery.png                            one object under eight lights, references above ours
    OUT/film.gif                               the light goes around it

Every number is kept in OUT/scores, so the same command goes on where it was stopped, and rows are made one by one
(`--methods`).  Rows of a network are kept by its weights; remove OUT/*/*/splats* when the code of discs changes.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.comparison.light_scores import OnWhite, change_scores, on_white, reduced, scores, shadow_scores
from experiments.comparison.relit import Mitsuba
from experiments.studies import relighting_report
from experiments.studies.relighting_gallery import Show
from experiments.studies.relighting_methods import LitObject, Method, by_mitsuba, ours, references
from experiments.studies.sharpness import view_of
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets, images
from spnr_jax.method.model import Model
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.picture_scores import sharpness
from spnr_jax.training.weights import load


@dataclass(frozen=True, kw_only=True)
class RelightingStudy:
    """Pictures of objects in lights, scored against references in the same lights."""

    data: tuple[Path, ...]
    """Data sets of the same objects, one for each kind of light."""
    out: Path
    """Folder of the results; the same command goes on there."""
    run: str = "surfels"
    """Network: of the package, a run folder or a file of weights."""
    fixed: str | None = None
    """A network that draws in the light of its training whatever is asked: its row stands beside (default: none)."""
    maps: Path | None = None
    """Folder of the maps that lit the data sets (default: without Mitsuba)."""
    meshes: Path | None = None
    """Folder of the mesh files that the data sets were made from, if they were."""
    counts: tuple[int, ...] = (1024, 16384)
    """Points of an object, the first of its file."""
    sizes: tuple[int, ...] = (128, 512)
    """Pixels along each side: those of the data sets, or a whole share of them."""
    views: int = 4
    """Views of an object in each light."""
    objects: int | None = None
    """Test objects (default: all)."""
    methods: tuple[str, ...] = ()
    """Rows: network fixed splats splats_occlusion splats_directions poisson unshadowed occlusion (default: all)."""
    spp: int = 16
    """Samples a pixel of Mitsuba's rows at the size of the data sets; smaller pictures have as many as those."""
    turned: int = 4
    """Objects whose light is turned."""
    steps: int = 8
    """Steps of the turned light."""
    shown: str | None = None
    """Object of gallery and film (default: the first)."""
    frames: int = 36
    """Frames of the film; 0 makes none."""


@dataclass(frozen=True)
class Study:
    """What is made once for all rows."""

    options: RelightingStudy
    mitsuba: Mitsuba | None
    methods: dict[str, Method]

    @cached_property
    def datasets(self) -> dict[str, data_sets.Dataset]:
        """By the name of their light."""
        found = {name_of(dataset): dataset for dataset in map(data_sets.open_dataset, self.options.data)}
        if len(found) < len(self.options.data):
            raise UserError("--data: two data sets have the same light")
        return found

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Test objects that every data set has."""
        first, *others = (dataset.splits["test"] for dataset in self.datasets.values())
        shared = [name for name in first if all(name in other for other in others)]
        if not shared:
            raise UserError("--data: the data sets share no test object; generate them of the same objects")
        return tuple(shared[: self.options.objects])

    def rows(self) -> list[tuple[str, int]]:
        """Names of methods and numbers of points; 0 for those that take none."""
        counts = self.options.counts
        return [(name, n) for name, method in self.methods.items() for n in (counts if method.of_points else (0,))]

    def place(self, kind: str, light: str, method: str, count: int, name: str) -> Path:
        """Where the scores of an object lie."""
        return self.options.out / kind / light / self.methods[method].folder / f"{name}_{count}.json"

    def scored(self, lit: LitObject, light: str, method: str, count: int) -> list[dict[str, list[float]]]:
        """Scores of each view: by size, and of its shadows."""
        place = self.place("scores", light, method, count, lit.name)
        there = json.loads(place.read_text()) if place.is_file() else []
        views = range(len(there), min(self.options.views, len(lit.item.images)))
        if views:
            there += _scored(self, lit, light, self.methods[method], count, views, place.with_suffix(".png"))
            images.write_whole(place, (json.dumps(there, indent=1) + "\n").encode())
        return there[: self.options.views]

    def turned(self, lit: LitObject, light: str, method: str, count: int) -> dict[str, list[float]]:
        """Decibels inside of each step of the turned light, and scores of the change from step to step."""
        place = self.place("turns", light, method, count, lit.name)
        return results_folder.kept(place, lambda: _turned(self, lit, light, self.methods[method], count))

    def reference(self, lit: LitObject, light: str, kind: str, make: Callable[[], np.ndarray]) -> np.ndarray:
        """References that the data set does not hold, kept."""
        place = self.options.out / "references" / light / f"{lit.name}_{kind}.npz"
        (found,) = results_folder.kept(place, lambda: (make(),))
        return found.astype(np.float32) / 255


def main(options: RelightingStudy) -> None:
    """Draws, scores and writes."""
    mitsuba = Mitsuba(options.meshes, options.maps, options.spp) if options.maps else None
    model = load(options.run)
    methods = ours(model, load(options.fixed) if options.fixed else None)
    methods |= by_mitsuba(mitsuba) if mitsuba else {}
    if unknown := [name for name in options.methods if name not in methods]:
        raise UserError(f"--methods: no {unknown[0]} here, choose of {', '.join(methods)}; Mitsuba's need --maps")
    study = Study(options, mitsuba, {name: methods[name] for name in options.methods or methods})
    for light, dataset in study.datasets.items():
        asked = {"sizes": list(options.sizes), "spp": options.spp, "steps": options.steps}
        results_folder.claim(options.out / "scores" / light, "relighting", asked, dataset)
    found, turns = _all(study)
    labels = {name: method.label for name, method in study.methods.items()}
    relighting_report.write(options.out, found, turns, labels, options.sizes)
    _pictures(study, model)


def _all(study: Study) -> tuple[relighting_report.Found, relighting_report.Found]:
    """Scores of every light, method and number of points, an object each; the same of turned lights."""
    found, turns, options = {}, {}, study.options
    around = evaluation.spread(study.names, options.turned) if study.mitsuba else ()
    for name in tqdm(study.names, desc="objects"):  # the data sets inside: they share the object's meshes
        for light, dataset in study.datasets.items():
            lit = LitObject(dataset, name, study.mitsuba)
            _check_sizes(lit, options.sizes)
            for row in study.rows():
                found.setdefault((light, *row), []).append(study.scored(lit, light, *row))
                if name in around and row[1] in (0, max(options.counts)):
                    turns.setdefault((light, *row), []).append(study.turned(lit, light, *row))
    return found, turns


def _pictures(study: Study, model: Model) -> None:
    """Sheets of objects by light; the gallery and the film if Mitsuba draws their references."""
    options, most = study.options, max(study.options.counts)
    rows = [(name, count) for name, count in study.rows() if count in (0, most)]
    for light, dataset in study.datasets.items():
        cells = []
        for name in study.names[: relighting_report.ROWS]:
            white = on_white(view_of(data_sets.read_object(dataset, name), 0, max(options.sizes))[1]).image
            kept = [study.place("scores", light, method, count, name) for method, count in rows]
            cells.append([white, *(np.asarray(Image.open(place.with_suffix(".png"))) for place in kept)])
        heads = ["reference", *(study.methods[method].label for method, _ in rows)]
        sheet = figures.grid(cells, heads, study.names[: len(cells)], size=relighting_report.SIZE)
        images.write_whole(options.out / f"{light}.png", images.png(sheet))
    if study.mitsuba and "network" in study.methods:
        lit = LitObject(next(iter(study.datasets.values())), options.shown or study.names[0], study.mitsuba)
        others = [LitObject(dataset, lit.name, study.mitsuba) for dataset in study.datasets.values()]
        show = Show(lit=lit, model=model, count=most, out=options.out)
        show.gallery(dict(zip(study.datasets, others, strict=True)))
        if options.frames:
            show.film(options.frames)


def name_of(dataset: data_sets.Dataset) -> str:
    """The light of a data set: of each view its own, or the room; ValueError if it is another one for all."""
    described = dataset.settings.get("environment_map") or {}
    if data_sets.has_lights(dataset):
        kinds = described["kinds"]
        return "_and_".join(Path(name).stem for kind in kinds for name in kind.get("sha256", {kind["name"]: None}))
    if described and described.get("sha256") is None:
        return "room"
    raise UserError(f"{dataset.folder}: its views have no light of their own; generate it with --lights")


def _check_sizes(lit: LitObject, sizes: Sequence[int]) -> None:
    side = lit.item.camera.height
    if wrong := [size for size in sizes if size < 1 or side % size]:
        raise UserError(f"--sizes {wrong[0]}: expected a whole share of the {side} pixels of {lit.dataset.folder}")


def _scored(
    study: Study, lit: LitObject, light: str, method: Method, count: int, views: range, picture: Path
) -> list[dict[str, list[float]]]:
    """The scores of some views; the first view's largest picture is kept beside them."""
    drawn = _drawn(study, lit, method, count, views)
    if views[0] == 0:
        images.write_whole(picture, images.png(drawn[max(drawn)][0].image))
    small = min(study.options.sizes)
    bare: list[OnWhite] = []
    if study.mitsuba and method.has_shadows:
        bare = method.draw(lit, count, lit.shots(views, small), False)
    found = []
    for i, view in enumerate(views):
        row = {str(size): scores(of[i], view_of(lit.item, view, size)[1]) for size, of in drawn.items()}
        if bare:
            pair = on_white(_bare(study, lit, light, view, small)), on_white(view_of(lit.item, view, small)[1])
            row["shadows"] = shadow_scores((bare[i], drawn[small][i]), pair)
        found.append(row)
    return found


def _drawn(study: Study, lit: LitObject, method: Method, count: int, views: range) -> dict[int, list[OnWhite]]:
    """Pictures of views by their size.  Mitsuba's are made smaller as the references are."""
    sizes = study.options.sizes
    if not method.by_mitsuba:
        return {size: method.draw(lit, count, lit.shots(views, size), True) for size in sizes}
    large = method.draw(lit, count, lit.shots(views, max(sizes)), True)
    return {size: [reduced(picture, size) for picture in large] for size in sizes}


def _bare(study: Study, lit: LitObject, light: str, view: int, size: int) -> np.ndarray:
    """The reference of a view as if nothing hid anything."""
    return study.reference(
        lit, light, f"bare_{view}", lambda: references(lit, lit.shots([view], size), "unshadowed")[0]
    )


def _turned(study: Study, lit: LitObject, light: str, method: Method, count: int) -> dict[str, list[float]]:
    """Scores of one object under the turned light, at the smallest size."""
    shots = lit.turning(study.options.steps, min(study.options.sizes))
    true = study.reference(lit, light, "turned", lambda: references(lit, shots))
    found = method.draw(lit, count, shots, True)
    white = [on_white(rgba) for rgba in true]
    inside = [sharpness(*picture, rgba).psnr_inside for picture, rgba in zip(found, true, strict=True)]
    # the first follows the last
    changes = [change_scores((found[i - 1], found[i]), (white[i - 1], white[i])) for i in range(len(found))]
    return {"inside": inside, "change": [relighting_report.mean(column) for column in zip(*changes, strict=True)]}


if __name__ == "__main__":
    entry_point.run(main, RelightingStudy, "studies.relighting")
