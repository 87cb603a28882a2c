"""Figures 4 to 21: more than a hundred unseen objects as contact sheets, one for each method, all of the same layout.

    python -m experiments.paper.figs4_21 --data DIR --out DIR --runs RUN ... [--table1 DIR]

One view of each object; the numbers of objects and views are options.  Poisson surfaces are those that
experiments.paper.table1 has rendered, where --table1 names its folder.

    OUT/reference_1.png ours_1.png ...   sheets of so many rows and columns, page by page
    OUT/side_by_side.png                 a few objects spread over all, a row for each method
    OUT/gallery.html                     every object with all methods side by side, in one file
    OUT/pictures/METHOD/ID.png           each picture; what is there is kept, so a stopped call goes on
    OUT/results.json                     PSNR of every picture, and the conditions
"""

import re
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import jax
import numpy as np
import tyro

from data_gen.store import layout
from experiments import entry_point
from experiments.comparison import figures, page, results_folder, trained_networks
from experiments.comparison.object_scores import Shown
from experiments.comparison.poisson import SURFACES
from experiments.comparison.trained_networks import LABELS, Network, Sources
from spnr_jax import cli
from spnr_jax.devices import machine
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import png, write_whole
from spnr_jax.scoring.report import psnr

REFERENCE = "Reference"


@dataclass(frozen=True, kw_only=True)
class Gallery:
    """Contact sheets of unseen objects, one for each method."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the pictures; the same command goes on there."""
    sources: tyro.conf.OmitArgPrefixes[Sources] = field(default_factory=Sources)
    objects: int = 120
    """Test objects, spread over the split."""
    view: int = 0
    """The view of each object that is shown, from 0; views are random, so this is a random one."""
    rows: int = 12
    """Rows of a sheet."""
    columns: int = 10
    """Columns of a sheet, and objects in side_by_side.png."""
    quick: bool = False
    """A check that everything works: three objects."""

    def __post_init__(self) -> None:
        at_least(self, 1, "objects", "rows", "columns")
        at_least(self, 0, "view")


