"""Cameras of files: what was written is read again; what is no camera is refused in one line."""

import copy
import json

import jax.numpy as jnp
import numpy as np
import pytest

from spnr_jax.formats.camera_files import describe_cameras, read_cameras
from spnr_jax.formats.orientation import ROTATIONS
from spnr_jax.kernels.cameras import look_at, pinhole

TURN, ORIGIN = np.array(ROTATIONS["z"], float), np.array([461_000.0, 5_280_000.0, 300.0])
EYES = ((0.0, 1.0, 3.0), (3.0, 1.0, 0.5))


def cameras(heights=(20, 20)):
    poses = [look_at(jnp.array(eye), jnp.zeros(3), jnp.array([0.0, 1.0, 0.0])) for eye in EYES]
    return [pinhole(pose, 0.7, height, 24) for pose, height in zip(poses, heights, strict=True)]


def write(folder, document):
    (folder / "c.json").write_text(document if isinstance(document, str) else json.dumps(document))
    return folder / "c.json"


@pytest.mark.parametrize("heights", [(20, 20), (20, 30)])  # equal intrinsics are written once
def test_cameras_that_were_written_far_from_the_origin_are_read_again(tmp_path, heights):
    written = cameras(heights)
    document = describe_cameras(written, ["a.png", "b.png"], TURN, ORIGIN)
    assert ("h" in document) == (heights[0] == heights[1])
    for one, other in zip(written, read_cameras(write(tmp_path, document), rotation=TURN, origin=ORIGIN), strict=True):
        np.testing.assert_allclose(other.cam_to_world, one.cam_to_world, atol=1e-6)
        np.testing.assert_array_equal(other.intrinsics, one.intrinsics)
        assert (other.height, other.width) == (one.height, one.width)


def test_an_angle_of_view_gives_the_focal_length_distortion_is_said_and_cameras_without_a_size_are_square(tmp_path):
    frames, lines = describe_cameras(cameras(), ["a", "b"], np.eye(3), np.zeros(3))["frames"], []
    document = {"camera_angle_x": 0.7, "w": 24, "h": 20, "k1": 0.1, "frames": frames}
    for one, other in zip(cameras(), read_cameras(write(tmp_path, document), report=lines.append), strict=True):
        np.testing.assert_allclose(other.intrinsics, one.intrinsics, rtol=1e-6)
    assert lines == ["lens distortion is left out: pinhole cameras are drawn"]
    one, _ = read_cameras(write(tmp_path, {"camera_angle_x": 0.7, "frames": frames}), size=100)  # as NeRF wrote it
    assert (one.width, one.height) == (100, 100)
    focal = 50 / np.tan(0.35)
    np.testing.assert_allclose(one.intrinsics, [[focal, 0, 50], [0, focal, 50], [0, 0, 1]], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda d: d.pop("fl_x"), "no entry 'fl_x'"),
        (lambda d: d.pop("w"), "no entry 'w'"),
        (lambda d: d.update(frames=[]), "no frames"),
        (lambda d: d.update(frames=[3]), "no frames"),
        (lambda d: d.update(w=0), "0 x 20 pixels in frame 0"),
        (lambda d: d.update(w="wide"), "where a number should be"),
        (lambda d: d.update(fl_x=None), "where a number should be"),
        (lambda d: d.update(fl_y=-1), "expected positive ones"),
        (lambda d: d.update(camera_model="OPENCV_FISHEYE"), "where pinhole cameras are drawn"),
        (lambda d: d.update(camera_model="FISHEYE624"), "FISHEYE624, where pinhole cameras are drawn"),
        (lambda d: d.update(is_fisheye=True), "a fisheye, where pinhole cameras are drawn"),
        (lambda d: d["frames"][1]["transform_matrix"].pop(), None),  # three rows suffice
        (lambda d: d["frames"][1]["transform_matrix"].clear(), "no 4 x 4 matrix (frame 1)"),
        (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(0, float("nan")), "NaN or infinity"),
        (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(3, 1e39), "NaN or infinity"),
        (lambda d: d.update(fl_x=1e300), "NaN or infinity"),
        (lambda d: d.update(fl_y=1e-300), "expected positive ones"),
        (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(0, 7.0), "frame 1 is not orthonormal"),
        (lambda d: [row.__setitem__(0, -row[0]) for row in d["frames"][0]["transform_matrix"]], "frame 0 is not"),
    ],
)
def test_what_is_no_camera_is_named(tmp_path, change, reason):
    document = copy.deepcopy(describe_cameras(cameras(), ["a", "b"], TURN, ORIGIN))
    change(document)
    path = write(tmp_path, document)
    if reason is None:
        assert len(read_cameras(path)) == 2
        return
    with pytest.raises(ValueError, match=r"c\.json: .*; expected the transforms\.json") as error:
        read_cameras(path)
    assert reason in str(error.value)


@pytest.mark.parametrize("content", ["", "[" * 100_000, "3", "\x00"])
def test_another_file_is_refused_in_one_line(tmp_path, content):
    with pytest.raises(ValueError, match=r"c\.json: .*expected the transforms\.json"):
        read_cameras(write(tmp_path, content))
    with pytest.raises(ValueError, match=r"none\.json: No such file"):
        read_cameras(tmp_path / "none.json")
