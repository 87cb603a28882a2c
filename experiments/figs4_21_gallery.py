"""Figures 4 to 21: more than a hundred unseen objects as contact sheets, one for each method, all of the same layout.

    python -m experiments.figs4_21_gallery --data DIR --out DIR --runs RUN ... [--table1 DIR]

One view of each object; the numbers of objects and views are options.  Poisson surfaces are those that
experiments.table1 has rendered, where --table1 names its folder.

    OUT/reference_1.png ours_1.png ...   sheets of so many rows and columns, page by page
    OUT/side_by_side.png                 a few objects spread over all, a row for each method
    OUT/gallery.html                     every object with all methods side by side, in one file
    OUT/pictures/METHOD/ID.png           each picture; what is there is kept, so a stopped call goes on
    OUT/results.json                     PSNR of every picture, and the conditions
"""

import json
import re
import sys
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import jax
import numpy as np
import tyro
from PIL import Image

from data_gen.store import layout
from experiments import claims, methods, sheets
from experiments.methods import Sources
from experiments.table1_page import data_address
from experiments.table1_poisson import SURFACES
from experiments.table1_report import LABELS
from spnr_jax import cli
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import png, write_whole
from spnr_jax.scoring.report import psnr
from spnr_jax.scoring.report_style import STYLE
from spnr_jax.training import run_record

