import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spnr_jax.formats.clouds import read_cloud
from spnr_jax.formats.pcd import decompress
from spnr_jax.formats.point_files import read_columns
from spnr_jax.kernels.colors import srgb_to_linear

LAYOUT = np.dtype([("x", "<f4"), ("y", "<f4"), ("pad", "u1", (3,)), ("z", "<f4"), ("rgb", "<f4"), ("roughness", "<f8")])
COLORS = np.array([[255, 0, 3], [1, 128, 250], [7, 7, 7], [0, 255, 0]], np.uint32)


def points() -> np.ndarray:
    rows = np.zeros(4, LAYOUT)
    rows["x"], rows["y"], rows["z"] = [1.5, -2, 0, 3], [0.25, 1, 1, 1], [9, 8, 7, -6]
    rows["rgb"] = (COLORS[:, 0] << 16 | COLORS[:, 1] << 8 | COLORS[:, 2]).astype(np.uint32).view(np.float32)
    rows["roughness"] = [0, 0.25, 0.5, 1]
    return rows


def compress(data: bytes) -> bytes:
    """LZF, the slow way: the longest earlier match of up to 264 bytes at each place, else plain bytes."""
    packed, plain, place = bytearray(), bytearray(), 0

    def flush():
        for start in range(0, len(plain), 32):
            piece = plain[start : start + 32]
            packed.extend(bytes([len(piece) - 1]) + piece)
        plain.clear()

    while place < len(data):
        best, distance = 0, 0
        for start in range(max(0, place - 8191), place):
            length = 0
            while length < 264 and place + length < len(data) and data[start + length] == data[place + length]:
                length += 1
            if length > best:
                best, distance = length, place - start
        if best < 3:
            plain.append(data[place])
            place += 1
            continue
        flush()
        high, low = divmod(distance - 1, 256)
        packed.extend([best - 2 << 5 | high, low] if best < 9 else [7 << 5 | high, best - 9, low])
        place += best
    flush()
    return bytes(packed)


def pcd_bytes(encoding: str, rows: np.ndarray, newline: str = "\n") -> bytes:
    header = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", "FIELDS x y _ z rgb roughness"]
    header += ["SIZE 4 4 1 4 4 8", "TYPE F F U F F F", "COUNT 1 1 3 1 1 1", f"WIDTH {len(rows)}", "HEIGHT 1"]
    header += ["VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(rows)}", f"DATA {encoding}", ""]
    head = newline.join(header).encode()
    if encoding == "ascii":
        lines = [" ".join(repr(float(value)) for value in np.hstack([np.ravel(cell) for cell in row])) for row in rows]
        return head + newline.join([line.replace(".0 ", " ") for line in lines] + [""]).encode()
    if encoding == "binary":
        return head + rows.tobytes()
    plain = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
    packed = compress(plain)
    return head + np.array([len(packed), len(plain)], "<u4").tobytes() + packed


def write(folder, content: bytes):
    path = folder / "a.pcd"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_every_encoding_of_a_pcd_gives_the_same_columns_and_unpacked_colours(tmp_path, encoding, newline):
    rows = points()
    columns = read_columns(write(tmp_path, pcd_bytes(encoding, rows, newline)))
    assert set(columns) == {"x", "y", "z", "roughness", "r", "g", "b"}
    for name in ("x", "y", "z", "roughness"):
        np.testing.assert_array_equal(columns[name], rows[name])
    np.testing.assert_array_equal(np.stack([columns[name] for name in "rgb"], axis=1), COLORS)


def test_a_cloud_of_a_pcd_has_its_colours_taken_as_srgb(tmp_path):
    cloud = read_cloud(write(tmp_path, pcd_bytes("binary", points())))
    np.testing.assert_allclose(cloud.base_color, srgb_to_linear(jnp.asarray(COLORS, jnp.float32) / 255), atol=1e-6)
    np.testing.assert_array_equal(cloud.roughness, [0, 0.25, 0.5, 1])


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_a_pcd_cut_anywhere_is_refused_in_one_line(tmp_path, encoding):
    whole = pcd_bytes(encoding, points())
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
        (b"SIZE 4 4 1 4 4 8", b"SIZE 4 4 1 4 8 4", "rgb"),
        (b"POINTS 4", b"POINTS -4", "-4"),
        (b"DATA binary", b"DATA packed", "packed"),
        (b"HEIGHT 1", b"SHAPE 1", "SHAPE"),
    ],
)
def test_a_pcd_header_that_lies_is_refused(tmp_path, old, new, message):
    with pytest.raises(ValueError, match=message):
        read_columns(write(tmp_path, pcd_bytes("binary", points()).replace(old, new)))


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
