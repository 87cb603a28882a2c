"""Laser scans keep their coordinates and colours; without laspy one line says what to install."""

import io
import struct
import sys

import numpy as np
import pytest

from spnr_jax.formats.clouds import place_cloud, read_cloud

laspy = pytest.importorskip("laspy")
ORIGIN = np.array([500_000.0, 4_000_000.0, 120.0])


def scan(path, point_format: int = 7, count=300):
    """A scan of random points in a cube of ten metres; its positions, as a LAS file rounds them to millimetres."""
    rng = np.random.default_rng(0)
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.offsets, header.scales = ORIGIN, [0.001] * 3
    las = laspy.LasData(header)
    positions = np.round(rng.uniform(0, 10, (count, 3)), 3) + ORIGIN
    las.x, las.y, las.z = positions.T
    las.intensity = rng.integers(0, 2000, count)
    if point_format == 7:
        las.red, las.green, las.blue = (np.full(count, level, np.uint16) for level in (65535, 32768, 0))
    las.write(path)
    return positions


def in_own_chunks(path, sizes, announced: int):
    """The scan at a path packed in chunks of these sizes, whose record announces chunks of `announced` points."""
    import lazrs

    whole = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", whole, 96)
    vlr = lazrs.LazVlr.new_for_compression(whole[104], 0, True)
    record = bytearray(vlr.record_data())
    struct.pack_into("<I", record, 12, announced)
    head = whole[:start] + struct.pack("<2x16sHH32x", b"laszip encoded", 22204, len(record)) + record
    struct.pack_into("<II", head, 96, len(head), 1)
    head[104] |= 0x80
    packed = io.BytesIO()
    packed.write(head)
    compressor, points = lazrs.LasZipCompressor(packed, vlr), np.frombuffer(whole, np.uint8, offset=start)
    for number, piece in enumerate(np.split(points, np.cumsum(sizes)[:-1] * vlr.item_size())):
        if number:
            compressor.finish_current_chunk()
        compressor.compress_many(piece)
    compressor.done()
    path.with_suffix(".laz").write_bytes(packed.getvalue())


@pytest.mark.parametrize(("suffix", "announced"), [(".las", None), (".laz", None), (".laz", 0), (".laz", 2**32 - 1)])
def test_a_scan_keeps_its_coordinates_and_colours_in_chunks_of_any_size_and_is_z_up(tmp_path, suffix, announced):
    positions = scan(tmp_path / f"a{suffix if announced is None else '.las'}")
    if announced is not None:
        in_own_chunks(tmp_path / "a.las", (120, 50, 130), announced)
    placed = place_cloud(tmp_path / f"a{suffix}")
    assert placed.up == "z"
    back = placed.cloud.positions @ placed.rotation + placed.origin
    np.testing.assert_allclose(back, positions, rtol=0, atol=1e-4)
    np.testing.assert_allclose(placed.cloud.base_color[0], [1, 0.2140, 0], atol=1e-4)


def test_a_scan_without_colours_shows_its_intensity(tmp_path):
    scan(tmp_path / "a.las", 6)
    assert np.ptp(read_cloud(tmp_path / "a.las").base_color) > 0.9


@pytest.mark.parametrize("package", ["laspy", "lazrs"])
def test_without_its_packages_one_line_names_the_extra(tmp_path, monkeypatch, package):
    scan(tmp_path / "a.las")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match=rf"a.las: needs the package {package} .* pip install 'spnr-jax\[formats\]'"):
        read_cloud(tmp_path / "a.las")


@pytest.mark.parametrize(
    ("suffix", "place", "value", "reason"),
    [
        (".las", 100, 2**32 - 1, "records in its header"),
        (".las", 96, 2**32 - 1, "points from byte"),
        (".las", 0, 0, "not a LAS file"),
        (".laz", "table", 2**31, "chunks in"),
        (".laz", "table", 0, "points in 0 chunks"),
    ],
)
def test_what_announces_more_than_the_file_holds_never_reaches_the_library(suffix, place, value, reason, tmp_path):
    scan(tmp_path / f"a{suffix}")
    content = bytearray((tmp_path / f"a{suffix}").read_bytes())
    if place == "table":  # of chunks, which the library trusts
        (data,) = struct.unpack_from("<I", content, 96)
        (table,) = struct.unpack_from("<q", content, data)
        place = table + 4
    content[place : place + 4] = value.to_bytes(4, "little")
    (tmp_path / f"a{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=reason):
        read_cloud(tmp_path / f"a{suffix}")
