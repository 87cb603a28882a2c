"""Meshes as people have them: polygons, STL files that say something else, faces without numbers, textures."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.mesh_files import CORNERS, RGB, TEXCOORDS, TEXTURE, TWO_SQUARES, UNIT_UV, square_ply, stl, two_squares_ply
from support.point_clouds import GREEN, LINEAR, read, write

from spnr_jax.formats.clouds import read_cloud
from spnr_jax.kernels.imaging import srgb_to_linear


def test_an_l_of_one_face_keeps_its_notch(tmp_path):
    corners = [f"{x} {y} 0" for x, y in ((2, 0), (2, 0.5), (0.5, 0.5), (0.5, 2), (0, 2), (0, 0))]  # no fan of triangles
    obj = "".join(f"v {corner}\n" for corner in corners) + "f 1 2 3 4 5 6\n"
    off = "\n".join(["OFF\n6 1 0", *corners, "6 0 1 2 3 4 5\n"])
    for name, content in (("a.obj", obj), ("a.off", off)):
        cloud = read_cloud(write(tmp_path, name, content), num_points=1000)
        assert not (cloud.positions[:, :2] > 0.501).all(axis=1).any()
        assert (cloud.positions[:, 1] > 0.5).mean() == pytest.approx(0.75 / 1.75, abs=0.05)


def test_an_stl_is_read_by_its_size_and_words_whatever_its_beginning_and_its_count_say(tmp_path):
    for content in (stl(2), stl(2, b"a tail!"), stl(0)):
        cloud, lines = read(write(tmp_path, "a.stl", content), num_points=200)
        np.testing.assert_allclose(np.ptp(cloud.positions, axis=0), [1, 1, 0], atol=0.03)
    assert "the header announces 0 triangles, 2 stand behind it, 2 are read" in lines
    _, lines = read(write(tmp_path, "a.stl", stl(1)), num_points=9)
    assert "the header announces 1 triangles, 2 stand behind it, 1 are read" in lines
    facet = "FACET NORMAL 0 0 1\nOUTER LOOP\nVERTEX 0 0 0\nVERTEX 1 0 0\nVERTEX 1 1 0\nENDLOOP\nENDFACET\n"
    binary = b"solid of a facet".ljust(80, b"\0") + stl(2)[80:]
    for content in (binary, f"SOLID a\n{facet}ENDSOLID", facet):
        cloud, lines = read(write(tmp_path, "a.stl", content), num_points=9)
        assert len(cloud.positions) == 9
        assert any("'endsolid'" in line for line in lines) == (content == facet)
    cut = f"solid a\n{facet}vertex 0 0", "vertex 4: expected 3 numbers, found '0 0'"
    for content, reason in ((stl(3), "announces 3 triangles, 2 are there"), cut):
        with pytest.raises(ValueError, match=reason):
            read(write(tmp_path, "a.stl", content))


def test_faces_with_a_vertex_that_is_no_number_are_left_out_and_counted(tmp_path):
    content = square_ply("uchar", RGB, GREEN).replace("0.0 1.0 0.0 40", "nan 1.0 0.0 40")
    corners = "".join(f"v {corner}\n" for corner in [*CORNERS, "0 inf 0"])
    for name, text in (("a.ply", content), ("a.obj", f"{corners}vn 0 0 1\nf 1//1 2//1 5//1\nf 1 2 3\n")):
        cloud, lines = read(write(tmp_path, name, text), num_points=100)
        assert np.isfinite(cloud.positions).all()
        assert "1 face left out for a vertex that is NaN or infinity" in lines


def by_corner(text: str, *values) -> str:
    """The text with the four marks `?` replaced by these values."""
    return "".join(map("".join, zip(text.split("?"), [*map(str, values), ""], strict=True)))


def of_faces(text: str, properties: str, one: str, other: str) -> str:
    """A PLY file of `square_ply` whose two faces have further properties."""
    text = text.replace("end_header", properties)
    return text.replace("3 0 1 2", f"3 0 1 2 {one}").replace("3 0 2 3", f"3 0 2 3 {other}")


TWO, TWO_OF_OBJ = "3 0 1 2\n3 0 2 3\n", "f 1 2 3\nf 1 3 4\n"
FACES_RGBA = "".join(f"property uchar {name}\n" for name in (*RGB, "alpha")) + "end_header"
HIDDEN = {  # a square of which the first triangle is transparent
    "COFF": ("a.off", "COFF\n4 2 0\n" + by_corner("".join(f"{c} 1 1 1 ?\n" for c in CORNERS), 0, 0, 0, 1) + TWO),
    "OBJ": ("a.obj", by_corner("".join(f"v {c} 1 1 1 ?\n" for c in CORNERS), 0, 0, 0, 1) + TWO_OF_OBJ),
    "opacity": ("a.ply", by_corner(square_ply("float", ["opacity"], "?"), 0, 0, 0, 1)),
    "rgba": ("a.ply", by_corner(square_ply("uint", ["rgba"], "?"), 1, 1, 1, 2**32 - 1)),
    "faces of OFF": ("a.off", "OFF\n4 2 0\n" + "\n".join(CORNERS) + "\n3 0 1 2 9 9 9 0\n3 0 2 3 9 9 9 255\n"),
    "faces of PLY": ("a.ply", of_faces(square_ply("uchar", RGB, GREEN), FACES_RGBA, "9 9 9 0", "9 8 9 255")),
}


@pytest.mark.parametrize("case", HIDDEN)
def test_faces_that_are_transparent_are_left_out_and_counted(tmp_path, case):
    cloud, lines = read(write(tmp_path, *HIDDEN[case]), num_points=100)
    assert (cloud.positions[:, 1] >= cloud.positions[:, 0]).all()
    assert "1 face left out for their alpha, near 0" in lines
    if case == "COFF":
        invisible = HIDDEN[case][1].replace(" 1\n", " 0\n")
        assert not any("alpha" in line for line in read(write(tmp_path, "a.off", invisible))[1])


BOTH = by_corner(square_ply("uchar", ["r", "g", "b"], ("?", 0, 0)), 1, 2, 3, 4)
FLAGS, LASER = "property int flags\nproperty float quality\nend_header", ("classification", "withheld")
UNUSED = {
    "columns of faces that are not used: red, green, blue, alpha": of_faces(BOTH, FACES_RGBA, "1 1 1 0", "9 9 9 9"),
    "columns of faces that are not used: flags, quality": of_faces(BOTH, FLAGS, "0 0", "0 0"),
    "ignored: classification of vertices; withheld of vertices": square_ply("uchar", LASER, (7, 1)),
}


@pytest.mark.parametrize("line", UNUSED)
def test_what_a_mesh_holds_and_is_not_used_is_said(tmp_path, line):
    assert line in read(write(tmp_path, "a.ply", UNUSED[line]), num_points=9)[1]


@pytest.mark.parametrize(("behind", "values"), [("?", (1, 1, 2, 1)), ("1 1 0 ? 0 1", (0, 0, 0, 1))])
def test_weights_and_normals_behind_the_vertices_of_an_obj_are_said_and_no_alpha(tmp_path, behind, values):
    content = by_corner("".join(f"v {c} {behind}\n" for c in CORNERS), *values) + TWO_OF_OBJ
    lines = read(write(tmp_path, "a.obj", content), num_points=9)[1]
    assert "ignored: numbers behind the coordinates of vertices" in lines
    assert not any("alpha" in line for line in lines)


def test_beside_a_texture_alpha_is_used_and_what_is_not_used_is_said(tmp_path):
    Image.new("RGB", (4, 4), GREEN).save(tmp_path / "wood.png")
    of_vertex = "".join(f"property float {name}\n" for name in ("red", "green", "blue", "alpha", "quality"))
    faces, of_face = 2 * [f"{UNIT_UV} 0 7"], TEXTURE + "property int flags\n"
    content = two_squares_ply("comment TextureFile wood.png\n", of_vertex, of_face, "1.5 0 0 {2}0 1", faces)
    cloud, lines = read(write(tmp_path, "a.ply", content), num_points=50)
    assert is_green(cloud)
    assert (cloud.positions[:, 2] == 5).all()
    unused = {"columns that are not used: quality", "columns of faces that are not used: flags"}
    assert unused | {"colours of the vertices not used beside those of a texture"} <= {*lines}


def test_texture_coordinates_of_an_off_are_no_colours(tmp_path):
    content = "STOFF\n4 2 0\n" + "".join(f"{c} 0 1\n" for c in CORNERS) + TWO
    assert not any("not used" in line for line in read(write(tmp_path, "a.off", content), num_points=9)[1])


def textured_obj(folder: Path, image: str, mtl: bytes) -> Path:
    """A green square of the material `a`, whose image and library lie where they are said to."""
    (folder / image).parent.mkdir(exist_ok=True)
    Image.new("RGB", (4, 4), GREEN).save(folder / image)
    write(folder, "a.mtl", mtl)
    vertices = "".join(f"v {corner}\n" for corner in CORNERS)
    return write(folder, "a.obj", f"mtllib a.mtl\n{vertices}{TEXCOORDS}usemtl a\nf 1/1 2/2 3/3 4/4\n")


def is_green(cloud) -> bool:
    return np.allclose(cloud.base_color, np.broadcast_to(LINEAR, cloud.base_color.shape), atol=2e-3)


@pytest.mark.parametrize(
    ("page", "names"), [("cp1251", "Стена Крыша"), ("gbk", "墙壁 屋顶"), ("shift_jis", "かべ やね")]
)
def test_names_in_an_older_code_page_stay_apart_and_find_their_images(tmp_path, page, names):
    first, second = names.split()
    text = f"mtllib a.mtl\n{TWO_SQUARES}usemtl {first}\nf 1 2 3 4\nusemtl {second}\nf 5 6 7 8\n"
    write(tmp_path, "a.mtl", f"newmtl {first}\nKd 1 0 0\nnewmtl {second}\nKd 0 0 1\n".encode(page))
    cloud = read_cloud(write(tmp_path, "a.obj", text.encode(page)), num_points=50)
    np.testing.assert_array_equal(cloud.base_color, np.where(cloud.positions[:, 2:] < 1, [1, 0, 0], [0, 0, 1]))
    path = textured_obj(tmp_path, f"{first}.png", f"newmtl a\nmap_Kd {first}.png\n".encode(page))
    assert is_green(read_cloud(path, num_points=20))


BESIDE = "textures/wood.png", "../textures/wood.png", "../Textures/wood.png"
IMAGES = [  # where an image lies, and its name in the library
    ("colors.png", r"C:\Users\me\Colors.PNG"),
    ("colors.png", "/home/me/colors.png"),
    ("maps/colors.png", r"Maps\COLORS.png"),
    *itertools.product(BESIDE, ("wood.png", "../textures/wood.png", "C:/Users/me/wood.png")),
]


@pytest.mark.parametrize(("image", "name"), IMAGES)
def test_images_are_found_under_paths_of_other_machines_and_in_a_folder_of_textures(tmp_path, image, name):
    folder = tmp_path / "source"
    folder.mkdir()
    path = textured_obj(folder, image, f"newmtl a\nmap_Kd {name}\n".encode())
    cloud, lines = read(write(folder, "a.obj", path.read_text().replace("a.mtl", "A.MTL")), num_points=20)
    assert is_green(cloud)
    assert not any("missing" in line for line in lines)
    elsewhere = image in BESIDE and not (name.startswith("../textures") and image.startswith("textures"))
    assert ("found in a folder `textures`: 'wood.png'" in lines) == elsewhere


def test_a_folder_that_cannot_be_listed_costs_no_mesh(tmp_path, monkeypatch):
    def refuse(folder):
        raise PermissionError(13, "Permission denied", str(folder))

    path = textured_obj(tmp_path, "wood.png", b"newmtl a\nmap_Kd gone.png\n")
    monkeypatch.setattr(Path, "iterdir", refuse)
    assert "plain values taken where it names a file that is missing: 'gone.png'" in read(path, num_points=5)[1]


def test_colours_of_vertices_do_not_darken_the_texture_beside_them(tmp_path):
    path = textured_obj(tmp_path, "wood.png", b"newmtl a\nmap_Kd wood.png\n")
    write(tmp_path, "a.obj", path.read_text().replace(" 0.0\n", " 0.0 0.2 0.6 0.3\n"))
    cloud, lines = read(path, num_points=20)
    assert is_green(cloud)
    assert "colours of the vertices not used beside those of a texture" in lines
    own, (path, text) = [0.2, 0.6, 0.3], (path, path.read_text())
    Image.new("RGB", (4, 4), "white").save(tmp_path / "wood.png")  # a placeholder
    for content in (text, text.replace("1/1 2/2 3/3 4/4", "1 2 3 4")):
        cloud = read_cloud(write(tmp_path, "a.obj", content), num_points=20)
        np.testing.assert_allclose(
            cloud.base_color, np.broadcast_to(srgb_to_linear(np.float32(own)), (20, 3)), atol=2e-3
        )


PAINTED = 'mtllib "a.mtl"\n' + "".join(f"v {corner}\n" for corner in CORNERS) + "usemtl a\nf 1 2 3 4\n"
BEYOND, NO_NUMBER, DRAWN = "Kd beyond 1", "has no number in its MTL: ", "transparent parts drawn as opaque"
LIBRARIES = {  # base colour, what a line says
    "newmtl\ta\nKd\t0.25\t0.25\t0.25\n": (0.25, None),
    "\ufeffnewmtl a\nKd 0.25 0.25 0.25\n": (0.25, None),
    "newmtl a\nKd 0.25 0.25 0.25 # grey\n": (0.25, None),
    "newmtl a\nKd 0.25\n": (0.25, None),
    'newmtl a\nmap_Kd -type sphere -imfchan r "gone.png"\nKd 0.25\n': (0.25, None),
    "newmtl a\nKd 63.75 63.75 63.75\n": (0.25, BEYOND),
    "newmtl a\nKd 0,25 0 1\nNs\nd\n": ([0.25, 0, 1], None),
    "newmtl a\nKd 0.25, 0, 1\nNs many": ([0.25, 0, 1], NO_NUMBER),
    "newmtl a\nKd 0.25 0 1 factor 2\nKe x": ([0.25, 0, 1], None),
    "newmtl a\nKd 0.25 0": (0.25, None),
    "newmtl a\nKd xyz 0.1 0.2 0.3": (0.5, NO_NUMBER),
    "newmtl a\nd -HALO 0.5\n": (0.5, DRAWN),
}


@pytest.mark.parametrize("library", LIBRARIES)
def test_libraries_of_materials_are_read_however_they_are_written(tmp_path, library):
    color, said = LIBRARIES[library]
    write(tmp_path, "a.mtl", library)
    cloud, lines = read(write(tmp_path, "a.obj", PAINTED), num_points=5)
    np.testing.assert_allclose(cloud.base_color, np.broadcast_to(color, (5, 3)), atol=1e-6)
    np.testing.assert_array_equal(cloud.roughness, 0.5)
    found = [words for words in (BEYOND, NO_NUMBER, DRAWN) if any(words in line for line in lines)]
    assert found == ([said] if said else [])


def test_an_obj_goes_on_in_the_next_line_behind_a_backslash_but_not_in_a_remark(tmp_path):
    write(tmp_path, "a.mtl", "newmtl a\nKd 0 0 1\n")
    text = "# from C:\\folder\\ \n" + PAINTED.replace("f 1 2 3 4", "f 1 \\\n2 3 \\ \n4")
    for newline in ("\n", "\r\n", "\r"):
        cloud = read_cloud(write(tmp_path, "a.obj", text.replace("\n", newline)), num_points=50)
        np.testing.assert_array_equal(cloud.base_color, np.broadcast_to([0, 0, 1], (50, 3)))
        assert np.ptp(cloud.positions, axis=0) == pytest.approx([1, 1, 0], abs=0.2)


@pytest.mark.parametrize("number", [-1, 7])
def test_faces_of_a_ply_that_show_no_image_are_drawn_in_their_own_colours(tmp_path, number):
    Image.new("RGB", (4, 4), GREEN).save(tmp_path / "wood.png")
    for missing in ("wood.png", "gone.png"):
        comments = f"comment TextureFile wood.png\ncomment TextureFile {missing}\n"
        faces = [f"{UNIT_UV} 0", f"{UNIT_UV} {number if missing == 'wood.png' else 1}"]
        cloud, lines = read(write(tmp_path, "a.ply", two_squares_ply(comments, "", TEXTURE, "", faces)), num_points=400)
        low = cloud.positions[:, 2] < 1
        assert np.mean(low) == pytest.approx(0.5, abs=0.05)
        assert is_green(cloud.replace(base_color=cloud.base_color[low]))
        assert (cloud.base_color[~low] == 0.5).all()
        assert "1 of 2 faces show no image of the file: their own colours taken" in lines
    faces = 2 * [f"{UNIT_UV} 1"]  # counted from 1
    path = write(tmp_path, "a.ply", two_squares_ply("comment TextureFile wood.png\n", "", TEXTURE, "", faces))
    assert is_green(read_cloud(path, num_points=50))


def test_colours_of_faces_count_if_all_vertices_have_the_same(tmp_path):
    colors = "".join(f"property uchar {x}\n" for x in RGB)
    content = two_squares_ply("", colors, colors, "255 255 255", ["255 0 0", "0 0 255"])
    cloud, lines = read(write(tmp_path, "a.ply", content), num_points=50)
    np.testing.assert_array_equal(cloud.base_color, np.where(cloud.positions[:, 2:] < 1, [1, 0, 0], [0, 0, 1]))
    assert any("the one colour of all vertices, beside those of faces" in line for line in lines)
    labels = "property int rgb\n", ["1", "2"]
    for of_face, faces in ((colors.replace("uchar", "int"), ["-1 0 0", "0 0 1"]), labels):
        content = two_squares_ply("", colors, of_face, "255 0 0", faces)
        cloud = read_cloud(write(tmp_path, "a.ply", content), num_points=50)
        np.testing.assert_array_equal(cloud.base_color, np.broadcast_to([1, 0, 0], (50, 3)))


def test_lines_and_other_elements_that_are_not_read_are_said(tmp_path):
    lines = read(write(tmp_path, "a.obj", TWO_SQUARES + "l 1 2 3\nl 5 6\n"))[1]
    assert "ignored: lines" in lines
    more = "element material 1\nproperty uchar red\n"
    content = two_squares_ply(more, "", "", "", ["", ""]).replace("end_header\n", "end_header\n7\n")
    assert "ignored: PLY element material" in read(write(tmp_path, "a.ply", content), num_points=9)[1]


def test_intensities_of_vertices_are_grey_and_their_other_columns_are_said(tmp_path):
    rows = two_squares_ply("", "property float intensity\nproperty int flags\n", "", "7 0", ["", ""])
    content = rows.replace("5 7 0", "5 90 0")
    cloud, lines = read(write(tmp_path, "a.ply", content), num_points=50)
    assert (np.ptp(cloud.base_color, axis=1) == 0).all()
    np.testing.assert_array_equal(cloud.base_color[:, 0] > 0.9, cloud.positions[:, 2] > 1)
    assert {"no colour in the file: intensity 7..90 shown as grey", "columns that are not used: flags"} <= {*lines}
