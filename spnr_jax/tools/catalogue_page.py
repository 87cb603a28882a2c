"""The pages of a catalogue, index.html first: the pictures of each file, in their order, and why others have none.

Pictures are links to the files beside the page, loaded when they are scrolled to; nothing comes from elsewhere.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

from spnr_jax.formats.images import write_whole
from spnr_jax.formats.pages import template
from spnr_jax.tools.catalogue_files import Item, standing

PER_PAGE = 200  # files on a page
MOST_PICTURES = 4  # of a file on it
FILM = "_turntable."
NOT_PICTURES = ("_depth.png", "_depth_16bit.png", "_opacity.png")


def write_pages(items: Sequence[Item], out: Path, options: str, faults: Mapping[str, str]) -> Path:
    """Writes the pages of the files that stand, those that cannot be drawn and those that are yet to be; the first."""
    parts = [items[i : i + PER_PAGE] for i in range(0, len(items), PER_PAGE)]
    names = [_name(number) for number in range(len(parts))]
    for number, part in enumerate(parts):
        text = template(Path(__file__).with_name("catalogue_page.html")).render(
            entries=[_entry(item, out, options, faults) for item in part],
            faults=faults,
            count=len(items),
            pages=names,
            number=number,
        )
        write_whole(out / names[number], text.encode())
    number = len(parts)
    while (left := out / _name(number)).exists():  # of a time when there were more
        left.unlink()
        number += 1
    return out / names[0]


def _name(number: int) -> str:
    return f"index_{number + 1}.html" if number else "index.html"


def _entry(item: Item, out: Path, options: str, faults: Mapping[str, str]) -> dict:
    """A file as the page shows it."""
    entry: dict = {"name": item.name, "fault": faults.get(item.name), "pictures": [], "films": [], "links": []}
    if entry["fault"] is None:
        record = standing(item, out, options)
        if record is None:
            return entry | {"fault": "not drawn yet"}
        places = {name: quote(f"{item.name}/{name}") for name in record.files}
        films = [name for name in places if FILM in name]
        stills = [name for name in places if name.endswith(".png") and not name.endswith(NOT_PICTURES)]
        shown = [*stills[:MOST_PICTURES], *(name for name in films if name.endswith(".gif"))]
        entry["pictures"] = [places[name] for name in shown]
        entry["films"] = [places[name] for name in films if name.endswith(".mp4")]
        others = [name for name in places if name.endswith((".ply", ".spz", ".glb", ".npz", ".json"))]
        entry["links"] = [(name, places[name]) for name in others]
        entry["notes"] = record.notes
    return entry
