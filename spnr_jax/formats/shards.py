"""Packed data sets: the files of many objects in a few big ones, with random access to each object.

    PACKED/dataset.json  splits/...     as in a folder of objects
    PACKED/shards/00000.array_record    ArrayRecord, one record an object: a msgpack map from the paths of the files
                                        in its folder to their bytes, unchanged
    PACKED/index.json                   {"shards": {file: number of records}, "ids": [id, ...] in the order of records}

`spnr-data pack` writes them; here they are read, through grain's data source.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spnr_jax.errors import UserError, first_line

INDEX = "index.json"
LONGEST_NAME = 200  # file systems allow 255 bytes


@dataclass(frozen=True, kw_only=True)
class Shards:
    """An opened packed data set: where each object's record is, and the source of the records."""

    folder: Path
    places: dict[str, int]
    records: Any  # grain.sources.ArrayRecordDataSource, which is imported on demand


def open_shards(folder: Path) -> Shards | None:
    """The packed objects of a data set, None if it is not packed; ValueError if something is missing."""
    path = folder / INDEX
    if not path.is_file():
        return None
    import grain

    try:
        index = json.loads(path.read_text())
        if not isinstance(index["shards"], dict):
            raise UserError("holds no table of shards")
        if strange := [name for name in (*index["shards"], *index["ids"]) if not is_plain_name(name)]:
            raise UserError(f"{strange[0]!r} is no name of a file or object")
        files = {folder / "shards" / file: int(count) for file, count in index["shards"].items()}
        places = {name: place for place, name in enumerate(index["ids"])}
    except (ValueError, LookupError, TypeError, OverflowError, RecursionError) as error:
        raise UserError(f"{path}: damaged ({error}); pack the data set again") from None
    if absent := [file for file in files if not file.is_file()]:
        raise UserError(f"{absent[0]}: missing; pack the data set again")
    try:
        records = grain.sources.ArrayRecordDataSource([str(file) for file in files])
        found = len(records)
    except (RuntimeError, ValueError, OSError) as error:
        raise UserError(f"{folder}: its shards cannot be read ({first_line(error)}); pack them again") from None
    if not found == len(places) == sum(files.values()):
        raise UserError(f"{folder}: {found} objects in the shards, {len(places)} in {INDEX}; pack the data set again")
    return Shards(folder=folder, places=places, records=records)


def read_files(shards: Shards, name: str) -> dict[str, bytes]:
    """The files of one object by their paths in its folder; ValueError if its record is absent or broken."""
    import msgpack

    if name not in shards.places:
        raise UserError(f"{shards.folder}: holds no object {name}; pack the data set again")
    try:
        files = msgpack.unpackb(shards.records[shards.places[name]])
        if not isinstance(files, dict) or not all(isinstance(content, bytes) for content in files.values()):
            raise UserError("its record holds no files")
        return files
    except (RuntimeError, ValueError, OSError, LookupError, TypeError) as error:
        raise UserError(
            f"{shards.folder}: object {name} cannot be read ({first_line(error)}); pack the data set again"
        ) from None


def is_plain_name(name: object) -> bool:
    """Whether a name in a data set's lists is that of a file or folder right there: no path, nothing hidden."""
    return (
        isinstance(name, str)
        and 0 < len(name) <= LONGEST_NAME
        and name.isprintable()
        and not (name.startswith(".") or set(name) & set("/\\:"))
    )
