"""Files as people have them, of every kind that went wrong in reports about other tools: what becomes of each.

The small files are made here.  `test_all_reported_files` reads those of `../shared/data/reports`, where they are at
hand, prints what becomes of each, and keeps the table of docs/lab/everyday_files.md true.
"""

import os
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from support.gltf_files import GltfBuilder
from support.mesh_files import CORNERS, OBJ_FACE, RGB, SQUARE, square_ply, stl
from support.point_clouds import BALL, GREEN, LINEAR, read, write, write_rows

from spnr_jax.config import Cut
from spnr_jax.formats import clouds
from spnr_jax.formats.clouds import place_cloud, read_cloud
from spnr_jax.kernels import cloud_arrays
from spnr_jax.kernels.cloud_arrays import merge_repeats
from spnr_jax.surfels.sides import spiral

ROOT = Path(__file__).parents[2]
REPORTS = ROOT.parent / "shared" / "data" / "reports"
PAGE = ROOT / "docs" / "lab" / "everyday_files.md"
UTM = np.array([500_000.123, 5_200_000.377, 120.0])


def test_points_of_a_scene_lie_where_their_nodes_put_them_and_splats_are_refused(tmp_path):
    builder, extension, ball = GltfBuilder(), "KHR_gaussian_splatting", BALL.astype("f4")
    points = builder.primitive(ball, None, mode=0)
    builder.mesh(points, scale=[2, 2, 2])
    turned = builder.primitive(ball, np.arange(3, dtype="u2"), mode=0, NORMAL=ball, material=0)
    builder.document["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [*LINEAR, 1]}}]
    builder.mesh(turned, rotation=[0, 0, 0.5**0.5, 0.5**0.5])
    (cloud, _), turn = read(builder.write(tmp_path / "a.glb")), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(cloud.positions, [*2 * BALL, *BALL[:3] @ np.transpose(turn)], atol=1e-6)
    np.testing.assert_allclose(cloud.base_color, [*420 * [[1, 1, 1]], *3 * [LINEAR]], atol=1e-6)
    assert not cloud.normals[:420].any()
    points["attributes"]["NORMAL"] = turned["attributes"]["NORMAL"]
    normals = read(builder.write(tmp_path / "a.glb"))[0].normals
    np.testing.assert_allclose(normals[[0, 1, 420]], [*BALL[:2], BALL[0] @ np.transpose(turn)], atol=1e-3)
    points["extensions"] = {extension: {"colorSpace": "lin_rec709_display"}}
    with pytest.raises(ValueError, match=rf"Gaussian splats \({extension}\), which are not read: convert it to .ply"):
        read_cloud(builder.write(tmp_path / "a.glb"))


def with_lists(form: str) -> bytes:
    """A PLY file of three points, with a list before and one among their properties."""
    head = f"ply\nformat {form} 1.0\nelement edge 2\nproperty list uchar short ends\nelement vertex 3\n"
    head += "property float x\nproperty list uchar int near\nproperty float y\nproperty float z\nend_header\n"
    rows = [(1.5, [1, 2], 2, 0), (0, [], 1, 1), (4, [7], 0, 1)]
    if form == "ascii":
        lines = ["2 0 1", "1 5", *(" ".join(map(str, [x, len(near), *near, y, z])) for x, near, y, z in rows)]
        return (head + "\n".join(lines) + "\n").encode()
    order = "<" if "little" in form else ">"
    body = struct.pack(f"{order}BhhBh", 2, 0, 1, 1, 5)
    for x, near, y, z in rows:
        body += struct.pack(f"{order}fB{len(near)}iff", x, len(near), *near, y, z)
    return head.encode() + body


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_lists_in_or_before_the_vertices_of_a_ply_are_stepped_over(tmp_path, form):
    cloud, lines = read(write(tmp_path, "a.ply", with_lists(form)))
    np.testing.assert_allclose(cloud.positions, [[1.5, 2, 0], [0, 1, 1], [4, 0, 1]])
    assert "columns that are not used: near (lists)" in lines
    cut = with_lists(form)[:-9]
    with pytest.raises(ValueError, match="cut off|expected 3 numbers"):
        read_cloud(write(tmp_path, "a.ply", cut))


def test_a_header_of_bare_carriage_returns_ends_before_data_that_begins_with_a_line_feed(tmp_path):
    head = "ply\rformat binary_little_endian 1.0\relement vertex 3\r"
    head += "property float x\rproperty float y\rproperty float z\rend_header\r"
    rows = np.array([[0, 1, 2], [3, 4, 5], [3, 0, 1]], "<f4")
    rows.view("u1")[0, 0] = 0x0A
    cloud = read_cloud(write(tmp_path, "a.ply", head.encode() + rows.tobytes()))
    np.testing.assert_array_equal(cloud.positions, rows)


# Colours: one function for points and meshes

PACKED = GREEN[0] << 16 | GREEN[1] << 8 | GREEN[2]
BYTES = square_ply("uchar", RGB, GREEN)
COLORED_MESHES = {
    "ushort": ("a.ply", square_ply("ushort", RGB, [257 * c for c in GREEN])),
    "floats to 255": ("a.ply", square_ply("float", RGB, GREEN)),
    "r g b": ("a.ply", square_ply("uchar", "rgb", GREEN)),
    "packed": ("a.ply", square_ply("uint", ["rgb"], [PACKED])),
    "COFF": ("a.off", "COFF\n4 1 0\n" + "".join(f"{c} 40 170 60 255\n" for c in CORNERS) + "4 0 1 2 3\n"),
    "OFF with colours": ("a.off", "OFF\n4 1 0\n" + "".join(f"{c} 40 170 60\n" for c in CORNERS) + "4 0 1 2 3\n"),
    "OBJ, weights of the vertices": ("a.obj", "".join(f"v {c} 1 40 170 60\n" for c in CORNERS) + OBJ_FACE),
    "OFF, colours of faces": ("a.off", "OFF\n4 1 0\n" + "\n".join(CORNERS) + "\n4 0 1 2 3 40 170 60\n"),
    "triangles and a polygon of four corners": ("a.ply", BYTES.replace("face 2", "face 3") + "4 0 1 2 3\n"),
    "strip": ("a.ply", BYTES[:-16].replace("face 2", "tristrips 1") + "5 0 1 3 2 -1\n"),
    "STOFF": ("a.off", "STCOFF\n4 1 0\n" + "".join(f"{c} 40 170 60 255 0 1\n" for c in CORNERS) + "4 0 1 2 3\n"),
    "OBJ of bare CR": ("a.obj", ("".join(f"v {c} 40 170 60\n" for c in CORNERS) + OBJ_FACE).replace("\n", "\r")),
    "OBJ with a byte order mark": ("a.obj", "\ufeff" + "".join(f"v {c} 40 170 60\n" for c in CORNERS) + OBJ_FACE),
    "OBJ named .ply": ("a.ply", "# made\n" + "".join(f"v {c} 40 170 60\n" for c in CORNERS) + OBJ_FACE),
    "MeshLab's OFF": ("a.off", "NCOFF\n4 1 0\n" + "".join(f"{c} 40 170 60 9 0 0 1\n" for c in CORNERS) + "4 0 1 2 3\n"),
    "OBJ of ZBrush": ("a.obj", "".join(f"v {c}\n" for c in CORNERS) + "#MRGB " + 4 * "ff28aa3c" + "\n" + OBJ_FACE),
    "OBJ": ("a.obj", "".join(f"v {c} 0.157 0.667 0.235\n" for c in CORNERS) + OBJ_FACE),
}


@pytest.mark.parametrize("case", COLORED_MESHES)
def test_the_colours_of_a_mesh_are_read_as_those_of_points(tmp_path, case):
    cloud, lines = read(write(tmp_path, *COLORED_MESHES[case]), num_points=50)
    np.testing.assert_allclose(cloud.base_color, np.broadcast_to(LINEAR, (50, 3)), atol=2e-3)
    assert any("taken as sRGB in 0.." in line for line in lines)


@pytest.mark.parametrize(("kind", "white"), [("u1", 255), ("u2", 65535), ("f4", 1)])
def test_colours_of_a_scene_are_told_whatever_numbers_hold_them(tmp_path, kind, white):
    colors = np.tile(LINEAR if white == 1 else np.round(LINEAR * white), (420, 1)).astype(kind)
    for positions, mode, indices in ((BALL.astype("f4"), 0, None), (SQUARE.astype("f4"), 4, [0, 1, 2, 0, 2, 3])):
        builder, indices = GltfBuilder(), indices and np.array(indices, "u2")
        builder.mesh(builder.primitive(positions, indices, mode=mode, COLOR_0=colors[: len(positions)]))
        cloud, _ = read(builder.write(tmp_path / "a.glb"), num_points=420)
        np.testing.assert_allclose(cloud.base_color, np.broadcast_to(LINEAR, (420, 3)), atol=3e-3)
    builder, hidden = GltfBuilder(), np.column_stack([colors, np.where(PART, 0, white)]).astype(kind)
    builder.mesh(builder.primitive(BALL.astype("f4"), None, mode=0, COLOR_0=hidden))
    np.testing.assert_allclose(read_cloud(builder.write(tmp_path / "a.glb")).positions, BALL[~PART], atol=1e-6)


def colored_ball(folder, colors=GREEN, kind: str = "<u2", **more: np.ndarray):
    """A file of the ball with colours, one or (420, 3), and other columns."""
    colors = np.broadcast_to(colors, (420, 3)).astype(kind)
    return write_rows(folder, BALL, **dict(zip(RGB, colors.T, strict=True)), **more)


RANGES = (0.39, None, 100), (1, None, 255), (1, 65535, 255), (1, 256, 255), (16, None, 4095), (257, None, 65535)


@pytest.mark.parametrize(("factor", "stray", "white"), RANGES)
def test_the_range_of_colours_is_that_of_nearly_all_of_them(tmp_path, factor, stray, white):
    colors = np.tile(np.array([200, *GREEN[1:]]) * factor, (420, 1))
    if stray:
        colors[7] = stray
    cloud, lines = read(colored_ball(tmp_path, colors, "<f8" if factor < 1 else "<u2"))
    assert f"red green blue taken as sRGB in 0..{white}" in lines
    assert cloud.base_color[0, 0] == pytest.approx(0.578, abs=0.03)
    assert any("cut off there" in line for line in lines) == (stray is not None)


def test_points_without_colour_among_others_take_that_of_their_neighbours_and_black_parts_stay(tmp_path):
    colors = np.tile(GREEN, (420, 1))
    colors[::2] = 0
    cloud, lines = read(colored_ball(tmp_path, colors))
    np.testing.assert_allclose(cloud.base_color, np.broadcast_to(LINEAR, (420, 3)), atol=2e-3)
    assert any(line.startswith("210 of 420 points have no colour") for line in lines)
    colors = np.where(BALL[:, :1] > 0, 0, GREEN)
    cloud, lines = read(colored_ball(tmp_path, colors))
    assert (cloud.base_color[BALL[:, 0] > 0] == 0).all()
    assert not any("no colour (0 0 0)" in line for line in lines)
    assert any("nearly black" in line for line in read(colored_ball(tmp_path, 3, "u1"))[1])


# What other columns say

PART = np.arange(420) % 3 == 0
F_DC = dict.fromkeys(("f_dc_0", "f_dc_1", "f_dc_2"), np.zeros(420))  # of splats
HIDDEN, BROKEN = r"140 of 420 points left out: .* \(--keep-noise keeps them\)", "140 of 420 points left out: NaN"
SEEN = {  # columns of the ball, points that are left, what a line says
    "alpha": ({"alpha": np.where(PART, 0, 255).astype(np.uint8)}, ~PART, HIDDEN),
    "opacity": ({"opacity": np.where(PART, 0.001, 0.9)}, ~PART, HIDDEN),
    "opacity before the logistic function": ({"opacity": np.where(PART, -6.0, 3.0)}, ~PART, HIDDEN),
    "noise of CloudCompare": ({"scalar_Classification": np.where(PART, 7.0, 2.0)}, ~PART, HIDDEN),
    "noise": ({"classification": np.where(PART, 18, 6).astype(np.uint8)}, ~PART, HIDDEN),
    "withheld": ({"withheld": PART.astype(np.uint8)}, ~PART, HIDDEN),
    "a name in other letters": ({"Red": PART, "label": PART, "Label": PART}, ..., ".* Red .again., l"),
    "alpha 0 everywhere": ({"alpha": np.zeros(420, np.uint8)}, ..., "red green blue taken"),
    "noise everywhere": ({"classification": np.full(420, 7, np.uint8)}, ..., "all points kept, though"),
    "splats without a number": (F_DC | {"opacity": np.where(PART, np.nan, 3.0)}, ~PART, BROKEN),
    "activated splats": (F_DC | {"opacity": np.where(PART, 0.1, 0.9)}, ~PART, HIDDEN),
    "half transparent splats": (F_DC | {"opacity": np.full(420, 0.5)}, ..., "red green blue taken"),
    "splats of bytes": (F_DC | {"opacity": np.where(PART, 9, 250.0)}, ~PART, HIDDEN),
    "splats of which none is half transparent": (F_DC | {"opacity": np.where(PART, 3.5, 70.5)}, ..., "red green blue"),
    "splats of 0 and 1": (F_DC | {"opacity": np.where(PART, -np.inf, np.inf)}, ~PART, HIDDEN),
}


@pytest.mark.parametrize("case", SEEN)
def test_what_is_not_to_be_seen_is_left_out_with_a_line_and_kept_on_demand(tmp_path, case):
    columns, left, words = SEEN[case]
    path = colored_ball(tmp_path, **columns)
    cloud, lines = read(path)
    np.testing.assert_allclose(cloud.positions, BALL[left], atol=1e-6)
    assert any(re.match(words, line) for line in lines)
    kept = read_cloud(path, cut=Cut(keep_noise=True)).positions
    assert len(kept) == (280 if words == BROKEN else 420)


# Precision, repeats


@pytest.mark.parametrize("size", [1e-6, 1e-4, 0.3, 30])
def test_small_clouds_keep_their_shape_wherever_they_lie(tmp_path, size):
    points = np.array([11.5712345, 48.1412345, 0.03]) + size * BALL
    np.save(tmp_path / "a.npy", points)
    placed = place_cloud(tmp_path / "a.npy", up="y")
    np.testing.assert_allclose(placed.cloud.positions + placed.origin, points, rtol=0, atol=1e-5 * size)


def test_meshes_at_map_coordinates_keep_their_shape(tmp_path):
    content = "".join("v {:.4f} {:.4f} {:.4f}\n".format(*(UTM + 0.2 * corner)) for corner in SQUARE) + OBJ_FACE
    floats_in_text = square_ply("float", RGB, (0, 1, 0), UTM + 0.2 * SQUARE)
    for name, text in (("a.obj", content), ("a.ply", floats_in_text)):
        placed = place_cloud(write(tmp_path, name, text), num_points=3000, up="y")
        np.testing.assert_allclose(np.ptp(placed.cloud.positions, axis=0), [0.2, 0.2, 0], atol=2e-3)
        back = placed.cloud.positions.astype(np.float64) @ placed.rotation + placed.origin
        assert np.abs(back - (UTM + [0.1, 0.1, 0])).max() < 0.1001
        assert len(np.unique(placed.cloud.positions[:, 1])) > 2000


def test_the_origin_is_that_of_what_is_cut_out_and_cleaned(tmp_path):
    far = np.array([[-4e6, 0, 0], [4e6, 0, 0], [0, 5e6, 0]])
    scattered = np.random.default_rng(0).uniform(-4e6, 4e6, (100, 3))
    for options, others in (({"cut": Cut(object="largest")}, scattered), ({"clean": "auto"}, far)):
        np.save(tmp_path / "a.npy", np.concatenate([0.3 * BALL + UTM, others]))
        placed = place_cloud(tmp_path / "a.npy", up="y", **options)
        back = placed.cloud.positions + placed.origin
        np.testing.assert_allclose(back, 0.3 * BALL + UTM, rtol=0, atol=1e-6)


def test_a_part_that_is_cut_out_of_a_mesh_keeps_its_digits_whatever_lies_far_away(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "CUT_MESH", 2**12)
    corners, small = np.concatenate([0.2 * SQUARE + UTM, 0.2 * SQUARE]), Cut(crop=(*(UTM - 1), *(UTM + 1)))
    content = "".join("v {:.4f} {:.4f} {:.4f}\n".format(*corner) for corner in corners)
    path = write(tmp_path, "a.obj", content + OBJ_FACE + "f 5 6 7 8\n")
    placed = place_cloud(path, num_points=300, up="y", cut=small)
    np.testing.assert_allclose(np.ptp(placed.cloud.positions, axis=0), [0.2, 0.2, 0], atol=0.01)
    assert len(np.unique(placed.cloud.positions[:, 1])) > 290


def test_a_stray_point_far_away_takes_no_digit_of_the_others(tmp_path):
    for count in (420, 5000):
        for ball, stray in ((spiral(count) + UTM, np.zeros(3)), (spiral(count), np.full(3, 1e7))):
            np.save(tmp_path / "a.npy", np.vstack([ball, stray]))
            placed = place_cloud(tmp_path / "a.npy", up="y")
            np.testing.assert_allclose(placed.cloud.positions[:count] + placed.origin, ball, rtol=0, atol=1e-6)
    np.save(tmp_path / "a.npy", np.vstack([BALL + UTM, np.zeros(3)]).astype("f4"))
    with pytest.raises(ValueError, match=r"0\.5 apart at best in float32, for an extent of 2"):
        read(tmp_path / "a.npy")


ROUNDED = np.column_stack([BALL[:, 0], np.round(3 * BALL[:, 1]) / 3, BALL[:, 2]])
FLAT, SHORT = BALL * [50, 0.05, 50] + [0, 3e3, 0], r"only \d+ distinct values along y: the file's numbers are 0\.0002"
PLATE, LEFT_OUT = np.random.default_rng(0).uniform(-1, 1, (420, 3)), "normals of the file left out: "
ACROSS = spiral(420)[:, [1, 2, 0]] * [1, -1, 1]
ANY = np.random.default_rng(1).choice([-1.0, 1.0], (420, 1))
SAID = {  # positions and perhaps normals, what a line about them says
    "degrees": (BALL * [5e-5, 5e-5, 8] + [8.5, 47.1, 400], "x and y look like degrees"),
    "a handful": (BALL[:5], "5 points alone tell next to no surface"),
    "many more": (BALL[:50], None),
    "rounded": (ROUNDED, "only 7 distinct values along y of 420 points: is it rounded?"),
    "rounded along each axis": (np.round(5 * BALL) / 5, "only 11 distinct values along x of 420 points"),
    "one value far away": (BALL * [1, 0, 1] + UTM, "only 1 distinct value along y of 420 points: is it rounded?"),
    "short floats": (FLAT.astype("f4"), SHORT),
    "short floats on a map": ((200 * BALL + UTM).astype("f4"), r"only \d+ distinct values along y: .* are 0\.5 apart"),
    "doubles that were short": ((20 * BALL + UTM).astype("f4").astype(float), r"only \d+ distinct .* are 0\.5 apart"),
    "short floats of a large ball": ((BALL + [0, 3e3, 0]).astype("f4"), None),
    "thin plate": (PLATE * [1, 1, 0.02], "the points lie in a plate 0.[34]\\d spacings thick: if both sides"),
    "thicker plate": (PLATE * [1, 1, 0.2], None),
    "plane": (PLATE * [1, 1, 0], None),
    "one normal": (np.column_stack([BALL, np.tile([0.0, 0, -1], (420, 1))]), f"{LEFT_OUT}all are the same"),
    "normals across": (np.column_stack([BALL, ACROSS]), f"{LEFT_OUT}they lie across the surface"),
    "normals of any sign": (np.column_stack([BALL, spiral(420) * ANY]), f"{LEFT_OUT}those of neighbours have opposite"),
    "normals of a thin shell": (np.column_stack([BALL * (1 + 1e-3 * ANY), spiral(420) * ANY]), None),
    "normals outwards": (np.column_stack([BALL, spiral(420)]), None),
    "normals inwards": (np.column_stack([BALL, -spiral(420)]), None),
}


@pytest.mark.parametrize("case", SAID)
def test_a_line_says_what_looks_wrong_with_positions_and_normals_which_are_left_out(tmp_path, case):
    table, words = SAID[case]
    np.save(tmp_path / "a.npy", table)
    cloud, lines = read(tmp_path / "a.npy")
    lines = [line for line in lines if not line.startswith(("no ", "moved by", "the 6 columns"))]
    assert bool(lines) == bool(words)
    assert not words or any(re.match(words, line) for line in lines)
    assert (cloud.normals is None) == (table.shape[1] == 3 or bool(words))


def test_a_mesh_of_short_floats_far_away_is_refused(tmp_path):
    with pytest.raises(ValueError, match="0.5 apart at best in float32, for an extent of 1; move them"):
        read(write(tmp_path, "a.stl", stl(2, at=UTM + [0, 0.3, 0.1])))
    ball = np.float32(BALL + [4_100_000.3, 520_000.7, 4_800_000.9]).reshape(-1, 3, 3)  # on the globe: all are rounded
    body = b"".join(np.zeros(3, "<f4").tobytes() + triangle.tobytes() + b"\0\0" for triangle in ball)
    with pytest.raises(ValueError, match="0.5 apart at best in float32"):
        read(write(tmp_path, "a.stl", bytes(80) + len(ball).to_bytes(4, "little") + body))


def test_a_mesh_far_away_with_whole_halves_is_not_taken_for_rounded(tmp_path):
    """A house in metres: each of its coordinates happens to be a short float."""
    cloud, _ = read(write(tmp_path, "a.stl", stl(2, at=np.array([500_000.5, 5_200_000.5, 120.0]))))
    assert np.ptp(cloud.positions, axis=0) == pytest.approx([1, 1, 0], abs=0.05)


def test_a_mesh_far_away_whose_file_has_six_digits_is_said_to_be_rounded(tmp_path):
    ball, faces = BALL * 10 + UTM, "".join(f"f {i} {i + 1} {i + 2}\n" for i in range(1, 419))
    for digits, rounded in (("g", True), (".3f", False)):
        vertices = "".join("v " + " ".join(f"{x:{digits}}" for x in point) + "\n" for point in ball)
        _, lines = read(write(tmp_path, "a.obj", vertices + faces), num_points=50)
        assert any(re.match("only 3 distinct values along y of", line) for line in lines) == rounded


def test_places_of_a_grid_without_data_are_left_out_and_heights_that_reach_so_low_are_not(tmp_path):
    fifth = (np.arange(420) % 5 == 0)[:, None] & [False, False, True]
    tables = {f"height is {z}": (np.where(fifth, z, BALL), 336) for z in (-9999, -32768, -99999)}
    tables["place is 0 0 0"] = np.where(fifth[:, 2:], 0, BALL), 336
    tables["height is low"] = np.vstack([[0, 0, -9999], 2e4 * BALL[1:]]), 420
    for what, (positions, left) in tables.items():
        np.save(tmp_path / "a.npy", positions)
        cloud, lines = read(tmp_path / "a.npy")
        assert len(cloud.positions) == left
        assert (f"84 points left out: their {what}, no data" in lines) == (left == 336)


@pytest.mark.parametrize("text", [True, False])
def test_rows_behind_those_that_a_header_announces_are_said(tmp_path, text):
    rows = np.column_stack([SQUARE, [0, 1, 2, 3]]).astype("<f4")
    names, body = "xyzi", "\n".join(" ".join(map(str, row)) for row in rows).encode() if text else rows.tobytes()
    ply = f"ply\nformat {'ascii' if text else 'binary_little_endian'} 1.0\nelement vertex COUNT\n"
    ply += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    pcd = f"VERSION .7\nFIELDS {' '.join(names)}\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS COUNT\n"
    pcd += f"DATA {'ascii' if text else 'binary'}\n"
    for name, head in (("a.ply", ply), ("a.pcd", pcd)):
        for count in (3, 4):
            _, lines = read(write(tmp_path, name, head.replace("COUNT", str(count)).encode() + body + b"\n"))
            said = "the header announces 3 points, 1 more stand behind them and are not read" in lines
            assert said == (count == 3)


def test_normals_of_a_mesh_that_lie_across_its_faces_are_left_out(tmp_path):
    for normals, kept in (([0, 0, -1], True), ([1, 0, 0], False)):
        content = square_ply("float", ("nx", "ny", "nz", "roughness"), (*normals, 1))
        cloud, lines = read(write(tmp_path, "a.ply", content), num_points=9)
        assert "ignored: roughness of vertices" in lines
        np.testing.assert_allclose(np.abs(cloud.normals), np.tile([0, 0, 1], (9, 1)), atol=1e-6)
        assert any("they lie across its faces" in line for line in lines) != kept


@pytest.mark.parametrize("jitter", [0.0, 1e-6])
def test_repeats_are_merged_before_anything_looks_at_neighbours(tmp_path, jitter):
    rng = np.random.default_rng(0)
    repeated = np.repeat(BALL, 6, axis=0) + jitter * rng.uniform(-1, 1, (2520, 3))
    rough = np.repeat(0.1 + np.arange(420) / 840, 6) + np.tile([-0.1, 0.1], 1260)
    np.savez(tmp_path / "a.npz", points=repeated, roughness=rough)
    cloud, lines = read(tmp_path / "a.npz", clean="auto")
    np.testing.assert_allclose(cloud.positions, BALL, atol=1e-5)
    np.testing.assert_allclose(cloud.roughness, 0.1 + np.arange(420) / 840, atol=1e-6)
    assert "2,100 of 2,520 points repeat others, and were merged with them" in lines


def test_crowds_of_nearly_equal_points_are_merged_as_pairs_are(monkeypatch):
    rng = np.random.default_rng(0)
    crowds = np.repeat(BALL, 6, axis=0) + 1e-6 * rng.uniform(-1, 1, (2520, 3))
    by_pairs = merge_repeats(crowds, {})
    monkeypatch.setattr(cloud_arrays, "CROWDED", 0)
    np.testing.assert_array_equal(merge_repeats(crowds, {})[0], by_pairs[0])
    monkeypatch.undo()
    one = 1e-7 * rng.normal(size=(20_000, 3))  # whose pairs would take 3 GB
    assert merge_repeats(np.concatenate([one, spiral(30_000)]), {})[2] > 19_900


# The reported files themselves


def becomes(path: Path) -> str:
    """What becomes of a file, in a line."""
    lines: list[str] = []
    try:
        cloud = read_cloud(path, up="y", report=lines.append)
    except ValueError as error:
        return f"refused: {str(error).removeprefix(f'{path}: ')}"
    plain = re.compile(r"no |\d+ points spread|moved by|.* taken as sRGB in 0..255$")
    said = [line for line in lines if not plain.match(line)]
    return "; ".join([f"{len(cloud.positions):,} points", *said])


@pytest.mark.skipif(not REPORTS.is_dir(), reason="the reported files are not beside the checkout (../shared)")
def test_all_reported_files_come_to_what_the_page_says():
    """SPNR_WRITE=1 writes the table of the page anew."""
    rows = [line.split("\t") for line in (REPORTS / "manifest.tsv").read_text().splitlines()[1:]]
    lines = ["| file | how it was made | what becomes of it |", "|---|---|---|"]
    for names, _, made, _ in rows:
        for name in names.split():
            outcome = becomes(REPORTS / name)
            print(f"{name}: {outcome}")
            lines.append(f"| `{name}` | {made} | {outcome} |")
    assert len(lines) >= 46
    page = PAGE.read_text()
    begin, end = page.index(lines[0]), page.index("\n\n", page.index(lines[0]))
    if os.environ.get("SPNR_WRITE"):
        PAGE.write_text(page[:begin] + "\n".join(lines) + page[end:])
    assert page[begin:end] == "\n".join(lines)