REFERENCE = "Reference"
PAGE_STYLE = """
main { max-width: none }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(var(--width), 1fr)); gap: 14px 22px }
.grid article { break-inside: avoid }
.grid h2 { font-size: 13px; font-weight: 600 }
.row { display: flex; gap: 4px }
.row figure { margin: 0; width: 96px; text-align: center }
.row img { width: 96px; height: 96px; image-rendering: pixelated; border: 1px solid var(--line); border-radius: 4px }
.row figcaption { color: var(--soft); font-size: 11px; line-height: 1.3 }
"""


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
        for name, least in (("objects", 1), ("view", 0), ("rows", 1), ("columns", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"--{name}: expected {least} or more, got {getattr(self, name)}")


def main(options: Gallery) -> None:
    """Makes the pictures that are missing, then sheets and page."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = methods.test_objects(dataset, 3 if options.quick else options.objects)
    if note := shortage(dataset, options):
        print(note)
    whole = {"data": run_record.checksum(dataset), "view": options.view}
    claims.claim(options.out / "gallery.json", whole, "a gallery")
    networks = methods.networks(options.sources, dataset)
    points = next(iter(networks.values())).config.test_points
    for label, network in networks.items():
        asked = network.identity | {"points": points}
        claims.claim(options.out / "pictures" / label / "made.json", asked, f"pictures of {label}")
    shown: dict[str, list[np.ndarray]] = {REFERENCE: [], **{label: [] for label in networks}}
    surfaces = surface_folders(options.sources.table1, points, names)
    shown |= {label: [] for label in surfaces}
    for number, name in enumerate(names, start=1):
        item = data_sets.read_object(dataset, name)
        if options.view >= len(item.images):
            raise ValueError(f"--view {options.view}: object {name} has views 0 to {len(item.images) - 1}")
        shown[REFERENCE].append(data_sets.on_white(item.images[options.view]))
        for label, network in networks.items():
            place = options.out / "pictures" / label / f"{name}.png"
            shown[label].append(picture(network, item, options.view, points, place))
        for label, folder in surfaces.items():
            rgba = layout.read_image(folder / name / f"{options.view:03d}.png")
            shown[label].append(data_sets.on_white(rgba))
        if number % 10 == 0 or number == len(names):
            print(f"{number} of {len(names)} objects", flush=True)
    scores = {label: [psnr(*pair) for pair in zip(row, shown[REFERENCE], strict=True)] for label, row in shown.items()}
    pages = write_sheets(options, shown)
    write_whole(options.out / "side_by_side.png", png(side_by_side(shown, options.columns)))
    results = {
        "objects": list(names),
        "view": options.view,
        "psnr": {label: [round(value, 3) for value in row] for label, row in scores.items() if label != REFERENCE},
        "made of": {label: network.identity for label, network in networks.items()},
        "points": points,
        "hardware": machine.hardware(),
        "data": dataset.settings.get("settings", {}),
        "seed": "nothing is drawn: samples lie at the middles of their strata",
        "note": note,
    }
    write_whole(options.out / "results.json", (json.dumps(results, indent=1, allow_nan=False) + "\n").encode())
    write_whole(options.out / "gallery.html", page(options, names, shown, scores, results).encode())
    written = "side_by_side.png, gallery.html and results.json"
    print(f"wrote {pages} sheets for each of {len(shown)} methods, {written} in {options.out}")


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


def picture(network: methods.Network, item: data_sets.ObjectData, view: int, points: int, place: Path) -> np.ndarray:
    """A network's picture of one view, from the object's first points; read where it is made."""
    if not place.is_file():
        camera = jax.tree.map(lambda x: x[view : view + 1], item.camera)
        shown = network.show()(data_sets.first_points(item, points), camera)
        write_whole(place, png(np.asarray(shown.image[0])))
    with Image.open(place) as image:
        return np.asarray(image.convert("RGB"))


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
            write_whole(options.out / f"{file_stem(label)}_{number + 1}.png", png(sheets.grid(rows, size=size)))
    return pages


def side_by_side(shown: dict[str, list[np.ndarray]], count: int) -> np.ndarray:
    """The pictures (h, w, 3) uint8 of `count` objects, from the first to the last, with a row for each method."""
    total = len(shown[REFERENCE])
    picked = sorted({round(i) for i in np.linspace(0, total - 1, min(count, total))})
    rows = [[pictures[i] for i in picked] for pictures in shown.values()]
    return sheets.grid(rows, rows=list(shown), size=max(64, shown[REFERENCE][0].shape[0]))


def file_stem(label: str) -> str:
    """The name of a method as a file has it: point-nerf, ours-a-run."""
    return re.sub(r"[^a-z0-9]+", "-", label.lower()).strip("-")


def page(
    options: Gallery, names: tuple[str, ...], shown: dict[str, list[np.ndarray]], scores: dict, results: dict
) -> str:
    """The whole HTML file: every object with all methods, and what the pictures were made of."""
    made = ", ".join(f"{label} after {found['steps']} steps" for label, found in results["made of"].items())
    notes = [
        f"{len(names)} unseen objects, view {options.view} of each, {results['points']} points; {made}; "
        f"{results['hardware']}. Below a picture is its PSNR in dB.",
        *([results["note"]] if results["note"] else []),
    ]
    articles = "".join(
        f"<article><h2>{escape(name)}</h2><div class=row>"
        + "".join(cell(label, row[i], scores[label][i]) for label, row in shown.items())
        + "</div></article>"
        for i, name in enumerate(names)
    )
    title = "Unseen objects, all methods"
    listed = "".join(f'<p class="note">{escape(note)}</p>' for note in notes)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{STYLE}{PAGE_STYLE}</style></head>"
        f'<body><main><header><h1>{title}</h1>{listed}</header><section class="grid" '
        f'style="--width: {100 * len(shown)}px">{articles}</section></main></body></html>\n'
    )


def cell(label: str, image: np.ndarray, score: float) -> str:
    """One picture with its name, and its PSNR if it is not the reference."""
    below = escape(label) if label == REFERENCE else f"{escape(label)}<br>{score:.1f}"
    return f'<figure><img src="{data_address(image)}" alt=""><figcaption>{below}</figcaption></figure>'


if __name__ == "__main__":
    name = "figs4_21_gallery"
    sys.exit(cli.guarded(lambda: main(tyro.cli(Gallery, prog=f"python -m experiments.{name}")), name))
