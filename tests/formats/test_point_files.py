"""Text whose columns are told by its look, what PCD files pack, and numbers that are none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.pcd_files import compress, content, points
from support.point_clouds import read_columns, write

from spnr_jax.formats import clouds
from spnr_jax.formats.pcd import decompress


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


@pytest.mark.parametrize(("kind", "bits"), [("<f4", 0x7FA00000), ("<f8", 0x7FF4000000000000)])
@pytest.mark.parametrize("column", [0, 4, 7])
def test_a_signalling_nan_costs_its_row_or_its_normal_and_no_warning(tmp_path, kind, bits, column):
    table = np.random.default_rng(0).random((50, 9)).astype(kind)
    table.view(kind.replace("f", "u"))[3, column] = bits
    np.save(tmp_path / "cloud.npy", table)
    cloud = clouds.read_cloud(tmp_path / "cloud.npy")  # warnings are errors in the tests
    assert len(cloud.positions) in (49, 50)
    assert np.isfinite(cloud.positions).all()


def test_points_that_are_called_compressed_and_stored_as_they_are_are_read(tmp_path):
    rows = points()
    columns = read_columns(write(tmp_path, "a.pcd", content("binary_compressed", rows, stored=True)))
    for name in ("x", "y", "z", "roughness", "rgb"):
        np.testing.assert_array_equal(columns[name], rows[name])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([b"a", b"b", b"abc", b"abcabcabc", b"\0" * 300, b"xyz" * 20]), max_size=12))
def test_decompress_inverts_lzf(pieces):
    data = b"".join(pieces)
    assert decompress(compress(data), len(data)) == data


@settings(max_examples=200, deadline=None)
@given(st.binary(min_size=1, max_size=60))
def test_lzf_that_gives_another_size_or_reaches_before_its_start_is_refused(data):
    try:
        assert len(decompress(data, 20)) == 20
    except ValueError as error:
        assert "damaged" in str(error)  # noqa: PT017 - some inputs are sound
