"""Where a data set lies: a local folder, or any URL that fsspec opens (s3://, gs://, memory://, ...).

One rule serves both: an object is complete when its object.json is there, and that file comes last. On a local disk the
folder is written beside its place and renamed into it, so it appears as a whole. An object store has no such rename:
there the files are put one by one, each of them whole, object.json at the end. Writers never disturb each other: the
first complete folder stays, unfinished ones carry the name of their process, and the same object is the same bytes.
"""

import os
import re
import shutil
import socket
import tempfile
import time
from pathlib import Path

import fsspec
import psutil
from fsspec.implementations.local import LocalFileSystem

from spnr_jax.errors import UserError

LAST_FILE = "object.json"  # its presence makes an object complete
UNFINISHED = ".unfinished-"  # prefix of what is still being written: .unfinished-HOST-PROCESS-SUFFIX
STALE = 24 * 3600  # seconds after which unfinished work of another host is taken for abandoned

Location = str | Path


def absolute(location: Location) -> str:
    """The location as another working directory would name it: a URL as it is, a path from the root."""
    return str(location) if "://" in str(location) else str(Path(location).absolute())


def open_place(location: Location) -> tuple[fsspec.AbstractFileSystem, str]:
    """The file system of a location and the path in it; ValueError if no installed package opens such URLs."""
    try:
        return fsspec.core.url_to_fs(str(location))
    except (ImportError, ValueError) as error:
        raise UserError(f"{location}: no such place can be opened ({error})") from None


def read_file(location: Location) -> bytes | None:
    """The content of a file, or None if there is none."""
    filesystem, path = open_place(location)
    try:
        return filesystem.cat_file(path)
    except FileNotFoundError:
        return None


def write_file(location: Location, content: bytes) -> None:
    """Write a file in one piece: a reader sees the old content or the new, never half of it."""
    filesystem, name = open_place(location)
    if not isinstance(filesystem, LocalFileSystem):
        filesystem.pipe_file(name, content)
        return
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, beside = tempfile.mkstemp(prefix=unfinished_prefix(), dir=path.parent)
    try:
        with open(handle, "wb") as file:
            file.write(content)
        os.chmod(beside, 0o644)
        os.replace(beside, path)
    finally:
        Path(beside).unlink(missing_ok=True)


def has_object(dataset: Location, object_id: str) -> bool:
    """Whether an object of the data set is complete."""
    filesystem, path = open_place(dataset)
    return filesystem.exists(f"{path}/objects/{object_id}/{LAST_FILE}")


def list_completed(dataset: Location) -> set[str]:
    """The ids of the objects whose folders are complete."""
    filesystem, path = open_place(f"{dataset}/objects")
    if isinstance(filesystem, LocalFileSystem):  # looking into each folder beats listing all their files, as stores do
        folders = Path(path).iterdir() if Path(path).is_dir() else ()
        found = {folder.name for folder in folders if (folder / LAST_FILE).is_file()}
    else:
        found = {name.split("/")[-2] for name in filesystem.find(path) if name.endswith(f"/{LAST_FILE}")}
    return {object_id for object_id in found if not object_id.startswith(UNFINISHED)}


def is_empty(location: Location) -> bool:
    """Whether a place holds nothing, apart from what is just being written."""
    filesystem, path = open_place(location)
    if not filesystem.exists(path):
        return True
    names = (name.rstrip("/").split("/")[-1] for name in filesystem.ls(path, detail=False))
    return all(name.startswith(UNFINISHED) for name in names)


def write_object_folder(objects: Location, object_id: str, files: dict[str, bytes]) -> None:
    """Write the files of one object, LAST_FILE last; one that is already complete is left as it is."""
    assert list(files)[-1] == LAST_FILE
    filesystem, root = open_place(objects)
    if filesystem.exists(f"{root}/{object_id}/{LAST_FILE}"):
        return
    if isinstance(filesystem, LocalFileSystem):
        write_and_rename(Path(root) / object_id, files)
        return
    for name, content in files.items():
        filesystem.pipe_file(f"{root}/{object_id}/{name}", content)


def write_and_rename(place: Path, files: dict[str, bytes]) -> None:
    """Write a folder beside its place and rename it; if another writer was faster, its folder stays."""
    place.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=unfinished_prefix(), dir=place.parent))
    try:
        for name, content in files.items():
            (beside / name).parent.mkdir(exist_ok=True)
            (beside / name).write_bytes(content)
        beside.chmod(0o755)
        try:
            beside.rename(place)
        except OSError:  # a folder that is not empty is never replaced
            if not place.is_dir():
                raise
            if not (place / LAST_FILE).is_file():
                raise UserError(f"{place} is in the way: a folder without {LAST_FILE}; remove it") from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def unfinished_prefix() -> str:
    """How the names of this process's unfinished files and folders begin."""
    return f"{UNFINISHED}{socket.gethostname()}-{os.getpid()}-"


def remove_unfinished(dataset: Location) -> None:
    """Remove the objects that dead processes of this host, or any process a day ago, left half written on a disk."""
    filesystem, name = open_place(f"{dataset}/objects")
    if not isinstance(filesystem, LocalFileSystem):
        return
    for path in Path(name).glob(UNFINISHED + "*"):
        if is_abandoned(path):
            shutil.rmtree(path, ignore_errors=True)


def is_abandoned(path: Path) -> bool:
    """Whether nobody writes an unfinished folder any more."""
    owner = re.fullmatch(re.escape(UNFINISHED) + r"(.+)-(\d+)-\w+", path.name)
    if owner and owner[1] == socket.gethostname():
        return not psutil.pid_exists(int(owner[2]))
    try:
        return time.time() - path.stat().st_mtime > STALE
    except FileNotFoundError:  # its writer has just finished it
        return False
