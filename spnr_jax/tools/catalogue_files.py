"""The files of a catalogue: which are drawn, where what is drawn of each lies, and whether it still stands.

    OUT/a/x.ply/            what is drawn of a/x.ply below the folder, or below the part of the pattern before its
                            wildcards: no other file has this name
    OUT/a/x.ply/drawn.json  written last: the file's size and time, a digest of options and networks, what was written

A folder without drawn.json, or with one that is of another file or of other options, is drawn anew.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from spnr_jax.errors import UserError
from spnr_jax.formats.clouds import MESHES
from spnr_jax.formats.images import write_whole
from spnr_jax.formats.point_files import READERS
from spnr_jax.tools.render_command import WILDCARDS, Render
from spnr_jax.training.weights import SHIPPED, place

KINDS = tuple(dict.fromkeys((*READERS, *MESHES)))
RECORD = "drawn.json"
WITHOUT_EFFECT = ("cloud", "out", "workers", "cluster")  # options that change no picture


@dataclass(frozen=True, kw_only=True, order=True)
class Item:
    """A file to draw: its name below the folder or pattern, with slashes, and where it lies."""

    name: str
    cloud: Path


@dataclass(frozen=True, kw_only=True)
class Record:
    """What was drawn of a file: `files` lie in its folder, `notes` are the assumptions about the cloud."""

    size: int
    modified_ns: int
    options: str
    files: tuple[str, ...]
    notes: tuple[str, ...]


def find(pattern: Path, out: Path) -> list[Item]:
    """The files of a folder, or those that a pattern names, by their names; none of those below `out`.

    ValueError if there are none.
    """
    root, matches = (pattern, _below(pattern)) if pattern.is_dir() else _matching(pattern)
    root, out = root.absolute(), out.resolve()
    found = set()
    for path in matches:
        if path.suffix.lower() in KINDS and not path.name.startswith(".") and path.is_file():
            path = path.absolute()
            if out not in path.resolve().parents:
                found.add(Item(name=path.relative_to(root).as_posix(), cloud=path))
    if not found:
        raise UserError(f"{pattern}: there is no file of one of {' '.join(KINDS)}; name a folder or pattern with some")
    return sorted(found)


def _below(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder, onerror=_raised):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(parent, name) for name in names)


def _raised(error: OSError) -> None:
    raise error


def _matching(pattern: Path) -> tuple[Path, Iterator[Path]]:
    """The part of a pattern before its wildcards, and what it names."""
    parts = pattern.parts
    first = next(i for i, part in enumerate(parts) if any(mark in part for mark in WILDCARDS))
    if ".." in parts[first:]:
        raise UserError(f"{pattern}: .. behind a wildcard; leave it out")
    root = Path(*parts[:first])
    return root, root.glob(str(Path(*parts[first:])))


def folder_of(item: Item, out: Path) -> Path:
    """Where what is drawn of a file lies."""
    return out / item.name


def standing(item: Item, out: Path, options: str) -> Record | None:
    """The record of a file, if it was drawn as it is now, with these options, and all that was written is there."""
    record = read_record(item, out)
    folder = folder_of(item, out)
    if record is None or record.options != options or (record.size, record.modified_ns) != _state(item.cloud):
        return None
    return record if all((folder / name).is_file() for name in record.files) else None


def read_record(item: Item, out: Path) -> Record | None:
    """The record of a file; none if there is none that can be read."""
    try:
        content = json.loads((folder_of(item, out) / RECORD).read_bytes())
        record = Record(**content | {"files": tuple(content["files"]), "notes": tuple(content["notes"])})
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return record


def _state(cloud: Path) -> tuple[int, int]:
    """Size and time of a file; no record has those of one that is gone."""
    try:
        status = cloud.stat()
    except OSError:
        return -1, -1
    return status.st_size, status.st_mtime_ns


def begin(item: Item, out: Path, options: str) -> Record:
    """The record to be of a file that is drawn now; what was drawn of it before is removed, its record first."""
    before = read_record(item, out)
    folder = folder_of(item, out)
    (folder / RECORD).unlink(missing_ok=True)
    for name in before.files if before else ():
        if Path(name).name == name:
            (folder / name).unlink(missing_ok=True)
    size, modified_ns = _state(item.cloud)
    return Record(size=size, modified_ns=modified_ns, options=options, files=(), notes=())


def finish(item: Item, out: Path, record: Record) -> None:
    """Writes the record: from now on the file counts as drawn."""
    content = json.dumps(dataclasses.asdict(record), indent=1) + "\n"
    write_whole(folder_of(item, out) / RECORD, content.encode())


def digest(options: Render) -> str:
    """What pictures depend on but for the file: the options, and the bytes of networks and of a map of light."""
    asked = {k: v for k, v in dataclasses.asdict(options).items() if k not in WITHOUT_EFFECT}
    found = hashlib.sha256(json.dumps(asked, default=str, sort_keys=True).encode())
    light = options.lighting.light
    networks = [place(options.run)] if options.run else [place(name) for name in SHIPPED]
    for path in [*networks, *([Path(light)] if light else [])]:
        if path.is_file():
            found.update(path.read_bytes())
        elif path.is_dir():  # a run: its checkpoints
            inside = sorted((path / "checkpoints").glob("*"))
            found.update(str([(child.name, child.stat().st_mtime_ns) for child in inside]).encode())
    return found.hexdigest()
