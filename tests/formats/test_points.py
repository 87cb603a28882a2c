"""Files of points: one table through a writer of each format, text told by its look, and what is refused, in a line."""

import io
import pickle
import struct
import time
import zipfile
from codecs import BOM_UTF8

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.point_clouds import BALL, GREEN, LINEAR, SRGB, XYZRGB, ply_bytes, read, read_columns, write
from support.point_tables import BROKEN, SOUND, WHOLE, WRITERS, as_scan, compress_lzf, written

from spnr_jax.formats import clouds, las, point_tables, row_files
from spnr_jax.formats.clouds import place_cloud, read_cloud
from spnr_jax.formats.point_files import column_pieces, kind_of
from spnr_jax.formats.point_tables import pack_arrays
from spnr_jax.formats.row_files import decompress
from spnr_jax.surfels.sides import spiral

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
    limits = (row_files, "PIECE_LINES", 5), (point_tables, "PIECE_LINES", 5), (point_tables, "PIECE_BYTES", 5 * 35)
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


# Text


def as_npy(array: np.ndarray, pickled: bool = False) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=pickled)
    return stream.getvalue()


def archive(member: bytes) -> bytes:
    """An .npz archive that holds these bytes as its points."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr("points.npy", member)
    return stream.getvalue()


ROWS = [(*point, *GREEN) for point in BALL.tolist()]


def table(separator: str, end: str = "", comma: bool = False, columns=ROWS) -> str:
    rows = [[value if isinstance(value, str) else f"{value:.9g}" for value in row] for row in columns]
    text = "\n".join(separator.join(row) + end for row in rows) + "\n"
    return text.replace(".", ",") if comma else text


INDEXED, PCV = [(i, *row) for i, row in enumerate(ROWS)], [(*row, 0.5) for row in ROWS]
BACKWARDS = [row[::-1] for row in ROWS]
WITH_INTENSITY = [(*row[:3], -900, *GREEN) for row in ROWS]
TIMED = [(17.5 + i / 1e3 + (i % 3) / 1e4, *row) for i, row in enumerate(ROWS)]
LABELED = [(*row, i % 40) for i, row in enumerate(ROWS)]
PARAVIEW = [(*GREEN, *row[:3]) for row in ROWS]
PACKED = [(*row[:3], (GREEN[0] << 16 | GREEN[1] << 8 | GREEN[2]) - 2**24) for row in ROWS]
PICTURED = [(i // 20, i % 20, *row) for i, row in enumerate(ROWS)]
WORDY = "point,x,y,z,r,g,b\nP" + table(",", columns=INDEXED).replace("\n", "\nP")[:-1]
OPAQUE = [(*row[:3], 0xFF << 24 | GREEN[0] << 16 | GREEN[1] << 8 | GREEN[2]) for row in ROWS]
PCL = "VERSION .7\nCOLUMNS x y z rgb\nsize 4 4 4 4\nTYPE F F F F\nPOINTS 420\nDATA ASCII\n"
NORTHING = [(row[1], row[0], *row[2:]) for row in ROWS]
DOUBLES, POINTS = [(axis, "double") for axis in "xyz"], [tuple(point) for point in BALL.tolist()]
FLOATS = [(*row[:3], 40.0, 170.0, 60) for row in ROWS]
THOUSANDS = [(*(f"{value:010,.4f}" for value in row[:3]), *GREEN) for row in ROWS]
GERMAN = "X;Y;Höhe;Rot;Grün;Blau\n" + table(";", comma=True)
LOUD, V_NAMES = ply_bytes("ascii", rows=FLOATS, properties=XYZRGB).replace(b"float", b"Float"), "V1 V2 V3 V4 V5 V6\n"
GREYS = table(",", columns=[(*point, 0, 0) for point in POINTS])
QUOTED = "\n".join(",".join(f'"{x}"'.replace(".", ",") for x in point) for point in BALL.tolist())
POINT_LINES = "".join("v {:g} {:g} {:g}\n".format(*point) for point in POINTS)
TEXTS = {
    "tabs and empty lines": ("a.tsv", table("\t", "\n")),
    "a byte order mark": ("a.csv", "\ufeffX;Y;Z;R;G;B\n" + table(";")),
    "names in quotes, blanks behind commas": ("a.csv", '"x", "y", "z", "r", "g", "b"\n' + table(", ")),
    "remarks before and among the rows": ("a.txt", "# scanned on Monday\n# x y z r g b\n" + table(" ", "\n# row")),
    "a remark that names an axis": ("a.txt", "// the x axis points to the right\n" + table(" ")),
    "columns in another order": ("a.txt", "//420 points\nb g r z y x\n" + table(" ", columns=BACKWARDS)),
    "count line": ("a.xyz", "420\n" + table(" ")),
    "CloudCompare, count": ("a.txt", "//X Y Z R G B\n420\n" + table(" ")),
    "CloudCompare, names with blanks": ("a.txt", "//X;Y;Z;R;G;B;Illuminance (PCV)\n" + table(";", columns=PCV)),
    "a number before each point": ("a.csv", table(",", columns=INDEXED)),
    "a label, and a row of nan": ("a.txt", table(" ", columns=[*LABELED, 7 * (np.nan,)])),
    ".pts with an intensity like a colour": ("a.pts", table(" ", columns=[(*row[:3], 90, *GREEN) for row in ROWS])),
    "the last field not known": ("a.csv", "x,y,z,r,g,b,intensity\n" + table(",", ",")),
    "a line of units below the names": ("a.csv", "x,y,z,r,g,b\n[m],[m],[m],[],[],[]\n" + table(",")),
    "names behind %": ("a.txt", "% b g r z y x\n" + table(" ", columns=BACKWARDS)),
    "a name twice": ("a.csv", "x,y,z,r,g,b,x\n" + table(",", columns=PCV)),
    "ParaView": ("a.csv", '"RGB:0","RGB:1","RGB:2",Points:0,Points:1,Points:2\n' + table(",", columns=PARAVIEW)),
    "names of a map behind a mark": ("a.txt", "#N,E,Elev,R,G,B\n" + table(",", columns=NORTHING)),
    "tabs that align": ("a.txt", "x\t\ty\tz\t\tr\tg\tb\n" + table("\t")),
    "tabs and blanks": ("a.txt", "x y z\tr g b\n" + table(" ")),
    "names in German, as Excel writes them": ("a.csv", GERMAN.encode("cp1252")),
    "names by number, of R, and numbers of Fortran": ("a.txt", V_NAMES + table(" ").replace(" ", "D+00 ")),
    "brackets around each row": ("a.txt", "[[" + table(", ").replace("\n", "],\n[")),
    "thousands, Swiss": ("a.txt", table(" ", columns=THOUSANDS).replace(",", "'")),
    "thousands, German": ("a.txt", table(";", columns=THOUSANDS).translate({44: ".", 46: ","})),
    "thousands, in quotes": ("a.csv", '"' + table('","', '"', columns=THOUSANDS).replace("\n", '\n"')[:-1]),
    "packed colours in words": ("a.csv", "x,y,z,colour\n" + table(",", ",#28AA3C", columns=POINTS)),
    "packed colours in words, without names": ("a.txt", table(" ", " 0x28aa3c", columns=POINTS)),
    "names in any file, minus signs": ("a.prn", "  X Y Z R G B\n" + table("  ").replace("-", "\N{MINUS SIGN}")),
    "velocities beside colours": ("a.csv", "x,y,z,r,g,b,linear.x,linear.y,linear.z\n" + table(",", ",-2,0,7")),
    "names with blanks between tabs": ("a.tsv", "Y Coord\tX Coord\tZ Coord\tR\tG\tB\n" + table("\t", columns=NORTHING)),
    "packed colours with a sign": ("a.csv", "x,y,z,rgb\n" + table(",", columns=PACKED)),
    "units in brackets": ("a.csv", "X [m],Y [m],Z [m],R,G,B\n" + table(",")),
    "pandas' index": ("a.csv", ",x,y,z,red,green,blue\n" + table(",", columns=INDEXED)),
    "trailing commas": ("a.csv", "x,y,z,r,g,b\n" + table(",", ",")),
    "trailing commas, names as well": ("a.csv", "x,y,z,r,g,b,\n" + table(",", ",")),
    "trailing semicolons": ("a.txt", table(";", ";")),
    "decimal commas": ("a.csv", "x;y;z;r;g;b\n" + table(";", comma=True)),
    "decimal commas between blanks": ("a.txt", table(" ", comma=True)),
    "an array's columns by number, as pandas writes them": ("a.csv", "0,1,2,3,4,5\n" + table(",")),
    "counts of points and columns": ("a.xyz", "420 6\n" + table(" ")),
    "units without brackets": ("a.csv", "x,y,z,r,g,b\nm,m,m,-,-,-\n" + table(",")),
    "names of other programs": ("a.csv", "POINT_X,Point-Y,point.z,Color.R,color_g,Color B\n" + table(",")),
    "a time before each point": ("a.txt", table(" ", columns=TIMED)),
    "grey: normals and a label": ("a.txt", table(" ", columns=[(*p, *p, i % 9) for i, p in enumerate(POINTS)])),
    "grey: OFF and its counts in one word": ("a.off", "OFF420 0 0\n" + table(" ", columns=POINTS)),
    ".pts with intensity": ("a.pts", "420\n" + table(" ", columns=WITH_INTENSITY)),
    "UTF-16, as Windows writes it": ("a.csv", ("x,y,z,r,g,b\n" + table(",")).encode("utf-16")),
    "every value in quotes": ("a.csv", '"x","y","z","r","g","b"\n"' + table('","', '"').replace("\n", '\n"')[:-1]),
    "a row with an empty field": ("a.csv", "x,y,z,r,g,b\n" + table(",") + "1,,1,1,2,3\n"),
    "a row undefined as on Windows": ("a.xyz", table(" ") + "-nan(ind) -1.#IND 0 1 2 3\n"),
    **{f"a table named {name}": (name, table(" ")) for name in ("a", "a.xyzrgb", "a.dat", "a.ply", "a.obj")},
    "grey: decimal commas in quotes": ("a.csv", QUOTED),
    "a column of words": ("a.csv", "x,y,z,r,g,b,metallic\n" + table(",", ",true")),
    "words before the numbers": ("a.csv", WORDY),
    "fields that are not known": ("a.csv", "x,y,z,r,g,b\n" + table(",") + "NA,1,1,1,2,3\nNULL,n/a,1,1,2,3\n"),
    "bars": ("a.txt", "x|y|z|r|g|b\n" + table("|")),
    "a table of R": ("a.txt", '"x" "y" "z" "r" "g" "b"\n' + table(" ", columns=INDEXED)),
    "files one behind the other": ("a.csv", "x,y,z,r,g,b\n" + table(",").replace("\n", "\nx,y,z,r,g,b\n", 200)),
    "UTF-16 without its mark": ("a.csv", ("x,y,z,r,g,b\n" + table(",")).encode("utf-16-le")),
    "names that differ in a word": ("a.csv", "local_x,local_y,local_z,r_8bit,g_8bit,b_8bit\n" + table(",")),
    "row and column in a scanner's picture": ("a.xyz", table(" ", columns=PICTURED)),
    "a row of the largest numbers": ("a.xyz", table(" ") + 3 * "3.40282e+38 " + "1 2 3\n"),
    "ASCII PCD, packed colours as whole numbers of a float": ("a.pcd", PCL + table(" ", columns=OPAQUE)),
    "grey: OBJ of v and p": ("a.obj", POINT_LINES + "p " + " ".join(map(str, range(1, 421)))),
    "grey: UTF-16 OBJ": ("a.obj", POINT_LINES.encode("utf-16")),
    "grey: OFF without its word": ("a.off", "420 0 0\n" + table(" ", columns=POINTS)),
    "grey: OFF with a byte order mark": ("a.off", "\ufeffOFF\n420 0 0\n" + table(" ", columns=POINTS)),
    "grey: PLY with a byte order mark": ("a.ply", BOM_UTF8 + ply_bytes("ascii", rows=POINTS, properties=DOUBLES)),
    "grey: a PLY of bare CR in text": ("a.ply", ply_bytes("ascii", "\r", rows=POINTS, properties=DOUBLES)),
    "PLY in capitals, bytes with a point": ("a.ply", LOUD),
    "grey: NumPy of Python 2": ("a.npy", as_npy(BALL).replace(b"(420, 3), }  ", b"(420L, 3L), }")),
    "grey: a PLY under another name": ("a.txt", ply_bytes("ascii", rows=POINTS, properties=DOUBLES)),
}


@pytest.mark.parametrize("case", TEXTS)
def test_files_of_points_are_read_whatever_stands_around_the_numbers(tmp_path, case):
    cloud, _ = read(write(tmp_path, *TEXTS[case]))
    color = 0.5 if case.startswith("grey") else LINEAR
    np.testing.assert_allclose(cloud.positions, BALL, atol=1e-5)
    np.testing.assert_allclose(cloud.base_color, np.broadcast_to(color, (420, 3)), atol=2e-3)


def test_arrays_of_pictures_and_of_colours_with_alpha_are_points(tmp_path):
    np.save(tmp_path / "a.npy", BALL.reshape(20, 21, 3))
    cloud, lines = read(tmp_path / "a.npy")
    np.testing.assert_allclose(cloud.positions, BALL, atol=1e-6)
    assert lines[0].startswith("an array of 20 x 21 x 3 taken as one cloud; of a batch")
    np.save(tmp_path / "b.npy", np.column_stack([BALL, np.tile(np.array([*GREEN, 255]) / 255, (420, 1))]))
    np.testing.assert_allclose(read_cloud(tmp_path / "b.npy").base_color[0], LINEAR, atol=1e-3)
    opaque = np.tile(np.uint8([*GREEN, 255]), (420, 1))
    ignored = {"arr_3": np.arange(420), "arr_4": np.zeros((420, 9)), "arr_5": 3 * BALL}
    tables = {"arr_0": BALL, "arr_1": opaque[:, :3], "arr_2": BALL} | ignored
    turned = {"vertices": BALL.T, "vertex_colors": opaque[:, :3].T}
    maps = {"pts3d": BALL.reshape(20, 21, 3), "point_rgb": opaque.reshape(20, 21, 4)}
    separate = dict(zip("xyz", BALL.T, strict=True)) | {"rgb": opaque}
    for arrays in ({"arr_0": ROWS}, tables, separate, {"pc": np.array(ROWS)}, turned, maps):
        np.savez(tmp_path / "c.npz", **arrays)
        np.testing.assert_allclose(read_cloud(tmp_path / "c.npz").base_color[0], LINEAR, atol=1e-3)


HALF = [(*row, 255 * (i % 2)) for i, row in enumerate(ROWS)]
MOVING = np.column_stack([BALL, np.roll(BALL, 1, axis=0) * np.arange(1, 4)])


@pytest.mark.parametrize("first", [True, False])
def test_an_intensity_that_is_the_luminance_of_the_colours_is_none_of_them(tmp_path, first):
    colors = np.random.default_rng(0).integers(0, 256, (420, 1)) // [1, 2, 4]
    grey = np.round(colors @ [0.299, 0.587, 0.114])[:, None]
    rows = np.column_stack([BALL, grey, colors] if first else [BALL, colors, grey])
    cloud, _ = read(write(tmp_path, "a.txt", table(" ", columns=rows)))
    np.testing.assert_allclose(cloud.base_color, SRGB[colors], atol=1e-4)


@pytest.mark.parametrize(
    ("name", "data", "line"),
    [
        ("a.pts", "999\n" + table(" "), "a line of the file announces 999 points, 420 are there: is the file cut off?"),
        ("a.pts", "300\n" + table(" ") + "100\n", "a line of the file announces 400 points, 420 are there"),
        (
            "a.txt",
            table(" ", columns=LABELED),
            "the 7 columns, which have no names, taken as x y z r g b scalar; r g b may",
        ),
        ("a.csv", "x,y,z,Roughness (0.1),label\n" + GREYS, "columns that are not used: roughness (0.1), label"),
        (
            "a.csv",
            "x,y,z,color_r,color_g,color_b,a\n" + table(",", columns=HALF),
            "210 of 420 points left out: opacity near 0 (--keep-noise keeps them)",
        ),
        ("a.npz", pack_arrays({"coord": BALL, "faces": BALL, "id": BALL}), "arrays that are not used: faces, id"),
        (
            "a.npz",
            pack_arrays({"points": BALL, "y": np.arange(420) % 4, "rgb": np.zeros(3)}),
            "arrays that are not used, which name no column of the 420 points: y, rgb",
        ),
        (
            "a.txt",
            table(" ", columns=MOVING),
            "the 6 columns, which have no names, taken as x y z intensity scalar scalar",
        ),
    ],
)
def test_what_is_assumed_or_not_used_is_said(tmp_path, name, data, line):
    assert any(found.startswith(line) for found in read(write(tmp_path, name, data))[1])


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


SHADE = 0.5 + 0.4 * np.sin(3 * BALL[:, :1]) * np.cos(4 * BALL[:, 1:2])  # of a surface, as a camera sees it
PHOTO = np.round(255 * SHADE * [0.9, 0.7, 0.5] + np.random.default_rng(0).uniform(0, 12, (420, 3)))
VALUES = {  # of columns
    "r g b": PHOTO,
    "unit colours": np.abs(spiral(420)),
    "nx ny nz": spiral(420),
    "intensity": np.random.default_rng(1).integers(0, 100, 420) + 0.25,
    "whole intensity": np.random.default_rng(1).integers(0, 256, 420),
    "label": np.arange(420) % 13,
    "flag": np.arange(420) % 2,
    "roughness": SHADE,
    "metallic": np.arange(420) % 2,
    "alpha": np.full(420, 255),
}
UNNAMED = {  # columns, their names where these differ
    **dict.fromkeys(("intensity", "r g b", "nx ny nz", "intensity, r g b", "r g b, alpha")),
    **dict.fromkeys(("r g b, nx ny nz", "nx ny nz, r g b", "r g b, roughness, metallic")),
    "unit colours": "r g b",
    "whole intensity, r g b": "intensity r g b",
    "r g b, label": "r g b scalar",
    "r g b, whole intensity": "r g b scalar",
    "r g b, flag, flag": "r g b scalar scalar",
    "r g b, nx ny nz, label": "r g b nx ny nz scalar",
    "intensity, r g b, label": "intensity r g b scalar",
}


@pytest.mark.parametrize("columns", UNNAMED)
def test_columns_without_names_are_told_by_their_values(tmp_path, columns):
    values = np.column_stack([BALL, *(VALUES[name] for name in columns.split(", "))])
    np.savetxt(tmp_path / "a.txt", values)
    names = f"x y z {UNNAMED[columns] or columns.replace(',', '')}".split()
    found = read_columns(tmp_path / "a.txt")
    assert list(found) == list(dict.fromkeys(names))
    for name, column in dict(zip(names, values.T, strict=True)).items():
        np.testing.assert_array_equal(found[name], column)
    assert any(f"taken as {' '.join(names)}" in line for line in read(tmp_path / "a.txt")[1]) == (len(names) > 3)


def test_normals_of_a_level_plane_are_no_colours(tmp_path):
    rows = [(x, y, 5, 0, 0, 1) for x in range(20) for y in range(20)]
    assert (read_cloud(write(tmp_path, "a.xyz", table(" ", columns=rows))).normals == [0, 0, 1]).all()


# Packed PCD


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([b"a", b"b", b"abc", b"abcabcabc", b"\0" * 300, b"xyz" * 20]), max_size=12))
def test_decompress_inverts_lzf(pieces):
    data = b"".join(pieces)
    assert decompress(compress_lzf(data), len(data)) == data
    for size in range(3, 9):  # copies of the last three bytes, which may reach into themselves
        assert decompress(b"\2abc" + bytes([size - 2 << 5, 2]), 3 + size) == (b"abc" * 4)[: 3 + size]


# Laser scans

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


def test_the_lowest_intensity_is_no_missing_colour(tmp_path):
    lowest = np.random.default_rng(0).random(420) < 0.3
    rows = [(*p, 0 if low else 50 + i % 40) for i, (p, low) in enumerate(zip(BALL.tolist(), lowest, strict=True))]
    cloud, lines = read(write(tmp_path, "a.xyz", table(" ", columns=rows)))
    np.testing.assert_array_equal(cloud.base_color[:, 0] < 0.01, lowest)
    assert not any("no colour (0 0 0)" in line for line in lines)


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


# What is refused


PLY, PCD = b"ply\nformat ascii 1.0\n", WRITERS["binary.pcd"](WHOLE)
POINTS = pack_arrays({"points": np.zeros((50, 3))})
LITTLE, DEEP = "binary_little_endian", [(0.0, 0.0, 5e6), (0.0, 0.0, 5e6 + 1)]
LENGTHS = pack_arrays({"x": np.zeros(5), "y": np.zeros(4), "z": np.zeros(5)})
KNOWN = "expected one of .ply .pcd .xyz .txt .csv .tsv .asc .pts .npz .npy .las .laz"
REFUSED = [
    ("a.ply", None, "no such file"),
    ("a.xyz", "", "the file is empty"),
    ("a.jpeg", "1 2 3", f"unknown kind of file '.jpeg'; {KNOWN}"),
    ("a.txt", "# 3D point list with one line\n", "COLMAP's points, which is not read: .* .colmap model_converter"),
    ("a.npy", as_npy(np.zeros((4, 5, 3), "u1")), "bytes of a picture"),
    ("nurbs.obj", "v 0 0 0\nv 0 1 0\nsurf 0 1 0 1 1 2\n", "curved surfaces .NURBS."),
    ("a.off", "OFF BINARY\n", "not an OFF file that can be read"),
    ("a.xyz", "# nothing yet\n", "holds 0 points: expected rows of numbers, .*; found 'nothing yet'"),
    ("a.xyz", "version https://git-lfs.github.com/spec/v1\n", "a pointer .* Git LFS, .*git lfs pull"),
    ("a.ply", "<!DOCTYPE html>", "a web page, which is not read: download the file itself"),
    ("a.ply.gz", b"\x1f\x8b", "an archive, which is not read: unpack it first"),
    ("a.ply", ply_bytes(LITTLE, rows=[]), "holds 0 points"),
    ("a.xyz", "nan 0 0\n1 nan 0\n", "no point that can be used: NaN, infinity .* in all of its 2 rows"),
    ("a.xyz", "0 0 1e39\n", "too large a number"),
    ("a.csv", "u,v,w\n0,0,0\n", r"needs the properties x y z \(and may have .*\); found u v w"),
    ("a.xyz", "x y z r g b\n0 0 0 0.5 0.5 -0.2\n", "has red green blue from -0.2 to 0.5; expected 0 to 1"),
    ("a.xyz", "0 0 0 0.5 1.3 0.2\n", "colours up to 1.3: neither 0 to 1 nor 0 to 255"),
    ("a.xyz", "0 0 0 3 4 66000\n", "from .* to 1.0"),
    ("a.xyz", "1 2 3\n" * 5, "holds 5 points in 1 place: no object"),
    ("a.xyz", "1 2 3\n4 5 6\n" * 5, "holds 10 points in 2 places: no object"),
    ("a.xyz", "".join(f"{i} {2 * i} 0.1\n" for i in range(50)), "50 points on one straight line"),
    ("a.e57", b"ASTM-E57\1\0\0\0\0\0\0\0", "E57 of version 1.0, which is not read: convert it to .las"),
    ("a.ply", b"PXR-USDC\0\x08\0", r"USD \(binary crate\) of version 0.8.0, .* Blender"),
    ("a.usda", "#usda 1.0\n", r"USD \(text\) of version 1.0, .* Blender"),
    ("a.usdz", b"PK\3\4", r"USD \(package\), which is not read: convert it to .glb"),
    ("a.fbx", b"Kaydara FBX Binary  \0\x1a\0\xe8\x1c\0\0", "FBX of version 7400, which is not read: convert it to"),
    ("a.dae", '<?xml version="1.0"?>\n<COLLADA xmlns="x" version="1.4.1">', "COLLADA of version 1.4.1, "),
    ("a.spz", b"NGSP\4\0\0\0" + bytes(30), ".spz file of version 4; versions 2 and 3 can be read: convert"),
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
    ("a.ply", PLY + b"element vertex 1\nproperty uchar x\nend_header\n300\n", "300"),
    ("a.ply", PLY + b"element vertex 1\nproperty list uchar int x\nend_header\n1 1\n", "found x"),
    ("a.xyz", "1 2 3\n4 5\n", "line 2: expected 3 numbers, found '4 5'"),
    ("a.xyz", "1 2 3 " * 6 + "\n", r"shape \(1, 18\)"),
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
    ("a.npz", POINTS.replace(bytes(80), bytes(79) + b"1", 1), "truncated .*CRC"),
    ("a.npz", pack_arrays({"points": np.zeros((5, 2))}), r"numbers of shape \(5, 2\)"),
    ("a.npz", pack_arrays({"points": np.array([["1", "2", "3"]])}), "type <U1"),
    ("a.npz", LENGTHS, "different lengths.*'x': 5.*'y': 4"),
    ("a.npz", pack_arrays({"points": BALL, "rgb": BALL[1:]}), "different lengths.*'x': 420.*'rgb:0': 419"),
    ("a.npz", pack_arrays({"corners": np.zeros((5, 3))}), "none of the arrays positions, .*; found corners"),
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
