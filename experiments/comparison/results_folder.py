"""A results folder: the request that it belongs to, cached intermediate results, tables and pictures.

    OUT/asked.json     what was asked for; another request is refused, because its results would be mixed in
    OUT/results.json   every number and its conditions
    OUT/table.md       and the pictures

Intermediate results have files of their own, so that the same command continues where it was stopped.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets, images
from spnr_jax.scoring.report import Cell, Table


def claim(folder: Path, what: str, asked: Mapping, dataset: data_sets.Dataset | None = None) -> None:
    """Records a request (on a data set) in its folder; ValueError if the folder belongs to another one."""
    asked = {"of": what, **asked} | ({} if dataset is None else {"data": data_sets.checksum(dataset, *dataset.splits)})
    path = folder / "asked.json"
    if path.is_file():
        there = json.loads(path.read_text())
        different = [name for name in asked if there.get(name) != json.loads(json.dumps(asked[name]))]
        if different:
            found = f"{what} with another {', '.join(different)}" if "of" not in different else there.get("of")
            raise UserError(f"{folder} holds {found}; choose another --out")
    else:
        images.write_whole(path, as_json(asked))


def as_json(content: object) -> bytes:
    """The bytes of a JSON file."""
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()


def load_or_make(place: Path, make: Callable[[], Any]) -> Any:
    """Content of a file, JSON or a picture (.png); computed and written first if it is missing."""
    picture = place.suffix == ".png"
    if not place.is_file():
        content = make()
        encoded = images.png(content) if picture else (json.dumps(content, indent=1) + "\n").encode()  # NaN may be
        images.write_whole(place, encoded)
    if not picture:
        return json.loads(place.read_text())
    with Image.open(place) as image:
        return np.asarray(image.convert("RGB"))


def write(
    out: Path,
    results: Mapping,
    made: Sequence[Table],
    notes: Sequence[str] = (),
    files: Mapping[str, bytes] | None = None,
) -> None:
    """Writes results.json, the tables and what else there is, and prints the tables."""
    everything = {
        "results.json": as_json(results),
        "table.md": markdown(made, notes).encode(),
        **(files or {}),
    }
    for name, content in everything.items():
        images.write_whole(out / name, content)
    print(markdown(made))
    print(f"wrote {', '.join(everything)} in {out}", flush=True)


def markdown(tables: Sequence[Table], notes: Sequence[str] = ()) -> str:
    """The tables, and the notes as a list; a row that could not be made has its reason alone."""
    parts = []
    for table in tables:
        rows = [(name, *map(_words, cells), *[""] * (len(table.heads) - len(cells))) for name, cells in table.rows]
        lines = [("", *table.heads), ("---", *["---:"] * len(table.heads)), *rows]
        body = "\n".join(f"| {' | '.join(line)} |" for line in lines).replace("\N{NO-BREAK SPACE}", " ")
        parts.append("\n".join([f"### {table.title}", "", *([table.note, ""] if table.note else []), body, ""]))
    return "\n".join([*parts, *(f"- {line}" for line in notes)]).rstrip() + "\n"


def _words(cell: Cell) -> str:
    return " ".join([f"**{cell.text}**" if cell.best else cell.text, *cell.small])
