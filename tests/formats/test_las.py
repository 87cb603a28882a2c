"""Laser scans: chunks of any size, and sizes in a file that must not reach the library."""

import io
import struct

import numpy as np
import pytest
from support.point_clouds import SRGB, read, write
from support.point_tables import WHOLE, as_scan

from spnr_jax.formats.clouds import place_cloud, read_cloud

FAR = WHOLE._replace(positions=WHOLE.positions + [500_000.0, 4_000_000.0, 120.0])


def in_own_chunks(path, sizes, announced: int):
    """The scan at a path packed in chunks of these sizes, or as its record says: chunks of `announced` points."""
    import lazrs

    whole = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", whole, 96)
    vlr = lazrs.LazVlr.new_for_compression(whole[104], 0, True)
    record = bytearray(vlr.record_data())
    struct.pack_into("<I", record, 12, announced)
    own = announced in (0, 2**32 - 1)
    vlr = vlr if own else lazrs.LazVlr(bytes(record))
    head = whole[:start] + struct.pack("<2x16sHH32x", b"laszip encoded", 22204, len(record)) + record
    struct.pack_into("<II", head, 96, len(head), 1)
    head[104] |= 0x80
    packed = io.BytesIO()
    packed.write(head)
    compressor, points = lazrs.LasZipCompressor(packed, vlr), np.frombuffer(whole, np.uint8, offset=start)
    for number, piece in enumerate(np.split(points, np.cumsum(sizes)[:-1] * vlr.item_size())):
        if number and own:
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


@pytest.mark.parametrize(
    ("suffix", "place", "value", "reason"),
    [
        (".las", 100, 2**32 - 1, "records in its header"),
        (".las", 96, 2**32 - 1, "points from byte"),
        (".las", 0, 0, "not a LAS file"),
        (".laz", "table", 2**31, "chunks in"),
        (".laz", "table", 0, "points in 0 chunks"),
        (".laz", "compressor", 1, "1 as the way in which they are compressed"),
        (".laz", 247, 13, "announces 13 points, its chunks hold 12"),
    ],
)
def test_what_announces_more_than_the_file_holds_never_reaches_the_library(suffix, place, value, reason, tmp_path):
    as_scan(tmp_path / f"a{suffix}", WHOLE)
    content = bytearray((tmp_path / f"a{suffix}").read_bytes())
    if place == "table":  # of chunks, which the library trusts
        (data,) = struct.unpack_from("<I", content, 96)
        (table,) = struct.unpack_from("<q", content, data)
        place = table + 4
    elif place == "compressor":
        place = content.index(b"laszip encoded") + 52
    content[place : place + 4] = value.to_bytes(4, "little")
    (tmp_path / f"a{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=reason):
        read_cloud(tmp_path / f"a{suffix}")


def test_fields_that_differ_among_the_points_and_are_not_used_are_named(tmp_path):
    import laspy

    as_scan(tmp_path / "a.las", WHOLE)
    scan = laspy.read(tmp_path / "a.las")
    scan.scan_angle, scan.user_data[:] = np.arange(12), 7
    scan.write(tmp_path / "a.las")
    assert "columns that are not used: scan_angle" in read(tmp_path / "a.las")[1]
    laspy.create(point_format=3).write(tmp_path / "a.las")
    with pytest.raises(ValueError, match="holds 0 points"):
        read(tmp_path / "a.las")


def test_extra_bytes_whose_names_are_not_in_utf_8_are_named(tmp_path):
    import laspy

    scan = laspy.create(point_format=0, file_version="1.2")
    scan.add_extra_dim(laspy.ExtraBytesParams("Hoehe", "f4"))
    scan.x = scan.y = scan.z = np.arange(12.0)
    scan.write(tmp_path / "a.las")
    content = (tmp_path / "a.las").read_bytes()
    with pytest.raises(ValueError, match="has extra bytes whose names are not in UTF-8: export it without them"):
        read_cloud(write(tmp_path, "a.las", content.replace(b"Hoehe", "Höhe\0".encode("latin-1"))))


@pytest.mark.parametrize("size", [4, 6])
def test_chunks_of_other_sizes_than_announced_never_reach_the_library(size, tmp_path):
    as_scan(tmp_path / "a.las", WHOLE, 7)
    in_own_chunks(tmp_path / "a.las", (5, 5, 2), 5)
    content = bytearray((tmp_path / "a.laz").read_bytes())
    content[content.index(b"laszip encoded") + 64] = size
    (tmp_path / "a.laz").write_bytes(content)
    with pytest.raises(ValueError, match=f"a chunk of 5 points where each has {size}"):
        read_cloud(tmp_path / "a.laz")


@pytest.mark.parametrize(
    ("suffix", "kind", "chunk_size", "further"),
    [(".las", 6, 5, 5), (".las", 7, 5, 5), (".laz", 7, 5, 5), (".laz", 7, 2**32 - 1, 5), (".laz", 1, 5, 4)],
)
def test_points_behind_those_that_a_scan_announces_are_said(tmp_path, suffix, kind, chunk_size, further):
    as_scan(tmp_path / "a.las", WHOLE, kind)
    in_own_chunks(tmp_path / "a.las", (5, 5, 2), chunk_size)
    content = bytearray((tmp_path / f"a{suffix}").read_bytes())
    for count, announced in (("<Q", 247), ("<I", 107)):
        struct.pack_into(count, content, announced, 7)
    cloud, lines = read(write(tmp_path, f"a{suffix}", bytes(content)))
    assert len(cloud.positions) == 7
    assert f"at least {further} points beyond those that the header announces are not read" in lines
