import pickle
import zipfile

import numpy as np
import pytest
from support.point_clouds import read_columns, write

from spnr_jax.formats import clouds


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (b"solid of something", "not a PLY"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n1\n", "property quad x"),
        (b"ply\nformat binary_middle_endian 1.0\nelement vertex 0\nend_header\n", "known format"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nproperty float x\nend_header\n", "element vertex -1"),
        (b"ply\nformat ascii 1.0\nelement edge 0\nend_header\n", "no PLY element 'vertex', only edge"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty uchar x\nend_header\n300\n", "300"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1 1\n", "lists"),
    ],
)
def test_a_ply_that_breaks_the_format_is_refused_with_the_place(tmp_path, broken, reason):
    with pytest.raises(ValueError, match=reason):
        read_columns(write(tmp_path, "a.ply", broken))


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3 0.1 0.2 0.3\n4 5 6 0.4 0.5 0.6\n",
        "1,2,3,0.1,0.2,0.3\r\n4,5,6,0.4,0.5,0.6",
        "1\t2\t3\t0.1\t0.2\t0.3\n\n4\t5\t6\t0.4\t0.5\t0.6\n",
        "\ufeffX;Y;Z;R;G;B\n1;2;3;0.1;0.2;0.3\n4;5;6;0.4;0.5;0.6\n",
        '"x", "y", "z", "r", "g", "b"\n1, 2, 3, 0.1, 0.2, 0.3\n4, 5, 6, 0.4, 0.5, 0.6\n',
        "# scanned on Monday\n# x y z r g b\n1 2 3 .1 .2 .3\n# a remark\n4 5 6 .4 .5 .6\n",
        "// the x axis points to the right\n1 2 3 1e-1 2e-1 3e-1\n4 5 6 4e-1 5e-1 6e-1\n",
        "//2 points\nb g r z y x\n0.3 0.2 0.1 3 2 1\n0.6 0.5 0.4 6 5 4\n",
    ],
)
def test_text_is_read_whatever_its_separator_header_and_comments(tmp_path, text):
    columns = read_columns(write(tmp_path, "a.csv", text))
    table = np.stack([columns[name] for name in "xyzrgb"], axis=-1)
    np.testing.assert_array_equal(table, [[1, 2, 3, 0.1, 0.2, 0.3], [4, 5, 6, 0.4, 0.5, 0.6]])


NORMALS = [(0.6, 0.8, 0.0), (0.0, -0.6, 0.8)]


@pytest.mark.parametrize(
    ("rows", "names"),
    [
        ([(1, 2, 3, 90), (4, 5, 6, 80)], "x y z intensity"),
        ([(1, 2, 3, *NORMALS[0]), (4, 5, 6, *NORMALS[1])], "x y z nx ny nz"),
        ([(1, 2, 3, 0.6, 0.8, 0.0), (4, 5, 6, 0.0, 0.6, 0.8)], "x y z r g b"),
        ([(1, 2, 3, 9, 8, 7, *NORMALS[0]), (4, 5, 6, 6, 5, 4, *NORMALS[1])], "x y z r g b nx ny nz"),
        ([(1, 2, 3, *NORMALS[0], 9, 8, 7), (4, 5, 6, *NORMALS[1], 6, 5, 4)], "x y z nx ny nz r g b"),
    ],
)
def test_columns_without_names_are_told_by_their_number_and_normals_by_their_length(tmp_path, rows, names):
    text = "\n".join(" ".join(map(str, row)) for row in rows)
    columns = read_columns(write(tmp_path, "a.xyz", text))
    assert list(columns) == names.split()
    np.testing.assert_array_equal(np.stack(list(columns.values()), axis=-1), rows)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1 2 3\n4 5\n", "line 2: expected 3 numbers, found '4 5'"),
        ("1 2 3 4 5\n", r"shape \(1, 5\)"),
        ("x y z\n1 2 3 4\n", "names 3 columns .* above 4"),
        ("1 2 3\n4 five 6\n", "five"),
    ],
)
def test_text_whose_columns_are_not_certain_is_refused(tmp_path, text, reason):
    with pytest.raises(ValueError, match=reason):
        read_columns(write(tmp_path, "a.xyz", text))


def test_numpy_files_that_are_broken_pickled_or_of_another_layout_are_refused(tmp_path):
    np.savez(tmp_path / "whole.npz", points=np.zeros((50, 3)))
    np.save(tmp_path / "whole.npy", np.zeros((50, 3)))
    whole = {suffix: (tmp_path / f"whole{suffix}").read_bytes() for suffix in (".npz", ".npy")}
    damaged = bytearray(whole[".npz"])
    damaged[300] ^= 0xFF
    cases = {
        "a.npz": (whole[".npz"][:400], "truncated"),
        "b.npy": (whole[".npy"][:400], "truncated"),
        "c.npz": (bytes(damaged), "truncated .*CRC"),
        "d.npy": (pickle.dumps([1, 2]), "not a NumPy file"),
    }
    for name, (content, reason) in cases.items():
        with pytest.raises(ValueError, match=reason):
            read_columns(write(tmp_path, name, content))
    arrays = {
        "object": ({"points": np.array([{}, None], object)}, "holds objects"),
        "wide": ({"points": np.zeros((5, 4))}, r"'points' of shape \(5, 4\)"),
        "text": ({"points": np.array([["1", "2", "3"]])}, "type <U1"),
        "ragged": ({"points": np.zeros((5, 3)), "rgb": np.zeros((4, 3))}, "different lengths.*'x': 5.*'r': 4"),
        "nameless": ({"corners": np.zeros((5, 3))}, "none of the arrays positions, points, xyz.*; found corners"),
    }
    for name, (content, reason) in arrays.items():
        np.savez(tmp_path / f"{name}.npz", **content)
        with pytest.raises(ValueError, match=reason):
            read_columns(tmp_path / f"{name}.npz")


def test_an_array_that_announces_more_than_its_file_holds_is_refused_before_memory_is_taken(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.zeros((5, 3)))
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        content = archive.read("points.npy")
    cases = {
        "huge": (content.replace(b"(5, 3), }" + b" " * 6, b"(5000000, 3), }"), "cut off"),
        "header": (content.replace(b"'shape'", b"'shape("), "broken"),
        "text": (b"no array at all", "broken"),
    }
    for name, (changed, reason) in cases.items():
        with zipfile.ZipFile(tmp_path / f"{name}.npz", "w") as archive:
            archive.writestr("points.npy", changed)
        with pytest.raises(ValueError, match=reason):
            read_columns(tmp_path / f"{name}.npz")
    (tmp_path / "a.npy").write_bytes(content.replace(b"'shape'", b"'shape("))  # numpy's own error here is no ValueError
    with pytest.raises(ValueError, match="broken"):
        read_columns(tmp_path / "a.npy")


@pytest.mark.parametrize(("kind", "bits"), [("<f4", 0x7FA00000), ("<f8", 0x7FF4000000000000)])
@pytest.mark.parametrize("column", [0, 4, 7])
def test_a_signalling_nan_costs_its_row_or_its_normal_and_no_warning(tmp_path, kind, bits, column):
    table = np.random.default_rng(0).random((50, 9)).astype(kind)
    table.view(kind.replace("f", "u"))[3, column] = bits
    np.save(tmp_path / "cloud.npy", table)
    cloud = clouds.read_cloud(tmp_path / "cloud.npy")  # warnings are errors in the tests
    assert len(cloud.positions) in (49, 50)
    assert np.isfinite(cloud.positions).all()
