"""Files of points: one table through a writer of each format, and what is refused, in a line."""

import io
import pickle
import struct
import time
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from support.point_clouds import BALL, GREEN, LINEAR, SRGB, XYZRGB, ply_bytes, read, write
from support.point_tables import BROKEN, SOUND, WHOLE, WRITERS, as_npy, compress_lzf, written

from spnr_jax.formats import array_files, clouds, las, point_tables, row_files
from spnr_jax.formats.array_files import pack_arrays
from spnr_jax.formats.clouds import read_cloud
from spnr_jax.formats.point_files import column_pieces, kind_of
from spnr_jax.formats.row_files import decompress

PIECED = ("ascii.ply", "little.ply", "big.ply", "ascii.pcd", "binary.pcd", "a.xyz", "a.csv", "a.npy", "a.las")
ANNOUNCED = [name for name in WRITERS if name.rpartition(".")[2] in "ply pcd npy npz las laz off glb"]
ROUGH = [name for name in WRITERS if name.rpartition(".")[2] in "ply pcd xyz csv npy npz las laz"]


@pytest.mark.parametrize("name", WRITERS)
def test_a_table_comes_back_with_its_colours_linear_without_broken_rows_and_not_where_it_is_cut(tmp_path, name):
    cloud, lines = read(written(tmp_path, name, WHOLE))
    np.testing.assert_array_equal(cloud.positions, WHOLE.positions)
    np.testing.assert_allclose(cloud.base_color, SRGB[WHOLE.levels], atol=1e-5)
    np.testing.assert_allclose(cloud.roughness, WHOLE.roughness if name in ROUGH else 0.5)
    assert any(line.startswith("no roughness") for line in lines) == (name not in ROUGH)
    if not name.startswith("a.la"):
        cloud, lines = read(written(tmp_path, name, BROKEN))
        np.testing.assert_array_equal(cloud.positions, WHOLE.positions[SOUND])
        np.testing.assert_allclose(cloud.base_color, SRGB[WHOLE.levels[SOUND]], atol=1e-5)
        left_out = [line for line in lines if "left out" in line]
        assert left_out == ["3 of 12 points left out: NaN, infinity or too large a number"]


@pytest.mark.parametrize("name", PIECED)
def test_pieces_are_small_and_together_the_whole_file(tmp_path, name, monkeypatch):
    path = written(tmp_path, name, WHOLE)
    limits = (row_files, "PIECE_LINES", 5), (point_tables, "PIECE_LINES", 5), (array_files, "PIECE_BYTES", 5 * 35)
    for module, limit, size in limits:
        monkeypatch.setattr(module, limit, size)
    monkeypatch.setattr(row_files, "PIECE_BYTES", 5 * 31)
    monkeypatch.setattr(las, "PIECE_BYTES", 5 * 36)
    sizes = [len(next(iter(piece.values()))) for piece in column_pieces(path, kind_of(path), print)]
    assert len(sizes) > 2
    assert sum(sizes) == 12
    np.testing.assert_array_equal(read(path)[0].positions, WHOLE.positions)


@pytest.mark.parametrize("name", ANNOUNCED)
def test_what_says_how_much_it_holds_is_refused_wherever_it_is_cut(tmp_path, name):
    path = written(tmp_path, name, WHOLE)
    whole = path.read_bytes()
    for length in np.linspace(0, 0.8 * len(whole), 12, dtype=int):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"empty|cut off|broken|truncated|not an? |annou|expec") as refused:
            read(path)
        assert str(refused.value).startswith(f"{path}: ")
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_a_field_or_list_of_three_numbers_is_a_colour_by_its_name(tmp_path, data):
    pcd = "VERSION 0.7\nFIELDS x y z rgb fpfh\nSIZE 4 4 4 1 4\nTYPE F F F U F\nCOUNT 1 1 1 3 33\nPOINTS 420\n"
    ply = f"ply\nformat {data.replace('binary', 'binary_little_endian')} 1.0\nelement vertex 420\n"
    ply += "".join(f"property float {axis}\n" for axis in "xyz") + "property list uchar int near\n"
    point, color, none, three = ("xyz", "<f4", 3), ("rgb", "u1", 3), ("near", "u1", 1), ("three", "u1", 1)
    for name, head, layout in (
        ("a.pcd", f"{pcd}DATA {data}\n", [point, color, ("fpfh", "<f4", 33)]),
        ("a.ply", f"{ply}property list uchar uchar rgb\nend_header\n", [point, none, three, color]),
    ):
        rows = np.zeros(420, layout)
        rows["xyz"], rows["rgb"] = BALL, GREEN
        if name == "a.ply":
            rows["three"] = 3
        rows["rgb"][7] = GREEN[::-1]
        plain = "\n".join(" ".join(str(number) for field in row for number in field) for row in rows)
        content = head.encode() + (rows.tobytes() if data == "binary" else plain.encode())
        cloud, _ = read(write(tmp_path, name, content))
        np.testing.assert_allclose(cloud.base_color[6:8], [LINEAR, LINEAR[::-1]], atol=1e-3)
        np.testing.assert_allclose(cloud.positions, BALL, atol=1e-6)


