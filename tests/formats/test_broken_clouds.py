"""What is no cloud is refused in one line, and rows without numbers are left out and counted."""

import io
import pickle
import re
import zipfile

import numpy as np
import pytest
from support import pcd_files
from support.point_clouds import XYZRGB, ply_bytes, read, sphere_points, write

from spnr_jax.formats import clouds
from spnr_jax.formats.clouds import read_cloud
from spnr_jax.formats.npz import pack_arrays

PLY = b"ply\nformat ascii 1.0\n"
PCD = pcd_files.content("binary", pcd_files.points())


def as_npy(array: np.ndarray, pickled: bool = False) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=pickled)
    return stream.getvalue()


def archive(content: bytes) -> bytes:
    """An .npz archive that holds these bytes as its points."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr("points.npy", content)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.ply", None, "no such file"),
        ("a.xyz", "", "the file is empty"),
        (
            "a.jpeg",
            "1 2 3",
            r"unknown kind of file '.jpeg'; expected one of .ply .pcd .xyz .txt .csv .asc .pts .npz .npy .las .laz",
        ),
        ("a.xyz", "# nothing yet\n", "holds 0 points"),
        ("a.ply", ply_bytes("binary_little_endian", rows=[]), "holds 0 points"),
        ("a.xyz", "nan 0 0\n1 nan 0\n", "no point that can be used: NaN, infinity .* in all of its 2 rows"),
        ("a.xyz", "0 0 1e39\n", "too large a number"),
        ("a.csv", "px,py,pz\n0,0,0\n", r"needs the properties x y z \(and may have .*\); found px py pz"),
        ("a.xyz", "0 0 0 0.5 0.5 -0.2\n", "has red green blue from -0.2 to 0.5; expected 0 to 1"),
        ("a.xyz", "0 0 0 0.5 1.3 0.2\n", "colours up to 1.3: neither 0 to 1 nor 0 to 255"),
        ("a.xyz", "0 0 0 3 4 66000\n", "from .* to 1.0"),
        ("a.xyz", "1 2 3\n" * 5, "holds 5 points in 1 place: no object"),
        ("a.xyz", "1 2 3\n4 5 6\n" * 5, "holds 10 points in 2 places: no object"),
        ("a.xyz", "".join(f"{i} {2 * i} 0.1\n" for i in range(50)), "50 points on one straight line"),
        ("a.txt", "1 2 3\n4 5 6\nend\n", "line 3: expected 3 numbers, found 'end'"),
        ("a.e57", b"ASTM-E57\1\0\0\0\0\0\0\0", "E57 scan of version 1.0, which is not read: convert it to .las"),
        ("a.usdc", b"PXR-USDC\0\x08\0", r"USD \(binary crate\) of version 0.8.0"),
        ("a.usda", "#usda 1.0\n", r"USD \(text\) of version 1.0, .* Blender"),
        ("a.usdz", b"PK\3\4", "USD .package., which is not read: convert it to .glb"),
        ("a.spz", b"NGSP\4\0\0\0" + bytes(30), ".spz file of version 4; versions 2 and 3 can be read: convert"),
        ("a.csv", "x y z base_color_r base_color_g base_color_b\n0 0 0 0 0 9\n", "from 0 to 9"),
        ("a.csv", "x y z roughness\n0 0 0 nan\n", "no point that can be used"),
        (
            "a.ply",
            ply_bytes("binary_little_endian", rows=[(0.0, 0.0, 5e6), (0.0, 0.0, 5e6 + 1)], properties=XYZRGB[:3]),
            "0.5 apart at best .* extent of 1; move them to the origin",
        ),
        ("a.ply", ply_bytes("binary_little_endian")[:-20], "announces 3 points, the data ends after 2"),
        ("a.obj", "v 0 0 0\n", "holds 1 points in 1 place"),
        ("b.obj", "# nothing\n", "no faces, and no vertices"),
        ("a.glb", b"glTF\2\0\0\0\xff\xff\0\0", "broken or truncated|cut off|truncated"),
        ("a.ply", b"solid of something", "not a PLY"),
        ("a.ply", PLY + b"element vertex 1\nproperty quad x\nend_header\n1\n", "property quad x"),
        ("a.ply", b"ply\nformat binary_middle_endian 1.0\nelement vertex 0\nend_header\n", "known format"),
        ("a.ply", PLY + b"element vertex -1\nproperty float x\nend_header\n", "element vertex -1"),
        ("a.ply", PLY + b"element edge 0\nend_header\n", "no PLY element 'vertex', only edge"),
        ("a.ply", PLY + b"element vertex 1\nproperty uchar x\nend_header\n300\n", "300"),
        ("a.ply", PLY + b"element vertex 1\nproperty list uchar int x\nend_header\n1 1\n", "lists"),
        ("a.xyz", "1 2 3\n4 5\n", "line 2: expected 3 numbers, found '4 5'"),
        ("a.xyz", "1 2 3 4 5\n", r"shape \(1, 5\)"),
        ("a.xyz", "x y z\n1 2 3 4\n", "names 3 columns .* above 4"),
        ("a.pcd", PCD.replace(b"TYPE F F U F F F", b"TYPE F F U F F"), "disagree"),
        ("a.pcd", PCD.replace(b"TYPE F F U F F F", b"TYPE F F U F F Q"), "disagree"),
        ("a.pcd", PCD.replace(b"COUNT 1 1 3 1 1 1", b"COUNT 1 1 2147483647 1 1 1"), "bytes; expected at most"),
        ("a.pcd", PCD.replace(b"POINTS 4", b"POINTS -4"), "-4"),
        ("a.pcd", PCD.replace(b"DATA binary", b"DATA packed"), "packed"),
        ("a.pcd", PCD.replace(b"HEIGHT 1", b"SHAPE 1"), "SHAPE"),
        ("a.npy", pickle.dumps([1, 2]), "not a NumPy file"),
        ("a.npy", as_npy(np.zeros((50, 3)))[:400], "truncated"),
        ("a.npy", as_npy(np.zeros((5, 3))).replace(b"'shape'", b"'shape("), "broken"),
        ("a.npz", pack_arrays({"points": np.zeros((50, 3))})[:400], "truncated"),
        (
            "a.npz",
            pack_arrays({"points": np.zeros((50, 3))}).replace(bytes(80), bytes(79) + b"1", 1),
            "truncated .*CRC",
        ),
        ("a.npz", pack_arrays({"points": np.zeros((5, 4))}), r"'points' of shape \(5, 4\)"),
        ("a.npz", pack_arrays({"points": np.array([["1", "2", "3"]])}), "type <U1"),
        (
            "a.npz",
            pack_arrays({"points": np.zeros((5, 3)), "rgb": np.zeros((4, 3))}),
            "different lengths.*'x': 5.*'r': 4",
        ),
        ("a.npz", pack_arrays({"corners": np.zeros((5, 3))}), "none of the arrays positions, .*; found corners"),
        ("a.npz", archive(as_npy(np.zeros((5, 3))).replace(b"(5, 3), }" + b" " * 6, b"(5000000, 3), }")), "cut off"),
        ("a.npz", archive(as_npy(np.array([{}, None], object), pickled=True)), "holds objects"),
        ("a.npz", archive(b"no array at all"), "broken"),
    ],
)
def test_every_bad_file_is_one_line_that_names_it_and_the_reason(tmp_path, name, content, reason):
    path = tmp_path / name
    if content is not None:
        write(tmp_path, name, content)
    with pytest.raises(ValueError, match=reason) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_wrong_options_are_refused_before_the_file_is_touched():
    with pytest.raises(ValueError, match="up must be one of y, -y, z, -z, x, -x, auto, got 'w'"):
        read_cloud("absent.ply", up="w")
    with pytest.raises(ValueError, match="num_points must be at least 1, got 0"):
        read_cloud("absent.ply", num_points=0)


def test_rows_without_finite_numbers_are_left_out_while_a_big_file_is_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "CAPACITY", 16)
    monkeypatch.setattr("spnr_jax.formats.text.PIECE_LINES", 7)
    positions = np.concatenate([np.full((20, 3), np.nan), sphere_points(3, 300), np.full((9, 3), np.inf)])
    np.savetxt(tmp_path / "a.xyz", positions)
    cloud, lines = read(tmp_path / "a.xyz", num_points=1)
    assert np.isfinite(cloud.positions).all()
    assert lines[0] == "29 of 329 points left out: NaN, infinity or too large a number"
    assert re.fullmatch(r"\d+ of 300 points kept while reading.*", lines[1])


def test_a_data_set_with_a_broken_row_is_refused():
    rows = [(0.0, 1.0, 0.0), (0.0, np.nan, 0.0), (np.inf, 0.0, 0.0)]
    with pytest.raises(ValueError, match="holds 2 points with NaN, infinity .* first point 1"):
        clouds.cloud_of_ply(ply_bytes("binary_little_endian", rows=rows, properties=XYZRGB[:3]))
