"""Meshes as people have them: polygons, STL files that say something else, faces without numbers, textures."""

import numpy as np
import pytest
from support.mesh_files import CORNERS, RGB, square_ply, stl
from support.point_clouds import GREEN, LINEAR, read, write

from spnr_jax.formats.clouds import read_cloud
from spnr_jax.kernels.triangles import ears


def test_an_l_of_one_face_keeps_its_notch_wherever_the_face_begins(tmp_path):
    corners = [(0, 0), (2, 0), (2, 0.5), (0.5, 0.5), (0.5, 2), (0, 2)]
    for roll in range(6):
        rolled = corners[roll:] + corners[:roll]
        vertices = "".join(f"v {x} {y} 0\n" for x, y in rolled)
        off = "OFF\n6 1 0\n" + "".join(f"{x} {y} 0\n" for x, y in rolled) + "6 0 1 2 3 4 5\n"
        for name, content in (("a.obj", vertices + "f 1 2 3 4 5 6\n"), ("a.off", off)):
            cloud = read_cloud(write(tmp_path, name, content), num_points=1000)
            assert not (cloud.positions[:, :2] > 0.501).all(axis=1).any()
            assert (cloud.positions[:, 1] > 0.5).mean() == pytest.approx(0.75 / 1.75, abs=0.05)


def test_a_wavy_polygon_of_many_corners_keeps_its_area():
    angle = np.linspace(0, 2 * np.pi, 900, endpoint=False)
    corners = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * (1 + 0.3 * np.cos(40 * angle))[:, None]
    a, b, c = np.moveaxis(corners[ears(corners)], 1, 0)
    twice = np.cross(b - a, c - a)[:, 2]
    assert (twice > 0).all()
    assert twice.sum() == pytest.approx(np.cross(corners, np.roll(corners, -1, axis=0))[:, 2].sum())


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
    hidden = "COFF\n4 2 0\n" + "".join(f"{c} 1 1 1 {i // 3}\n" for i, c in enumerate(CORNERS)) + "3 0 1 2\n3 0 2 3\n"
    cloud, lines = read(write(tmp_path, "a.off", hidden), num_points=100)
    assert (cloud.positions[:, 1] >= cloud.positions[:, 0]).all()
    assert "1 face left out for the alpha of their vertices, near 0" in lines
    assert not any("alpha" in line for line in read(write(tmp_path, "a.off", hidden.replace(" 1\n", " 0\n")))[1])


@pytest.mark.parametrize("name", [r"C:\Users\me\Colors.PNG", "/home/me/colors.png", r"Maps\COLORS.png"])
def test_a_texture_beside_its_mesh_is_found_under_a_path_of_another_machine(tmp_path, name):
    from PIL import Image

    place = tmp_path / "maps" / "colors.png" if "Maps" in name else tmp_path / "colors.png"
    place.parent.mkdir(exist_ok=True)
    Image.new("RGB", (4, 4), GREEN).save(place)
    write(tmp_path, "a.mtl", f"newmtl a\nmap_Kd {name}\n")
    vertices = "".join(f"v {corner}\nvt {corner[:7]}\n" for corner in CORNERS)
    write(tmp_path, "a.obj", f"mtllib A.MTL\n{vertices}usemtl a\nf 1/1 2/2 3/3 4/4\n")
    cloud, lines = read(tmp_path / "a.obj", num_points=20)
    np.testing.assert_allclose(cloud.base_color, np.broadcast_to(LINEAR, (20, 3)), atol=2e-3)
    assert not any("missing" in line for line in lines)