# Packed PCD


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([b"a", b"b", b"abc", b"abcabcabc", b"\0" * 300, b"xyz" * 20]), max_size=12))
def test_decompress_inverts_lzf(pieces):
    data = b"".join(pieces)
    assert decompress(compress_lzf(data), len(data)) == data
    for size in range(3, 9):  # copies of the last three bytes, which may reach into themselves
        assert decompress(b"\2abc" + bytes([size - 2 << 5, 2]), 3 + size) == (b"abc" * 4)[: 3 + size]


# What is refused


def archive(member: bytes) -> bytes:
    """An .npz archive that holds these bytes as its points."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr("points.npy", member)
    return stream.getvalue()


PLY, PCD = b"ply\nformat ascii 1.0\n", WRITERS["binary.pcd"](WHOLE)
ZEROS = pack_arrays({"points": np.zeros((50, 3))})
LITTLE, DEEP = "binary_little_endian", [(0.0, 0.0, 5e6), (0.0, 0.0, 5e6 + 1)]
LENGTHS = pack_arrays({"x": np.zeros(5), "y": np.zeros(4), "z": np.zeros(5)})
KNOWN = "expected one of .ply .pcd .xyz .txt .csv .tsv .asc .pts .npz .npy .las .laz"
REFUSED = [
    ("a.ply", None, "no such file"),
    ("a.xyz", "", "the file is empty"),
    ("a.jpeg", "1 2 3", f"unknown kind of file '.jpeg'; {KNOWN}"),
    ("a.txt", "# 3D point list with one line\n", "COLMAP's points, which is not read: .* .colmap model_converter"),
    ("a.npy", as_npy(np.zeros((4, 5, 3), "u1")), "bytes of a picture"),
    ("a.npy", as_npy(np.zeros((2, 4, 5, 3), "u1")), "bytes of a picture"),
    ("a.geo", "Point(1) = {0, 0, 0};\n", "unknown kind of file '.geo'"),  # of Gmsh
    ("a.geo", '[\n\t"fileversion","19",', "Houdini's geometry, which is not read: convert it by `gconvert"),
    ("nurbs.obj", "v 0 0 0\nv 0 1 0\nsurf 0 1 0 1 1 2\n", "curves .NURBS., which are not read"),
    ("curve.obj", "v 0 0 0\nv 0 1 0\ncstype bspline\ncurv 0 1 1 2 3 4\nend\n", "curves .NURBS."),
    ("a.off", "OFF BINARY\n", "not an OFF file that can be read"),
    ("a.xyz", "# nothing yet\n", "holds 0 points: expected rows of numbers, .*; found 'nothing yet'"),
    ("a.xyz", "version https://git-lfs.github.com/spec/v1\n", "a pointer .* Git LFS, .*git lfs pull"),
    ("a.ply", "<!DOCTYPE html>", "a web page, which is not read: download the file itself"),
    ("a.ply.gz", b"\x1f\x8b", "an archive, which is not read: unpack it first"),
    ("a.ply", ply_bytes(LITTLE, rows=[]), "holds 0 points"),
    ("a.xyz", "nan 0 0\n1 nan 0\n", "no point that can be used: NaN, infinity .* in all of its 2 rows"),
    ("a.csv", "x,y,z\nnan,nan,nan\n", "no point that can be used: NaN, infinity .* in all of its 1 rows"),
    ("a.csv", "u,v,w\n0,0,0\n", r"needs the properties x y z \(and may have .*\); found u v w"),
    ("a.csv", "x,y,z,rough\n0,0,0,0.5\n1,1,1,12\n", "has roughness from 0.5 to 12; expected 0 to 1"),
    ("a.xyz", "x y z r g b\n0 0 0 0.5 0.5 -0.2\n", "has red green blue from -0.2 to 0.5; expected 0 to 1"),
    ("a.xyz", "0 0 0 0.5 1.3 0.2\n", "colours up to 1.3: neither 0 to 1 nor 0 to 255"),
    ("a.xyz", "0 0 0 3 4 66000\n", "from .* to 1.0"),
    ("a.xyz", "1 2 3\n" * 5, "holds 5 points in 1 place: no object"),
    ("a.xyz", "1 2 3\n4 5 6\n" * 5, "holds 10 points in 2 places: no object"),
    ("a.xyz", "".join(f"{i} {2 * i} 0.1\n" for i in range(50)), "50 points on one straight line"),
    ("a.xyz", "".join(f"{i / 70:g} {i / 35:g} 0.1\n" for i in range(50)), "50 points on one straight line"),
    ("a.e57", b"ASTM-E57\1\0\0\0\0\0\0\0", "E57 of version 1.0, which is not read: convert it to .las"),
    ("a.ply", b"PXR-USDC\0\x08\0", r"USD \(binary crate\) of version 0.8.0, .* Blender"),
    ("a.usda", "#usda 1.0\n", r"USD \(text\) of version 1.0, .* Blender"),
    ("a.usdz", b"PK\3\4", r"USD \(package\), which is not read: convert it to .glb"),
    ("a.fbx", b"Kaydara FBX Binary  \0\x1a\0\xe8\x1c\0\0", "FBX of version 7400, which is not read: convert it to"),
    (
        "a.xml",
        '<?xml version="1.0"?>\n<VTKFile type="PolyData">',
        "VTK, which is not read: convert it to .ply, e.g. with Par",
    ),
    ("a.bag", "#ROSBAG V2.0\n", "a ROS bag of version 2.0, which is not read: save a topic as .pcd"),
    ("a.json", "[]", "a .json file, which is not read: save its points in Python"),
    ("a.dae", '<?xml version="1.0"?>\n<COLLADA xmlns="x" version="1.4.1">', "COLLADA of version 1.4.1, "),
    ("a.csv", "x y z base_color_r base_color_g base_color_b\n0 0 0 0 0 9\n", "from 0 to 9"),
    ("a.csv", "x y z roughness\n0 0 0 nan\n", "no point that can be used"),
    ("a.ply", ply_bytes(LITTLE, rows=DEEP, properties=XYZRGB[:3]), "0.5 apart at best .* extent of 0.9; move"),
    ("a.ply", ply_bytes(LITTLE)[:-20], "announces 3 points, the data ends after 2"),
    ("b.stl", "solid a\nendsolid a\n", "no faces, and no vertices"),
    ("a.ply", b"solid of something", "not a PLY"),
    ("a.ply", PLY + b"element vertex 1\nproperty quad x\nend_header\n1\n", "property quad x"),
    ("a.ply", b"ply\nformat binary_middle_endian 1.0\nelement vertex 0\nend_header\n", "known format"),
    ("a.ply", PLY + b"element vertex -1\nproperty float x\nend_header\n", "element vertex -1"),
    ("a.ply", PLY + b"element edge 0\nend_header\n", "no PLY element 'vertex', only edge"),
    (
        "a.ply",
        PLY + b"element vertex 1\nproperty uchar x\nend_header\n300\n",
        "1 numbers of the header's types, found '300'",
    ),
    ("a.ply", PLY + b"element vertex 1\nproperty list uchar int x\nend_header\n1 1\n", "found x"),
    ("a.obj", "v 35 1,351 -1,068\nv -565 -230 983\n", "v 1: expected 3 numbers, found '35 1,351 -1,068'"),
    ("a.xyz", "1 2 3\n4 5\n", "line 2: expected 3 numbers, found '4 5'"),
    ("a.xyz", "1 2 3 " * 6 + "\n", r"shape \(1, 18\)"),
    ("a.csv", "x,y,z\n1,2,3\n(0.5),1,2\n4,5,7\n", r"line 3: expected 3 numbers, found '\(0.5\),1,2'"),
    ("a.csv", "Northing,Easting,Height,Code\n1,2,3\n4,5,7\n", "names 4 columns .* above 3 columns of numbers"),
    ("a.xyz", "x y z\n1 2 3 4\n", "names 3 columns .* above 4"),
    ("a.csv", "x,y,z\n1,2m,3\n4,5,6\n", "line 2: expected 3 numbers, found '1,2m,3'"),
    ("a.csv", "x,y,z\n0,5,1,5,2,5\n", "names 3 columns .* above 6 .*; decimal commas need another separator"),
    ("a.pcd", PCD.replace(b"TYPE F F U F F F", b"TYPE F F U F F"), "disagree"),
    ("a.pcd", PCD.replace(b"COUNT 1 1 3 1 1 1", b"COUNT 1 1 2147483647 1 1 1"), "bytes; expected at most"),
    ("a.pcd", PCD.replace(b"POINTS 12", b"POINTS -4"), "-4"),
    ("a.pcd", PCD.replace(b"DATA binary", b"DATA packed"), "packed"),
    ("a.npy", pickle.dumps([1, 2]), "broken, truncated or pickled"),
    ("a.npy", as_npy(np.zeros(3, [("x", "<f4", (0,))])), "needs the properties x y z"),
    ("a.npy", b"\x93NUMPY\x02\x00" + struct.pack("<I", 9001) + b"~" * 9000 + b"1", "a broken, truncated or pickled"),
    ("a.npy", as_npy(np.zeros(3, [(axis, "U1") for axis in "xyz"])), "needs the properties x y z"),
    ("a.npy", as_npy(np.zeros((5, 3))).replace(b"'shape'", b"'shape("), "broken"),
    ("a.npz", ZEROS.replace(bytes(80), bytes(79) + b"1", 1), "truncated .*CRC"),
    ("a.npz", pack_arrays({"points": np.zeros((5, 2))}), r"numbers of shape \(5, 2\)"),
    ("a.npz", pack_arrays({"points": np.array([["1", "2", "3"]])}), "type <U1"),
    ("a.npz", LENGTHS, "different lengths.*'x': 5.*'y': 4"),
    ("a.npz", pack_arrays({"points": BALL, "rgb": BALL[1:]}), "different lengths.*'x': 420.*'rgb:0': 419"),
    ("a.npz", pack_arrays({"corners": np.zeros((5, 3))}), "none of the arrays positions, .*, coordinates; found c"),
    ("a.npz", archive(as_npy(np.zeros((5, 3))).replace(b"(5, 3), }" + b" " * 6, b"(5000000, 3), }")), "truncated"),
    ("a.npz", archive(as_npy(np.array([{}, None], object), pickled=True)), "Object arrays cannot be loaded"),
    ("a.npz", archive(b"no array at all"), "shape .* and type"),
    ("digits.txt", "1;2;3\n" + "9" * 200_000 + "x;2;3\n", "line 2"),
    ("more digits.xyz", "1.5 2 " + 4000 * "9" + "\n1 2 x\n", "expected 3 numbers"),
    ("brackets.txt", "x;y;z;" + "(" * 200_000 + "\n1;2;3\n", "above 3 columns"),
    ("blanks.off", 200_000 * " " + "x", "not an OFF file that can be read"),
    ("empty lines.obj", "\n" * 200_000 + "v 1 2 3\n", "1 place"),
]


@pytest.mark.parametrize(("name", "data", "reason"), REFUSED, ids=[f"{row[0]} {row[2]}" for row in REFUSED])
def test_every_bad_file_is_one_line_that_names_it_and_the_reason_in_seconds(tmp_path, name, data, reason):
    path, begin = tmp_path / name, time.process_time()
    if data is not None:
        write(tmp_path, name, data)
    with pytest.raises(ValueError, match=reason) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert time.process_time() - begin < 10


def test_a_data_set_with_a_broken_row_is_refused():
    rows = [(0.0, 1.0, 0.0), (0.0, np.nan, 0.0), (np.inf, 0.0, 0.0)]
    with pytest.raises(ValueError, match="holds 2 points with NaN, infinity .* first point 1"):
        clouds.cloud_of_ply(ply_bytes(LITTLE, rows=rows, properties=XYZRGB[:3]))
