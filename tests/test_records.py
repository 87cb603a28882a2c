"""Laws of the files: what is written is what is read, whole or not at all."""

import json

import numpy as np
import pytest

from data_gen import records


def made_up_record(views=2, resolution=8, num_points=20, seed=0):
    rng = np.random.default_rng(seed)
    points = np.zeros(num_points, records.POINT_TYPE)
    for name in records.POINT_FIELDS:
        points[name] = rng.random(num_points)
    points["face"] = rng.integers(0, 2**30, num_points)
    pictures = rng.integers(0, 256, (2, views, resolution, resolution, 4), dtype=np.uint8)
    poses = np.tile(np.eye(4), (views, 1, 1))
    return records.ObjectRecord(
        points=points,
        transforms=records.nerf_transforms(poses, resolution, 40.0, 11.0),
        images=pictures[0],
        conditions=pictures[1],
        details={"id": "made_up", "category": "object", "ignored": []},
    )


def test_an_object_reads_back_as_it_was_written(tmp_path):
    record = made_up_record()
    records.write_object(tmp_path, "made_up", record)
    found = records.read_object(tmp_path / "objects" / "made_up")
    assert found.points.tobytes() == record.points.tobytes()
    np.testing.assert_array_equal(found.images, record.images)
    np.testing.assert_array_equal(found.conditions, record.conditions)
    assert found.transforms == record.transforms
    assert {**found.details, "files": None} == {**record.details, "files": None}


def test_other_readers_of_ply_find_the_points(tmp_path):
    import trimesh

    record = made_up_record()
    records.write_points(tmp_path / "points.ply", record.points)
    cloud = trimesh.load(tmp_path / "points.ply")
    np.testing.assert_array_equal(cloud.vertices, records.point_columns(record.points, "x", "y", "z"))
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    for name in records.POINT_TYPE.names:
        np.testing.assert_array_equal(np.squeeze(data[name]), record.points[name])


def test_equal_objects_are_equal_bytes_and_each_file_has_its_checksum(tmp_path):
    for folder in ("a", "b"):
        records.write_object(tmp_path / folder, "made_up", made_up_record())
    first, second = (records.file_checksums(tmp_path / folder / "objects" / "made_up") for folder in ("a", "b"))
    assert first == second
    details = json.loads((tmp_path / "a/objects/made_up/object.json").read_text())
    assert details["files"] == first
    assert set(first) == {"points.ply", "transforms.json"} | {
        f"{kind}/00{view}.png" for kind in ("images", "conditions") for view in (0, 1)
    }


def test_an_object_that_fails_half_way_leaves_nothing_behind(tmp_path, monkeypatch):
    def full_disk(path, points):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(records, "write_points", full_disk)
    with pytest.raises(OSError, match="No space left"):
        records.write_object(tmp_path, "made_up", made_up_record())
    assert list((tmp_path / "objects").iterdir()) == []


def test_a_finished_object_is_not_written_again(tmp_path):
    records.write_object(tmp_path, "made_up", made_up_record(seed=0))
    records.write_object(tmp_path, "made_up", made_up_record(seed=1))
    found = records.read_object(tmp_path / "objects" / "made_up")
    assert found.points.tobytes() == made_up_record(seed=0).points.tobytes()
    assert records.completed_objects(tmp_path) == {"made_up"}


def test_unfinished_folders_do_not_count_as_objects_and_are_removed(tmp_path):
    records.write_object(tmp_path, "made_up", made_up_record())
    (tmp_path / "objects" / f"{records.UNFINISHED}x").mkdir()
    assert records.completed_objects(tmp_path) == {"made_up"}
    records.remove_unfinished(tmp_path)
    assert [path.name for path in (tmp_path / "objects").iterdir()] == ["made_up"]


def test_damaged_files_are_refused_with_their_name(tmp_path):
    path = tmp_path / "points.ply"
    records.write_points(path, made_up_record().points)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ValueError, match=r"points\.ply: expected 20 points.*cut off"):
        records.read_points(path)
    path.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(ValueError, match="another header"):
        records.read_points(path)
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    with pytest.raises(ValueError, match=r"a\.png: not a readable PNG"):
        records.read_image(tmp_path / "a.png")
