"""Every file of a folder or pattern drawn in one go: `spnr render FOLDER`, here or by worker processes.

    OUT/a/x.ply/            what is drawn of a/x.ply below the folder, or of a pattern, below its first wildcard
    OUT/a/x.ply/drawn.json  written last: the file's size and time, a digest of options and networks, what was written
    OUT/index.html          the pictures of each file, and why others have none

A folder without drawn.json, or with one of another file or of other options, is drawn anew: the same command goes on.
A file that cannot be drawn is listed with its reason; errors of the disk that is written to end the run.
"""

import dataclasses
import hashlib
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from tqdm import tqdm

from spnr_jax.devices import runtime
from spnr_jax.devices.runtime import run_ahead, run_tasks
from spnr_jax.errors import UserError, one_line
from spnr_jax.formats.images import check_place, template, write_whole
from spnr_jax.formats.point_files import MESHES, READERS
from spnr_jax.tools.commands import WILDCARDS, Render
from spnr_jax.tools.pictures import draw_all, load_network, prepare_cloud
from spnr_jax.training.weights import load, packaged_file, place

KINDS = tuple(dict.fromkeys((*READERS, *MESHES)))
RECORD, PAGE = "drawn.json", "index.html"
loaded = cache(load)  # of a process that draws many clouds


class Item(NamedTuple):
    """A file to draw: its name below the folder or pattern, with slashes, and where it lies."""

    name: str
    cloud: Path


class Batch(NamedTuple):
    """What is needed for any file: the options and their digest."""

    options: Render
    digest: str


def render_catalogue(options: Render) -> Iterator[str]:
    """Draws what does not stand yet; yields what became of it.  ValueError if there is nothing that can be drawn."""
    check_place(options.out / PAGE)
    items = find(options.cloud, options.out)
    load_network(options, loaded)  # a run that is none is said before anything is read
    batch = Batch(options=options, digest=digest(options))
    missing = [item for item in items if not standing(batch, item)]
    faults: dict[str, str] = {}
    here = ((item, draw_item(batch, item)) for item in missing)
    outcomes = run_tasks(draw_item, batch, missing, options.workers) if options.workers else here
    bar = tqdm(total=len(items), initial=len(items) - len(missing), unit="file", dynamic_ncols=True)
    try:
        with bar, closing(outcomes) as results:
            for item, fault in results:
                if fault is not None:
                    faults[item.name] = fault
                    tqdm.write(f"left out {item.cloud}: {fault}", file=sys.stderr)
                bar.update()
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped: what is drawn stands, and the same command goes on") from None
    finally:  # also after Ctrl-C: what stands is shown
        page = write_page(batch, items, faults)
    if len(faults) == len(items):
        raise UserError(f"{options.cloud}: none of the {len(items)} files can be drawn; {page} says why")
    made = len(missing) - len(faults)
    yield f"drew {made} of {len(items)} files, {len(items) - len(missing)} stood, {len(faults)} left out"
    yield f"wrote {page}"


def find(pattern: Path, out: Path) -> list[Item]:
    """The files of a folder or pattern, by their names, none hidden or below `out`; ValueError if there are none."""
    first = next((i for i, part in enumerate(pattern.parts) if any(mark in part for mark in WILDCARDS)), None)
    if pattern.is_dir() or first is None:
        root, wanted = pattern, "**/*"
    else:
        root, wanted = Path(*pattern.parts[:first]), str(Path(*pattern.parts[first:]))
        if ".." in pattern.parts[first:]:
            raise UserError(f"{pattern}: .. behind a wildcard; leave it out")
    found = set()
    for path in root.glob(wanted):
        name = path.relative_to(root)
        left_out = any(part.startswith(".") for part in name.parts) or out.resolve() in path.resolve().parents
        if path.suffix.lower() in KINDS and path.is_file() and not left_out:
            found.add(Item(name=name.as_posix(), cloud=path.absolute()))
    if not found:
        raise UserError(f"{pattern}: there is no file of one of {' '.join(KINDS)}; name a folder or pattern with some")
    return sorted(found)


