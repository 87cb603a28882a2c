"""Text and arrays of points: what stands around the numbers, and columns without names, told by their values."""

import re
from codecs import BOM_UTF8

import numpy as np
import pytest
from support.point_clouds import BALL, GREEN, LINEAR, SRGB, XYZRGB, ply_bytes, read, read_columns, write
from support.point_tables import as_npy

from spnr_jax.formats.array_files import pack_arrays
from spnr_jax.formats.clouds import read_cloud
from spnr_jax.surfels.sides import spiral

ROWS = [(*point, *GREEN) for point in BALL.tolist()]


def table(separator: str, end: str = "", comma: bool = False, columns=ROWS) -> str:
    rows = [[value if isinstance(value, str) else f"{value:.9g}" for value in row] for row in columns]
    text = "\n".join(separator.join(row) + end for row in rows) + "\n"
    return text.replace(".", ",") if comma else text


INDEXED, PCV = [(i, *row) for i, row in enumerate(ROWS)], [(*row, 0.5) for row in ROWS]
BALL_IN_MILLIMETRES = np.round(1000 * BALL + 1500).astype(int)
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
SIZES = "WIDTH 20\nHEIGHT 21", "WIDTH 420\nHEIGHT 0"
NORTHING = [(row[1], row[0], *row[2:]) for row in ROWS]
DOUBLES, POINTS = [(axis, "double") for axis in "xyz"], [tuple(point) for point in BALL.tolist()]
COMMA_PLY = ply_bytes("ascii", rows=POINTS, properties=DOUBLES).replace(b".", b",").replace(b"1,0\n", b"1.0\n", 1)
FLOATS = [(*row[:3], 40.0, 170.0, 60) for row in ROWS]
THOUSANDS = [(*(f"{value:010,.4f}" for value in row[:3]), *GREEN) for row in ROWS]
GERMAN = "X;Y;Höhe;Rot;Grün;Blau\n" + table(";", comma=True)
LOUD, V_NAMES = ply_bytes("ascii", rows=FLOATS, properties=XYZRGB).replace(b"float", b"Float"), "V1 V2 V3 V4 V5 V6\n"
GREYS = table(",", columns=[(*point, 0, 0) for point in POINTS])
HASHED = [("#" * (i % 2) + str(i), *point) for i, point in enumerate(POINTS)]
MILLIMETRES = "".join(",".join(f'"{x:,}"' for x in row) + "\n" for row in BALL_IN_MILLIMETRES.tolist())
QUOTED = "\n".join(",".join(f'"{x}"'.replace(".", ",") for x in point) for point in BALL.tolist())
POINT_LINES = "".join("v {:g} {:g} {:g}\n".format(*point) for point in POINTS)
SPARSE = "".join(f"{row},{'' if i % 4 else 'chair'}\n" for i, row in enumerate(table(",").splitlines()))
NAMES, BARE_COMMAS = "b g r z y x\n", re.sub(r"\b0,", ",", table(";", ";tree", comma=True))
TEXTS = {
    "tabs and empty lines": ("a.tsv", table("\t", "\n")),
    "a byte order mark": ("a.csv", "\ufeffX;Y;Z;R;G;B\n" + table(";")),
    "names in quotes, blanks behind commas": ("a.csv", '"x", "y", "z", "r", "g", "b"\n' + table(", ")),
    "remarks before and among the rows": ("a.txt", "# scanned on Monday\n# x y z r g b\n" + table(" ", "\n# row")),
    "a remark that names an axis": ("a.txt", "// the x axis points to the right\n" + table(" ")),
    "columns in another order": ("a.txt", "//420 points\nb g r z y x\n" + table(" ", columns=BACKWARDS)),
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
    "an array of NumPy, printed": ("a.txt", "p = np.array([[" + table(", ").replace("\n", "],\n[")[:-3] + "])"),
    "thousands, Swiss": ("a.txt", table(" ", columns=THOUSANDS).replace(",", "'")),
    "thousands, German": ("a.txt", table(";", columns=THOUSANDS).translate({44: ".", 46: ","})),
    "thousands, in quotes": ("a.csv", '"' + table('","', '"', columns=THOUSANDS).replace("\n", '\n"')[:-1]),
    "packed colours in words": ("a.csv", "x,y,z,colour\n" + table(",", ",#28AA3C", columns=POINTS)),
    "packed opaque colours": ("a.csv", "x,y,z,hex\n" + table(",", ",#28AA3Cff", columns=POINTS)),
    "packed colours in words, without names": ("a.txt", table(" ", " 0x28aa3c", columns=POINTS)),
    "rows of dashes": ("a.txt", NAMES + 150 * "- - - - - -\n" + table(" ", columns=BACKWARDS) + "1 - 1 1 2 3\n"),
    "first rows undefined": ("a.csv", "b,g,r,z,y,x\n" + 150 * ",,null,,,\n" + table(",", columns=BACKWARDS)),
    "a first row with words": ("a.csv", "i,x,y,z,r,g,b\nP,null,1,1,1,2,3\n" + WORDY.split("\n", 1)[1]),
    "a label that is empty, then words": ("a.csv", "x,y,z,r,g,b,name\n9,nan,9,1,2,3,\n" + table(",", ",car")),
    "labels here and there": ("a.csv", "x,y,z,r,g,b,name\n" + SPARSE),
    "labels here and there, not in the first row": ("a.csv", "x,y,z,r,g,b,name\n9,nan,9,1,2,3,\n" + SPARSE),
    "numbers, the first with a letter": ("a.csv", "x,y,z,r,g,b,name\n9,nan,9,1,2,3,A1\n" + table(",", ",12")),
    "names behind a word": ("a.txt", "# columns: b g r z y x\n" + table(" ", columns=BACKWARDS)),
    "a title like names": ("a.txt", "xyz\n" + table(" ")),
    "names in one word": ("a.txt", "# bgrzyx\n" + table(" ", columns=BACKWARDS)),
    "names in brackets": ("a.txt", "# ['b', 'g', 'r', 'z', 'y', 'x']\n" + table(" ", columns=BACKWARDS)),
    "names behind a semicolon": ("a.txt", "; b g r z y x\n" + table(" ", columns=BACKWARDS)),
    "words first, decimal commas": ("a.csv", WORDY.replace(",", ";").replace(".", ",")),
    "words with blanks between tabs": ("a.tsv", "x\ty\tz\tr\tg\tb\tname\n" + table("\t", "\told chair")),
    "a missing number between tabs": ("a.tsv", "x\ty\tz\tr\tg\tb\n" + table("\t") + "1\t\t1\t1\t2\t3\n"),
    "Excel's missing values": ("a.csv", "x,y,z,r,g,b\n" + table(",") + "1,#N/A,1,1,2,3\n"),
    "a label that is a dash, then words": ("a.csv", "x,y,z,r,g,b,name\n9,nan,9,1,2,3,-\n" + table(",", ",car")),
    "names in quotes in any file": ("a.dat", '"x","y","z","r","g","b"\n' + table(",")),
    "names in any file, minus signs": ("a.prn", "  X Y Z R G B\n" + table("  ").replace("-", "\N{MINUS SIGN}")),
    "velocities beside colours": ("a.csv", "x,y,z,r,g,b,linear.x,linear.y,linear.z\n" + table(",", ",-2,0,7")),
    "names with blanks between tabs": ("a.tsv", "Y Coord\tX Coord\tZ Coord\tR\tG\tB\n" + table("\t", columns=NORTHING)),
    "packed colours with a sign": ("a.csv", "x,y,z,rgb\n" + table(",", columns=PACKED)),
    "names of a mesh": ("a.csv", "vertex_x,vertex_y,vertex_z,r,g,b\n" + table(",")),
    "tables of Matlab": ("a.csv", "Location_1,Location_2,Location_3,Color_1,Color_2,Color_3\n" + table(",")),
    "names of a map in German": ("a.csv", "Nord;Ost;Hoehe;R;G;B\n" + table(";", columns=NORTHING)),
    "units in brackets": ("a.csv", "X [m],Y [m],Z [m],R,G,B\n" + table(",")),
    "pandas' index": ("a.csv", ",x,y,z,red,green,blue\n" + table(",", columns=INDEXED)),
    "trailing commas": ("a.csv", "x,y,z,r,g,b\n" + table(",", ",")),
    "trailing commas, names as well": ("a.csv", "x,y,z,r,g,b,\n" + table(",", ",")),
    "trailing semicolons": ("a.txt", table(";", ";")),
    "decimal commas": ("a.csv", "x;y;z;r;g;b\n" + table(";", comma=True)),
    "grey: decimal commas in an OBJ": ("a.obj", POINT_LINES.replace(".", ",")),
    "grey: decimal commas in an OFF": ("a.off", "OFF\n420 0 0\n" + table(" ", comma=True, columns=POINTS)),
    "grey: decimal commas in a PLY": ("a.ply", COMMA_PLY),
    "names of a grid": ("a.csv", "Grid Northing,Grid Easting,Elevation,R,G,B\n" + table(",", columns=NORTHING)),
    "decimal commas between blanks": ("a.txt", table(" ", comma=True)),
    "an array's columns by number, as pandas writes them": ("a.csv", "0,1,2,3,4,5\n" + table(",")),
    "counts of points and columns": ("a.xyz", "420 6\n" + table(" ")),
    "decimal commas without a 0, and a label": ("a.csv", "x;y;z;r;g;b;label\n,5;,25;nan;1;2;3;7\n" + BARE_COMMAS),
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
    **{f"PCD, {size}": ("a.pcd", PCL.replace("POINTS 420", size) + table(" ", columns=OPAQUE)) for size in SIZES},
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
    for shape in ((20, 21, 3), (5, 4, 21, 3), (20, 21, 1, 3)):
        np.save(tmp_path / "a.npy", BALL.reshape(shape))
        cloud, lines = read(tmp_path / "a.npy")
        np.testing.assert_allclose(cloud.positions, BALL, atol=1e-6)
        assert lines[0].startswith(f"an array of {' x '.join(map(str, shape))} taken as one cloud; of a batch")
    np.save(tmp_path / "b.npy", np.column_stack([BALL, np.tile(np.array([*GREEN, 255]) / 255, (420, 1))]))
    np.testing.assert_allclose(read_cloud(tmp_path / "b.npy").base_color[0], LINEAR, atol=1e-3)
    opaque = np.tile(np.uint8([*GREEN, 255]), (420, 1))
    ignored = {"arr_3": np.arange(420), "arr_4": np.zeros((420, 9)), "arr_5": 3 * BALL}
    tables = {"arr_0": BALL, "arr_1": opaque[:, :3], "arr_2": BALL} | ignored
    turned = {"vertices": BALL.T, "vertex_colors": opaque[:, :3].T}
    maps = {"pts3d": BALL.reshape(20, 21, 3), "point_rgb": opaque.reshape(20, 21, 4)}
    separate = dict(zip("xyz", BALL.T, strict=True)) | {"rgb": opaque, "v": BALL[:9]}
    igl = {"v": BALL, "f": np.zeros((9, 3)), "rgba": opaque}
    for arrays in ({"arr_0": ROWS}, tables, separate, {"pc": np.array(ROWS)}, turned, maps, igl):
        np.savez(tmp_path / "c.npz", **arrays)
        np.testing.assert_allclose(read_cloud(tmp_path / "c.npz").base_color[0], LINEAR, atol=1e-3)


NUMBERED, NUMBERS = ["x", "y", "z", *(f"c{i}" for i in range(20))], np.column_stack([BALL, np.zeros((420, 20))])
ODD = np.zeros(420, [*((axis, "f8") for axis in "xyz"), ("name", "U8"), ("fpfh", "f4", 33)])
ODD["x"], ODD["y"], ODD["z"] = BALL.T
HALF = [(*row, 255 * (i % 2)) for i, row in enumerate(ROWS)]
MOVING = np.column_stack([BALL, np.roll(BALL, 1, axis=0) * np.arange(1, 4)])


@pytest.mark.parametrize("first", [True, False])
def test_an_intensity_that_is_the_luminance_of_the_colours_is_none_of_them(tmp_path, first):
    colors = np.random.default_rng(0).integers(0, 256, (420, 1)) // [1, 2, 4]
    grey = np.round(colors @ [0.299, 0.587, 0.114])[:, None]
    rows = np.column_stack([BALL, grey, colors] if first else [BALL, colors, grey])
    cloud, _ = read(write(tmp_path, "a.txt", table(" ", columns=rows)))
    np.testing.assert_allclose(cloud.base_color, SRGB[colors], atol=1e-4)


SEPARATE = dict(zip("xyz", BALL.T, strict=True))
NO_COLUMNS = {"roughness": np.array(0.3), "cd": np.array(9 * ["a"])}
UNNAMED = "the 7 columns, which have no names, taken as "
REMARKS = "210 rows that begin with a mark of remarks (# // %) are not read"
ORDER = "lines that may name the columns in another order, and are"
NO_COLOR = "1 of 421 colours are no number or #rrggbb, and taken as black"
BELOW = "lines below the names that are not read: "
LEFT_OUT = "210 of 420 points left out: opacity near 0 (--keep-noise keeps them)"
UNFIT = "arrays that are not used, which name no column of the 420 points: "
LINEAR_BYTES = "base_color_r base_color_g base_color_b taken as linear in 0..255"
ASSUMED = [  # file, beginning of a line that is said about it
    ("a.pts", "999\n" + table(" "), "a line of the file announces 999 points, 420 are there: is the file cut off?"),
    ("a.pts", "300\n" + table(" ") + "100\n", "a line of the file announces 400 points, 420 are there"),
    ("a.txt", table(" ", columns=LABELED), UNNAMED + "x y z r g b scalar; r g b may"),
    ("a.npy", as_npy(ODD), "columns that are not used: name (words), fpfh (33 numbers)"),
    ("a.csv", ",".join(NUMBERED) + "\n" + table(",", columns=NUMBERS), "columns that are not used: c0, c1, c2, c3"),
    ("a.csv", "x,y,z,Roughness (0.1),label\n" + GREYS, "columns that are not used: roughness (0.1), label"),
    ("a.csv", "id,x,y,z\n" + table(",", columns=HASHED), REMARKS),
    ("a.txt", "# 1:z 2:y 3:x\n" + table(" ", columns=POINTS), ORDER),
    ("a.csv", "x,y,z,r,g,b,R\n" + table(",", ",0"), "names that occur twice, of which the first column is read: r"),
    ("a.csv", "x,y,z,hex\n" + table(",", ",#28aa3c", columns=POINTS) + "1,2,3,none\n", NO_COLOR),
    ("a.csv", MILLIMETRES, "whole numbers among small ones of three decimals in x, y, z: write thousands"),
    ("a.csv", "x,y,z,u,v\ntop left,,\nm,m,m,,\n" + GREYS, BELOW + "top left,,, m,m,m,,"),
    ("a.csv", "x,y,z,color_r,color_g,color_b,a\n" + table(",", columns=HALF), LEFT_OUT),
    ("a.csv", "x,y,z,rgb_1,rgb_2,rgb_3,rgb_4\n" + table(",", columns=HALF), LEFT_OUT),
    ("a.csv", "x,y,z,albedo_r,albedo_g,albedo_b\n" + table(","), LINEAR_BYTES),
    ("a.csv", "x,y,z,rgb\n" + table(",", ",99999", columns=POINTS) + "1,2,3,nan\n", NO_COLOR),
    ("a.npz", pack_arrays({"points": BALL, "data": np.zeros((30, 9))}), UNFIT + "data"),
    ("a.npz", pack_arrays(SEPARATE | NO_COLUMNS), UNFIT + "roughness, cd"),
    ("a.csv", "x,y,z,af,s\n" + GREYS, "columns that are not used: af, s"),
    ("a.npz", pack_arrays({"v": BALL, "cd": np.uint8([GREEN] * 420)}), LINEAR_BYTES),
    ("a.npz", pack_arrays({"coord": BALL, "faces": BALL, "id": BALL}), "arrays that are not used: faces, id"),
    ("a.npz", pack_arrays({"points": BALL, "y": np.arange(420) % 4, "rgb": np.zeros(3)}), UNFIT + "y, rgb"),
    ("a.txt", table(" ", columns=MOVING), "the 6 columns, which have no names, taken as x y z intensity scalar scalar"),
]


@pytest.mark.parametrize(("name", "data", "line"), ASSUMED)
def test_what_is_assumed_or_not_used_is_said(tmp_path, name, data, line):
    lines = read(write(tmp_path, name, data))[1]
    assert any(found.startswith(line) for found in lines)
    assert any(found.endswith("c11 and 8 more") for found in lines) == ("c0" in line)


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


def test_the_lowest_intensity_is_no_missing_colour(tmp_path):
    lowest = np.random.default_rng(0).random(420) < 0.3
    rows = [(*p, 0 if low else 50 + i % 40) for i, (p, low) in enumerate(zip(BALL.tolist(), lowest, strict=True))]
    cloud, lines = read(write(tmp_path, "a.xyz", table(" ", columns=rows)))
    np.testing.assert_array_equal(cloud.base_color[:, 0] < 0.01, lowest)
    assert not any("no colour (0 0 0)" in line for line in lines)
