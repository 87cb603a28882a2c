"""Laws of the files: what is written is what is read, whole or not at all."""

import hashlib
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from data_gen.store import layout, storage


def made_up_record(views=2, resolution=8, num_points=20, seed=0):
    rng = np.random.default_rng(seed)
    points = np.zeros(num_points, layout.POINT_TYPE)
    for name in layout.POINT_FIELDS:
        points[name] = rng.random(num_points)
    points["face"] = rng.integers(0, 2**30, num_points)
    pictures = rng.integers(0, 256, (2, views, resolution, resolution, 4), dtype=np.uint8)
    poses = np.tile(np.eye(4), (views, 1, 1))
    return layout.ObjectRecord(
        points=points,
        transforms=layout.nerf_transforms(poses, resolution, 40.0, 11.0),
        images=pictures[0],
        conditions=pictures[1],
        details={"id": "made_up", "category": "object", "ignored": []},
    )


def test_an_object_reads_back_as_it_was_written(tmp_path):
    record = made_up_record()
    layout.write_object(tmp_path, "made_up", record)
    found = layout.read_object(tmp_path / "objects" / "made_up")
    assert found.points.tobytes() == record.points.tobytes()
    np.testing.assert_array_equal(found.images, record.images)
    np.testing.assert_array_equal(found.conditions, record.conditions)
    assert found.transforms == record.transforms
    assert {**found.details, "files": None} == {**record.details, "files": None}


def test_other_readers_of_ply_find_the_points(tmp_path):
    import trimesh

    record = made_up_record()
    (tmp_path / "points.ply").write_bytes(layout.encode_points(record.points))
    cloud = trimesh.load(tmp_path / "points.ply")
    np.testing.assert_array_equal(cloud.vertices, layout.point_columns(record.points, "x", "y", "z"))
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    for name in layout.POINT_TYPE.names:
        np.testing.assert_array_equal(np.squeeze(data[name]), record.points[name])


@pytest.fixture(params=["folder", "store"])
def place(request, tmp_path):
    """An empty local folder, or an empty place without folders and renames."""
    yield str(tmp_path / "set") if request.param == "folder" else "memory://records/set"
    MemoryFileSystem.store.clear()
    MemoryFileSystem.pseudo_dirs[:] = [""]


def content(place):
    """Every file below a place, with its bytes."""
    filesystem, root = storage.open_place(place)
    return {name.removeprefix(root): filesystem.cat_file(name) for name in filesystem.find(root)}


def test_equal_objects_are_equal_bytes_and_each_file_has_its_checksum(place):
    layout.write_object(place, "made_up", made_up_record())
    found = {name.removeprefix("/objects/made_up/"): made for name, made in content(place).items()}
    assert found == layout.object_files(made_up_record())
    checksums = {name: hashlib.sha256(made).hexdigest() for name, made in found.items() if name != "object.json"}
    assert json.loads(found["object.json"])["files"] == checksums
    assert set(checksums) == {"points.ply", "transforms.json"} | {
        f"{kind}/00{view}.png" for kind in ("images", "conditions") for view in (0, 1)
    }


def test_an_object_that_fails_half_way_does_not_count_and_is_made_again(place, monkeypatch):
    files = layout.object_files(made_up_record())

    class FullDisk(bytes):
        pass

    def fail(write):
        def limited(*arguments):
            if isinstance(arguments[-1], FullDisk):
                raise OSError(28, "No space left on device")
            return write(*arguments)

        return limited

    monkeypatch.setattr(Path, "write_bytes", fail(Path.write_bytes))
    monkeypatch.setattr(MemoryFileSystem, "pipe_file", fail(MemoryFileSystem.pipe_file))
    with pytest.raises(OSError, match="No space left"):
        storage.write_object_folder(
            f"{place}/objects", "made_up", {**files, "conditions/001.png": FullDisk(), "object.json": b""}
        )
    assert storage.list_completed(place) == set()
    if not place.startswith("memory"):
        assert list(Path(place).rglob("*")) == [Path(place) / "objects"]
    layout.write_object(place, "made_up", made_up_record())
    assert storage.list_completed(place) == {"made_up"}
    assert {name.removeprefix("/objects/made_up/"): made for name, made in content(place).items()} == files


def test_a_finished_object_is_not_written_again(place):
    layout.write_object(place, "made_up", made_up_record(seed=0))
    before = content(place)
    layout.write_object(place, "made_up", made_up_record(seed=1))
    assert content(place) == before
    assert storage.list_completed(place) == {"made_up"}
    assert storage.has_object(place, "made_up")
    assert not storage.has_object(place, "other")


def test_a_folder_that_is_no_object_is_in_the_way_and_said_to_be(tmp_path):
    (tmp_path / "objects/made_up/notes").mkdir(parents=True)
    assert storage.list_completed(tmp_path) == set()
    with pytest.raises(ValueError, match="made_up is in the way"):
        layout.write_object(tmp_path, "made_up", made_up_record())


def test_unfinished_folders_of_the_dead_are_removed_and_those_of_the_living_stay(tmp_path):
    layout.write_object(tmp_path, "made_up", made_up_record())
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host = socket.gethostname()
    names = [f"{host}-{dead.pid}-x", f"{host}-{os.getpid()}-x", "other-host-1-old", "other-host-1-new", "odd"]
    for name in names:
        (tmp_path / "objects" / f"{storage.UNFINISHED}{name}").mkdir()
    long_ago = time.time() - 2 * storage.STALE
    for name in ("other-host-1-old", "odd"):
        os.utime(tmp_path / "objects" / f"{storage.UNFINISHED}{name}", (long_ago, long_ago))
    assert storage.list_completed(tmp_path) == {"made_up"}
    storage.remove_unfinished(tmp_path)
    left = {path.name.removeprefix(storage.UNFINISHED) for path in (tmp_path / "objects").iterdir()}
    assert left == {"made_up", names[1], "other-host-1-new"}


def test_a_text_file_is_replaced_as_a_whole_and_leaves_nothing_beside_it(place):
    for text in ("first", "2nd"):
        layout.write_text(f"{place}/splits/train.txt", text)
    assert content(place) == {"/splits/train.txt": b"2nd"}
    assert storage.read_file(f"{place}/splits/train.txt") == b"2nd"
    assert storage.read_file(f"{place}/splits/other.txt") is None


def test_a_url_that_nothing_opens_is_refused():
    with pytest.raises(ValueError, match="nowhere://x: no such place can be opened"):
        storage.open_place("nowhere://x")


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        ("points.ply", lambda whole: whole[:-5], r"points\.ply: expected 20 points.*cut off"),
        ("points.ply", lambda whole: b"ply\nformat ascii 1.0\nend_header\n", "another header"),
        ("a.png", lambda whole: b"\x89PNG\r\n\x1a\nbroken", r"a\.png: not a readable PNG"),
    ],
)
def test_damaged_files_are_refused_with_their_name(name, damage, words, tmp_path):
    (tmp_path / name).write_bytes(damage(layout.encode_points(made_up_record().points)))
    with pytest.raises(ValueError, match=words):
        (layout.read_points if name.endswith("ply") else layout.read_image)(tmp_path / name)
