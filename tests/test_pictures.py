"""Every picture that was asked for lies where it was said, and a cloud in any file comes out as pictures."""

import numpy as np
import pytest
import tiny_dataset
from PIL import Image

from spnr_jax import pictures

OPTIONS = {
    "views": 2, "elevation": 20.0, "resolution": 24, "num_points": 30, "up": "y", "turntable": "gif", "frames": 5,
    "seed": 0,
    "quality": "best",
}  # fmt: skip
STILLS = {f"chair_{i:03d}{kind}.png" for i in range(2) for kind in ("", "_depth", "_acc")}


def cloud_file(folder, name="chair.xyz", count=40):
    points = np.random.default_rng(0).uniform(-1, 1, (count, 3))
    np.savetxt(folder / name, points)
    return folder / name


def rendered(cloud, out, **options):
    return list(pictures.render_file(cloud, tiny_dataset.run(), out, **OPTIONS | options))


def names(out):
    return {path.name for path in out.iterdir()}


def test_stills_depth_opacity_and_a_turntable_of_the_asked_frames_are_written(tmp_path):
    out = tmp_path / "new" / "out"
    lines = rendered(cloud_file(tmp_path), out)
    assert names(out) == STILLS | {"chair_turntable.gif"}
    for name in STILLS:
        with Image.open(out / name) as picture:
            assert picture.size == ((24, 24) if name.count("_") == 1 else (8, 8))
    with Image.open(out / "chair_turntable.gif") as film:
        assert film.n_frames == 5
    assert any("30 of 40 points" in line for line in lines)
    assert [line for line in lines if line.startswith("wrote")] == [
        f"wrote {out / name}" for name in ("chair_000.png", "chair_001.png", "chair_turntable.gif")
    ]


def test_a_name_with_dots_keeps_every_view(tmp_path):
    rendered(cloud_file(tmp_path, "chair.v2.xyz"), tmp_path / "out", turntable="none")
    assert names(tmp_path / "out") == {name.replace("chair", "chair.v2") for name in STILLS}


def test_the_views_are_different_and_the_same_again_at_the_second_time(tmp_path):
    cloud = cloud_file(tmp_path)
    for out in ("a", "b"):
        rendered(cloud, tmp_path / out)
    files = {name: (tmp_path / "a" / name).read_bytes() for name in names(tmp_path / "a")}
    assert files == {name: (tmp_path / "b" / name).read_bytes() for name in names(tmp_path / "b")}
    assert files["chair_000_depth.png"] != files["chair_001_depth.png"]


def test_no_views_and_no_turntable_write_nothing(tmp_path):
    rendered(cloud_file(tmp_path), tmp_path / "out", views=0, turntable="none")
    assert not (tmp_path / "out").exists()


def test_a_cloud_of_one_point_gives_pictures(tmp_path):
    (tmp_path / "chair.xyz").write_text("3 4 5\n")
    rendered(tmp_path / "chair.xyz", tmp_path / "out", turntable="none")
    assert names(tmp_path / "out") == STILLS


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ({"views": -1}, "--views must not be negative, got -1"),
        ({"frames": 0}, "--frames must be at least 1, got 0"),
        ({"num_points": 0}, "--num-points must be at least 1, got 0"),
        ({"resolution": 18}, "--resolution must be a multiple of 4 of at least 16, got 18"),
        ({"resolution": 8}, "--resolution must be a multiple of 4 of at least 16, got 8"),
    ],
)
def test_options_without_sense_are_refused_by_their_name_before_anything_is_read(option, expected, tmp_path):
    with pytest.raises(ValueError, match=expected):
        rendered(tmp_path / "missing.xyz", tmp_path / "out", **option)
