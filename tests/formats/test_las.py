"""Laser scans keep their coordinates and colours; without laspy one line says what to install."""

import io
import struct
import sys

import numpy as np
import pytest
from support.point_clouds import SRGB
from support.point_tables import WHOLE, as_scan

from spnr_jax.formats.clouds import place_cloud, read_cloud

pytest.importorskip("laspy")
FAR = WHOLE._replace(positions=WHOLE.positions + [500_000.0, 4_000_000.0, 120.0])


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
    as_scan(tmp_path / f"a{suffix if announced is None else '.las'}", FAR)
    if announced is not None:
        in_own_chunks(tmp_path / "a.las", (5, 3, 4), announced)
    placed = place_cloud(tmp_path / f"a{suffix}")
    assert placed.up == "z"
    back = placed.cloud.positions @ placed.rotation + placed.origin
    np.testing.assert_allclose(back, FAR.positions, rtol=0, atol=1e-4)
    np.testing.assert_allclose(placed.cloud.base_color, SRGB[WHOLE.levels], atol=1e-4)


def test_a_scan_without_colours_shows_its_intensity(tmp_path):
    as_scan(tmp_path / "a.las", WHOLE, 6)
    assert np.ptp(read_cloud(tmp_path / "a.las").base_color) > 0.9


@pytest.mark.parametrize("package", ["laspy", "lazrs"])
def test_without_its_packages_one_line_names_the_extra(tmp_path, monkeypatch, package):
    as_scan(tmp_path / "a.las", WHOLE)
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
    as_scan(tmp_path / f"a{suffix}", WHOLE)
    content = bytearray((tmp_path / f"a{suffix}").read_bytes())
    if place == "table":  # of chunks, which the library trusts
        (data,) = struct.unpack_from("<I", content, 96)
        (table,) = struct.unpack_from("<q", content, data)
        place = table + 4
    content[place : place + 4] = value.to_bytes(4, "little")
    (tmp_path / f"a{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=reason):
        read_cloud(tmp_path / f"a{suffix}")
