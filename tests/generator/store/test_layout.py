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
from support import tiny_dataset
from support.folders import contents

from data_gen.store import check, layout
from spnr_jax.formats import data_sets


def made_up_record(seed=0):
    return tiny_dataset.ball(seed, size=8)


def test_an_object_reads_back_as_it_was_written(tmp_path):
    record = made_up_record()
    layout.write_object(tmp_path, "made_up", record)
    found = data_sets.read_object(data_sets.Dataset(folder=tmp_path, settings={}, splits={}), "made_up")
    np.testing.assert_array_equal(found.images, record.images)
    np.testing.assert_array_equal(found.conditions, record.conditions)
    poses = [frame["transform_matrix"] for frame in record.transforms["frames"]]
    np.testing.assert_array_equal(found.camera.cam_to_world, np.float32(poses)[:, :3])
    assert check.read_details(tmp_path, "made_up").items() >= record.details.items()


def test_equal_objects_are_equal_bytes_and_each_file_has_its_checksum(tmp_path):
    layout.write_object(tmp_path, "made_up", made_up_record())
    found = contents(tmp_path / "objects" / "made_up")
    assert found == layout.object_files(made_up_record())
    checksums = {name: hashlib.sha256(made).hexdigest() for name, made in found.items() if name != "object.json"}
    assert json.loads(found["object.json"])["files"] == checksums
    assert set(checksums) == {"points.ply", "transforms.json"} | {
        f"{kind}/00{view}.png" for kind in ("images", "conditions") for view in range(tiny_dataset.VIEWS)
    }


def test_an_object_that_fails_half_way_does_not_count_and_is_made_again(tmp_path, monkeypatch):
    whole = Path.write_bytes

    def write(path, data):
        if path.name == "001.png":
            raise OSError(28, "No space left on device")
        return whole(path, data)

    monkeypatch.setattr(Path, "write_bytes", write)
    with pytest.raises(OSError, match="No space left"):
        layout.write_object(tmp_path, "made_up", made_up_record())
    monkeypatch.undo()
    assert layout.list_completed(tmp_path) == set()
    assert list(tmp_path.rglob("*")) == [tmp_path / "objects"]
    layout.write_object(tmp_path, "made_up", made_up_record())
    assert layout.list_completed(tmp_path) == {"made_up"}


def test_a_finished_object_is_not_written_again(tmp_path):
    layout.write_object(tmp_path, "made_up", made_up_record(seed=0))
    before = contents(tmp_path)
    layout.write_object(tmp_path, "made_up", made_up_record(seed=1))
    assert contents(tmp_path) == before
    assert [layout.has_object(tmp_path, name) for name in ("made_up", "other")] == [True, False]


def test_a_folder_that_is_no_object_is_in_the_way_and_said_to_be(tmp_path):
    (tmp_path / "objects/made_up/notes").mkdir(parents=True)
    assert layout.list_completed(tmp_path) == set()
    with pytest.raises(ValueError, match="made_up is in the way"):
        layout.write_object(tmp_path, "made_up", made_up_record())


def test_unfinished_folders_of_the_dead_are_removed_and_those_of_the_living_stay(tmp_path):
    layout.write_object(tmp_path, "made_up", made_up_record())
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host = socket.gethostname()
    names = [f"{host}-{dead.pid}-x", f"{host}-{os.getpid()}-x", "other-host-1-old", "other-host-1-new", "odd"]
    for name in names:
        (tmp_path / "objects" / f"{layout.UNFINISHED}{name}").mkdir()
    long_ago = time.time() - 2 * layout.STALE
    for name in ("other-host-1-old", "odd"):
        os.utime(tmp_path / "objects" / f"{layout.UNFINISHED}{name}", (long_ago, long_ago))
    assert layout.list_completed(tmp_path) == {"made_up"}
    layout.remove_unfinished(tmp_path)
    left = {path.name.removeprefix(layout.UNFINISHED) for path in (tmp_path / "objects").iterdir()}
    assert left == {"made_up", names[1], "other-host-1-new"}
