"""A data set packed for reading in bulk: its objects in a few ArrayRecord shards (form: spnr_jax/formats/shards.py).

A million objects are 23 million small files, more than file systems and object stores like; packed they are some
thousand shards. The files go in as they are, so nothing is lost, and `spnr train` and `spnr evaluate` read either form.
"""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgpack
import tyro
from tqdm import tqdm

from data_gen.store import check, layout, storage
from spnr_jax.errors import UserError, at_least, first_line

OPTIONS = "group_size:1"  # each record by itself, so that one object is one read; zstd by default
BYTES_PER_MB = 10**6


@dataclass(frozen=True, kw_only=True)
class PackConfig:
    """Pack a data set into a few big files; `spnr train` and `spnr evaluate` read either form."""

    dataset: tyro.conf.Positional[Path]
    """Folder of the data set."""
    out: Path
    """Folder of the packed form; it must not exist, and appears when it is complete."""
    shard_mb: int = 256
    """Size of a shard in millions of bytes, before compression."""


def pack(config: PackConfig) -> None:
    """Write the packed form of a data set; ValueError or OSError, and nothing is left, if it cannot be."""
    at_least(config, 1, "shard_mb")
    if config.out.exists():
        raise UserError(f"{config.out} exists already: choose another folder")
    check.read_description(config.dataset)
    config.out.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=storage.unfinished_prefix(), dir=config.out.parent))
    try:
        ids = sorted(object_id for split in layout.SPLITS for object_id in layout.read_split(config.dataset, split))
        (beside / "shards").mkdir()
        shards = write_shards(beside / "shards", config.dataset, ids, config.shard_mb * BYTES_PER_MB)
        shutil.copytree(config.dataset / "splits", beside / "splits")
        for name in ("dataset.json", "rejected.jsonl"):
            shutil.copyfile(config.dataset / name, beside / name)
        (beside / "index.json").write_text(json.dumps({"shards": shards, "ids": ids}) + "\n")
        beside.chmod(0o755)
        beside.rename(config.out)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    print(f"{config.out}: {len(ids)} objects in {len(shards)} shards")


def write_shards(folder: Path, dataset: Path, ids: list[str], shard_bytes: int) -> dict[str, int]:
    """Write the objects into shards of about this size; return each shard's file name and number of records."""
    from array_record.python.array_record_module import ArrayRecordWriter

    shards: dict[str, int] = {}
    contents = (msgpack.packb(object_files(dataset, object_id)) for object_id in tqdm(ids, unit="object"))
    for number, shard in enumerate(in_shards(contents, shard_bytes)):
        path = folder / f"{number:05d}.array_record"
        writer = ArrayRecordWriter(str(path), OPTIONS)
        try:
            for content in shard:
                writer.write(content)
                shards[path.name] = shards.get(path.name, 0) + 1
            writer.close()
        except RuntimeError as error:  # the writer's word for every error of the disk
            raise OSError(f"{path}: cannot be written ({first_line(error)})") from None
    return shards


def in_shards(contents: Iterator[bytes], shard_bytes: int) -> Iterator[Iterator[bytes]]:
    """Yield the contents in groups that end with the content that fills them; each is used up before the next."""

    def group(content: bytes) -> Iterator[bytes]:
        size = len(content)
        yield content
        while size < shard_bytes and (following := next(contents, None)) is not None:
            size += len(following)
            yield following

    while (first := next(contents, None)) is not None:
        yield group(first)


def object_files(dataset: Path, object_id: str) -> dict[str, bytes]:
    """The files of an object by their paths in its folder; ValueError if one is not as it was written."""
    folder = dataset / "objects" / object_id
    details = (folder / storage.LAST_FILE).read_bytes()
    checksums = layout.read_document(folder / storage.LAST_FILE).get("files")
    if not isinstance(checksums, dict) or any(layout.file_of(folder, name) is None for name in checksums):
        raise UserError(
            f"{folder / storage.LAST_FILE}: expected the files of the object's own folder; generate it again"
        )
    files = {name: (folder / name).read_bytes() for name in checksums}
    for name, checksum in checksums.items():
        if hashlib.sha256(files[name]).hexdigest() != checksum:
            raise UserError(f"{folder / name} is not as it was written: run spnr-data check {dataset}")
    return {**files, storage.LAST_FILE: details}
