import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.pcd_files import compress, content, points
from support.point_clouds import read_columns, write

from spnr_jax.formats.pcd import decompress


def test_points_that_are_called_compressed_and_stored_as_they_are_are_read(tmp_path):
    rows = points()
    columns = read_columns(write(tmp_path, "a.pcd", content("binary_compressed", rows, stored=True)))
    for name in ("x", "y", "z", "roughness", "rgb"):
        np.testing.assert_array_equal(columns[name], rows[name])


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
        read_columns(write(tmp_path, "a.pcd", content("binary", points()).replace(old, new)))


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