def digest(options: Render) -> str:
    """What pictures depend on but for the file: the options, and the bytes of networks and of a map of light."""
    asked = {k: v for k, v in dataclasses.asdict(options).items() if k not in ("cloud", "out", "workers")}
    found = hashlib.sha256(json.dumps(asked, default=str, sort_keys=True).encode())
    light = options.lighting.light
    run = place(options.run)
    networks = [run, packaged_file("densifier"), (run if run.is_dir() else run.parent) / "densifier.npz"]
    for path in networks + ([Path(light)] if light else []):
        if path.is_file():
            found.update(path.read_bytes())
        elif path.is_dir():  # a run: its checkpoints
            inside = sorted((path / "checkpoints").glob("*"))
            found.update(str([(child.name, child.stat().st_mtime_ns) for child in inside]).encode())
    return found.hexdigest()


def standing(batch: Batch, item: Item) -> dict | None:
    """The record of a file, if it was drawn as it is now, with these options, and all that was written is there."""
    folder, record = batch.options.out / item.name, _read_record(batch, item)
    same = record.items() >= _state(batch, item).items()
    return record if same and all((folder / name).is_file() for name in record["files"]) else None


def _read_record(batch: Batch, item: Item) -> dict:
    """What was drawn of a file, empty where there is no record that can be read: its state, `files`, `notes`."""
    try:
        record = json.loads((batch.options.out / item.name / RECORD).read_bytes())
        return record if all(isinstance(name, str) for name in record["files"] + record["notes"]) else {}
    except (OSError, ValueError, TypeError, LookupError):
        return {}


def _state(batch: Batch, item: Item) -> dict:
    """What a record must say to be of the file as it is now, drawn with these options."""
    status = item.cloud.stat() if item.cloud.exists() else None
    return {"file": [status.st_size, status.st_mtime_ns] if status else [], "options": batch.digest}


def draw_item(batch: Batch, item: Item) -> str | None:
    """Draws a file, in any process; None, or why it cannot be drawn.  What is wrong with the process is raised."""
    if standing(batch, item):  # another run was faster
        return None
    runtime.keep_arrays()
    runtime.keep_programs()
    folder, state, notes = batch.options.out / item.name, _state(batch, item), list[str]()
    before = _read_record(batch, item).get("files", [])
    for name in (RECORD, *(name for name in before if Path(name).name == name)):
        (folder / name).unlink(missing_ok=True)
    options = dataclasses.replace(batch.options, cloud=item.cloud)
    ready = None
    try:
        ready = prepare_cloud(options, notes.append, load_network(options, loaded))
        written = [
            path.name for one in run_ahead(draw_all(ready, options, folder / item.cloud.stem)) for path in one.paths
        ]
    except ValueError as error:
        return one_line(error)
    except Exception as error:
        if ready and isinstance(error, OSError):  # of the disk that is written to
            raise
        return f"unexpected {type(error).__name__}: {one_line(error)}"
    write_whole(folder / RECORD, (json.dumps(state | {"files": written, "notes": notes}, indent=1) + "\n").encode())
    return None


def write_page(batch: Batch, items: Sequence[Item], faults: Mapping[str, str]) -> Path:
    """Writes the page of the files that stand, those that cannot be drawn and those that are yet to be."""
    entries = []
    for item in items:
        record = standing(batch, item) or {"files": [], "notes": []}
        fault = faults.get(item.name) or (None if record["files"] else "not drawn yet")
        places = {name: quote(f"{item.name}/{name}", errors="surrogateescape") for name in record["files"]}
        entries.append({"name": item.name, "fault": fault, "places": places, "notes": record["notes"]})
    page, text = batch.options.out / PAGE, template(Path(__file__).with_suffix(".html"))
    # the bytes of a name may be no text
    write_whole(page, text.render(entries=entries, faults=faults).encode(errors="replace"))
    return page
