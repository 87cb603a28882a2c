"""An object is found upright, turned as it may be; where the sensor stood is believed, and a picture comes upright."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.point_clouds import ply_bytes

from spnr_jax.formats.clouds import place_cloud, read_cloud
from spnr_jax.formats.orientation import ROTATIONS, find_up, sensor_of, standing
from spnr_jax.surfels.normals import estimate_normals
from spnr_jax.surfels.sides import spiral

AXES = ["view_px", "view_py", "view_pz", "y_axisx", "y_axisy", "y_axisz"]


def pcd(folder, points: np.ndarray, height: int = 1, viewpoint: str = "0 0 0 1 0 0 0"):
    """A PCD file of the points as a picture of so many rows."""
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points) // height}\n"
    head += f"HEIGHT {height}\nVIEWPOINT {viewpoint}\nPOINTS {len(points)}\nDATA binary\n"
    (folder / "a.pcd").write_bytes(head.encode() + points.astype("<f8").tobytes())
    return folder / "a.pcd"


def ply(folder, form: str, camera: list[float], names=AXES):
    """A PLY file of a ball behind a camera."""
    rows = [tuple(point) for point in spiral(300).tolist()]
    content = ply_bytes(form, rows=rows, properties=[(axis, "double") for axis in "xyz"], before=0)
    lines = "element camera 1\n" + "".join(f"property float {name}\n" for name in names)
    text = " ".join(map(str, camera)).encode() + b"\n"
    data = text if form == "ascii" else np.array(camera, "<f4" if "little" in form else ">f4").tobytes()
    head, body = content.split(b"end_header\n", 1)
    head = head.replace(b"element camera 0\nproperty float f\nproperty int id\n", lines.encode())
    (folder / "a.ply").write_bytes(head + b"end_header\n" + data + body)
    return folder / "a.ply"


def half_ball(away: float) -> np.ndarray:
    """The side of a ball that a camera sees from `away` along z."""
    points = spiral(600)
    return points[points[:, 2] * np.sign(away) > 0][:280] - [0, 0, away]


@pytest.mark.parametrize(("away", "up"), [(-4.0, "-y"), (4.0, "y")])
def test_a_depth_image_is_upright_and_its_normals_point_to_the_camera(tmp_path, away, up):
    seen = half_ball(away)
    placed = place_cloud(pcd(tmp_path, seen, height=20))
    assert placed.up == up
    normals = placed.cloud.normals @ placed.rotation
    assert np.all(np.sum(normals * -seen, axis=1) > 0)
    np.testing.assert_allclose(normals[100], seen[100] + [0, 0, away], atol=0.1)


def sensor(path):
    return sensor_of(path, path.suffix, read_cloud(path).positions.astype(np.float64), lambda line: None)


def test_the_viewpoint_that_every_writer_puts_there_is_believed_if_nothing_hides_the_points_from_it(tmp_path):
    ball = spiral(600) + [0, 0, 4]
    assert sensor(pcd(tmp_path, ball)) is None
    assert read_cloud(tmp_path / "a.pcd").normals is None
    seen = ball[ball[:, 2] < 3.75]
    assert sensor(pcd(tmp_path, seen)).up == "-y"
    assert np.all(np.sum(read_cloud(tmp_path / "a.pcd").normals * -seen, axis=1) > 0)
    assert sensor(pcd(tmp_path, seen, viewpoint="0.5 0 0 1 0 0 0")).place.tolist() == [0.5, 0, 0]
    lines: list[str] = []
    assert sensor_of(pcd(tmp_path, ball, viewpoint="0 0 9 1 0 0 0"), ".pcd", ball, lines.append) is None
    assert lines == ["the place of the sensor left out: from 0 0 9 few points are seen"]
    for viewpoint in ("nan 0 0 1 0 0 0", "1e300 0 0 1 0 0 0", "x y z", ""):
        assert sensor(pcd(tmp_path, seen, viewpoint=viewpoint)) is None


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_the_camera_of_a_ply_file_gives_the_sides_of_the_points_and_the_way_up(tmp_path, form):
    placed = place_cloud(ply(tmp_path, form, [0, 0.01, 0, 0.1, -0.9, 0.2]))
    assert placed.up == "-y"
    normals = placed.cloud.normals @ placed.rotation
    np.testing.assert_allclose(normals, -spiral(300), atol=0.1)  # seen from within
    assert read_cloud(ply(tmp_path, form, [0, 0, 0, 0, 1, 0])).normals is None  # as MeshLab puts it if it knows none


def table() -> np.ndarray:
    """Points of a table, y up: a plate on four legs."""
    rng = np.random.default_rng(0)
    plate = rng.uniform([-1, 0.98, -0.6], [1, 1, 0.6], (800, 3))
    corners = np.array([[-0.9, 0, -0.5], [0.9, 0, -0.5], [-0.9, 0, 0.5], [0.9, 0, 0.5]])
    legs = corners[np.arange(400) % 4] + rng.uniform([-0.05, 0, -0.05], [0.05, 1, 0.05], (400, 3))
    return np.concatenate([plate, legs])


def cone() -> np.ndarray:
    """Points of a cone that stands on its base, y up."""
    rng = np.random.default_rng(1)
    height, angle = 1 - np.sqrt(rng.uniform(size=900)), rng.uniform(0, 2 * np.pi, 900)
    radius = np.where(np.arange(900) % 3, 1 - height, np.sqrt(rng.uniform(size=900)))
    height = np.where(np.arange(900) % 3, height, 0)
    return np.stack([radius * np.cos(angle), 2 * height, radius * np.sin(angle)], axis=-1)


def aeroplane() -> np.ndarray:
    """Points of an aeroplane, y up: it stands on one wheel, and its broadest end is the tail."""
    rng = np.random.default_rng(2)
    boxes = np.array([[0.1, 0.1, 1], [1, 0.02, 0.15], [0.5, 0.02, 0.1], [0.02, 0.3, 0.1], [0.05, 0.05, 0.05]])
    middles = np.array([[0, 0, 0], [0, -0.05, 0.1], [0, 0.08, -1], [0, 0.3, -1], [0, -0.3, 0.5]])
    part = rng.choice(5, 1500, p=[0.4, 0.35, 0.15, 0.05, 0.05])  # body, wings, tail, fin, wheel
    on_box, thin = rng.uniform(-1, 1, (1500, 3)), np.array([0, 1, 1, 0, 1])[part]
    axis = np.where(part == 0, rng.integers(2, size=1500), thin)
    on_box[np.arange(1500), axis] = np.sign(on_box[np.arange(1500), axis])
    return middles[part] + boxes[part] * on_box


@pytest.mark.parametrize("up", "yz")
def test_what_stands_is_found_upright_unless_its_format_defines_its_axes(up):
    for positions in (table(), cone(), aeroplane()):
        turned = positions @ np.array(ROTATIONS[up])
        assert find_up(turned, ".ply")[0] == up
        assert [find_up(turned, kind)[0] for kind in (".glb", ".gltf", ".las", ".laz")] == ["y", "y", "z", "z"]


def test_the_size_and_place_of_the_object_do_not_matter():
    points = table()
    normals = estimate_normals(points, cKDTree(points))
    for axis in range(3):
        moved = standing(points * 1e5 + [3e5, 0, 7e5], normals, axis)
        np.testing.assert_allclose(moved, standing(points, normals, axis), atol=1e-6)


def test_points_on_a_line_or_alone_are_y_up():
    for positions in (np.zeros((1, 3)), np.linspace([0, 0, 0], [1, 2, 3], 50), np.ones((9, 3))):
        assert find_up(positions, ".xyz")[0] == "y"