def main(options: Gallery) -> None:
    """Makes the pictures that are missing, then sheets and page."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = trained_networks.test_objects(dataset, 3 if options.quick else options.objects)
    if note := shortage(dataset, options):
        print(note)
    results_folder.claim(options.out, "a gallery", {"view": options.view}, dataset)
    trained = trained_networks.networks(options.sources, dataset)
    points = next(iter(trained.values())).config.test_points
    shown = all_pictures(options, dataset, names, trained, points)
    scores = {label: [psnr(*pair) for pair in zip(row, shown[REFERENCE], strict=True)] for label, row in shown.items()}
    pages = write_sheets(options, shown)
    found = {
        "objects": list(names),
        "view": options.view,
        "psnr": {label: [round(value, 3) for value in row] for label, row in scores.items() if label != REFERENCE},
        "made of": {label: network.identity for label, network in trained.items()},
        "points": points,
        "hardware": machine.hardware(),
        "data": dataset.settings.get("settings", {}),
        "seed": "nothing is drawn: samples lie at the middles of their strata",
        "note": note,
    }
    files = {
        "results.json": results_folder.as_json(found),
        "side_by_side.png": png(side_by_side(shown, options.columns)),
        "gallery.html": gallery_page(names, shown, scores, found).encode(),
    }
    for name, content in files.items():
        write_whole(options.out / name, content)
    print(f"wrote {pages} sheets for each of {len(shown)} methods, {', '.join(files)} in {options.out}")


def all_pictures(
    options: Gallery, dataset: data_sets.Dataset, names: tuple[str, ...], trained: dict[str, Network], points: int
) -> dict[str, list[np.ndarray]]:
    """The picture of every object by the reference and by each method, in one view."""
    for label, network in trained.items():
        asked = network.identity | {"points": points}
        results_folder.claim(options.out / "pictures" / label, f"pictures of {label}", asked)
    surfaces = surface_folders(options.sources.table1, points, names)
    shown: dict[str, list[np.ndarray]] = {label: [] for label in (REFERENCE, *trained, *surfaces)}
    for number, name in enumerate(names, start=1):
        item = data_sets.read_object(dataset, name)
        if options.view >= len(item.images):
            raise UserError(f"--view {options.view}: object {name} has views 0 to {len(item.images) - 1}")
        shown[REFERENCE].append(data_sets.on_white(item.images[options.view]))
        for label, network in trained.items():
            place = options.out / "pictures" / label / f"{name}.png"
            shown[label].append(results_folder.kept(place, partial(picture, network, item, options.view, points)))
        for label, folder in surfaces.items():
            shown[label].append(data_sets.on_white(layout.read_image(folder / name / f"{options.view:03d}.png")))
        if number % 10 == 0 or number == len(names):
            print(f"{number} of {len(names)} objects", flush=True)
    return shown


def shortage(dataset: data_sets.Dataset, options: Gallery) -> str:
    """A line where the data set has fewer test objects than asked, with how to make more; else nothing."""
    count, wanted = len(dataset.splits["test"]), options.objects
    if count >= wanted or options.quick:
        return ""
    total = sum(map(len, dataset.splits.values()))
    return (
        f"{dataset.folder} has {count} test objects, {wanted} were asked for: all of them are shown. For more: "
        f"spnr-data generate NEW_DIR --objects {total - count + wanted} --test-objects {wanted} (procedural), or "
        f"--meshes FOLDER --test-objects {wanted}, and train on that"
    )


def picture(network: Network, item: data_sets.ObjectData, view: int, points: int) -> np.ndarray:
    """A network's picture of one view, from the object's first points."""
    camera = jax.tree.map(lambda x: x[view : view + 1], item.camera)
    return np.asarray(network.show()(data_sets.first_points(item, points), camera).image[0])


def surface_folders(table1: Path | None, points: int, names: tuple[str, ...]) -> dict[str, Path]:
    """Folders of the Poisson pictures of a table by name; those that lack an object are left out with a line."""
    found = {}
    for row in SURFACES if table1 is not None else ():
        assert table1 is not None
        folder = table1 / f"{row}_{points}"
        if lacking := [name for name in names if not (folder / name / "made.json").is_file()]:
            print(f"{LABELS[row]} left out: {folder} lacks {len(lacking)} of {len(names)} objects ({lacking[0]}, ...)")
        else:
            found[LABELS[row]] = folder
    return found


def write_sheets(options: Gallery, shown: dict[str, list[np.ndarray]]) -> int:
    """Writes the contact sheets of every method and returns how many pages each has."""
    size, per_page = shown[REFERENCE][0].shape[0], options.rows * options.columns
    pages = -(-len(shown[REFERENCE]) // per_page)
    for label, pictures in shown.items():
        for number in range(pages):
            row = pictures[number * per_page : (number + 1) * per_page]
            rows = [row[i : i + options.columns] for i in range(0, len(row), options.columns)]
            write_whole(options.out / f"{file_stem(label)}_{number + 1}.png", png(figures.grid(rows, size=size)))
    return pages


def side_by_side(shown: dict[str, list[np.ndarray]], count: int) -> np.ndarray:
    """The pictures (h, w, 3) uint8 of `count` objects, from the first to the last, with a row for each method."""
    total = len(shown[REFERENCE])
    picked = sorted({round(i) for i in np.linspace(0, total - 1, min(count, total))})
    rows = [[pictures[i] for i in picked] for pictures in shown.values()]
    return figures.grid(rows, rows=list(shown), size=max(64, shown[REFERENCE][0].shape[0]))


def file_stem(label: str) -> str:
    """The name of a method as a file has it: point-nerf, ours-a-run."""
    return re.sub(r"[^a-z0-9]+", "-", label.lower()).strip("-")


def gallery_page(names: tuple[str, ...], shown: dict[str, list[np.ndarray]], scores: dict, found: dict) -> str:
    """The HTML file: every object with all methods, and what the pictures were made of."""
    made = ", ".join(f"{label} after {one['steps']} steps" for label, one in found["made of"].items())
    what = f"{len(names)} unseen objects, view {found['view']} of each, {found['points']} points; {made}"
    methods = [label for label in shown if label != REFERENCE]
    rows = [
        Shown(
            name=name,
            view=found["view"],
            reference=shown[REFERENCE][i],
            images={label: shown[label][i] for label in methods},
            psnr={label: scores[label][i] for label in methods},
        )
        for i, name in enumerate(names)
    ]
    notes = [f"{what}; {found['hardware']}.", *([found["note"]] if found["note"] else [])]
    return page.page("Unseen objects, all methods", [], notes, rows)


if __name__ == "__main__":
    entry_point.run(main, Gallery, "paper.figs4_21")
