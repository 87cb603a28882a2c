import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.pcd_files import COLORS, ENCODINGS, compress, content, points

from spnr_jax.formats.clouds import read_cloud
from spnr_jax.formats.mesh.file_colors import unpack
from spnr_jax.formats.pcd import decompress
from spnr_jax.formats.point_files import read_columns
from spnr_jax.kernels.colors import srgb_to_linear


def write(folder, data: bytes):
    path = folder / "a.pcd"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_every_encoding_of_a_pcd_gives_the_same_columns_and_packed_colours(tmp_path, encoding, newline):
    rows = points()
    columns = read_columns(write(tmp_path, content(encoding, rows, newline)))
    assert set(columns) == {"x", "y", "z", "roughness", "rgb"}
    for name in ("x", "y", "z", "roughness"):
        np.testing.assert_array_equal(columns[name], rows[name])
    np.testing.assert_array_equal(unpack(columns["rgb"])[:, :3], COLORS)


def test_points_that_are_called_compressed_and_stored_as_they_are_are_read(tmp_path):
    rows = points()
    columns = read_columns(write(tmp_path, content("binary_compressed", rows, stored=True)))
    for name in ("x", "y", "z", "roughness", "rgb"):
        np.testing.assert_array_equal(columns[name], rows[name])


def test_a_cloud_of_a_pcd_has_its_colours_taken_as_srgb(tmp_path):
    cloud = read_cloud(write(tmp_path, content("binary", points())))
    np.testing.assert_allclose(cloud.base_color, srgb_to_linear(jnp.asarray(COLORS, jnp.float32) / 255), atol=1e-6)
    np.testing.assert_array_equal(cloud.roughness, [0, 0.25, 0.5, 1])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_pcd_cut_anywhere_is_refused_in_one_line(tmp_path, encoding):
    whole = content(encoding, points())
    body = whole.index(b"DATA") + len(f"DATA {encoding}\n")
    last = whole.rstrip().rindex(b"\n") + 1 if encoding == "ascii" else len(whole) - 9
    for length in (1, 30, body - 2, body, body + 5 * (encoding != "ascii"), last):
        with pytest.raises(ValueError, match="cut off|not a PCD"):
            read_columns(write(tmp_path, whole[:length]))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"TYPE F F U F F F", b"TYPE F F U F F", "disagree"),
        (b"TYPE F F U F F F", b"TYPE F F U F F Q", "disagree"),
        (b"COUNT 1 1 3 1 1 1", b"COUNT 1 1 2147483647 1 1 1", "bytes; expected at most"),
        (b"POINTS 4", b"POINTS -4", "-4"),
        (b"DATA binary", b"DATA packed", "packed"),
        (b"HEIGHT 1", b"SHAPE 1", "SHAPE"),
    ],
)
def test_a_pcd_header_that_lies_is_refused(tmp_path, old, new, message):
    with pytest.raises(ValueError, match=message):
        read_columns(write(tmp_path, content("binary", points()).replace(old, new)))


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
