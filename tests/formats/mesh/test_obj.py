"""OBJ + MTL files: geometry and materials against values that the tests write down themselves."""

import numpy as np
import pytest
from support.gltf_files import png

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.texels import srgb_to_linear

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
UV = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
CHECKER = np.random.default_rng(1).integers(0, 256, (4, 4, 3))


def load(tmp_path, text, mtl=None):
    if mtl is not None:
        (tmp_path / "look.mtl").write_text(mtl)
        text = "mtllib look.mtl\n" + text
    (tmp_path / "object.obj").write_text(text)
    return load_mesh(tmp_path / "object.obj")


def load_material(tmp_path, mtl, uv=""):
    corners = "1/1 2/2 3/3 4/4" if uv else "1 2 3 4"
    return load(tmp_path, f"{SQUARE}{uv}usemtl paint\nf {corners}\n", f"newmtl paint\n{mtl}\n")


def reason(tmp_path, *text):
    with pytest.raises(RejectedAsset) as caught:
        load(tmp_path, *text)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def areas_and_normals(part):
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    cross = np.cross(b - a, c - a)
    return np.linalg.norm(cross, axis=-1).sum() / 2, cross / np.linalg.norm(cross, axis=-1, keepdims=True)


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3 4\n",
        "f 1 2 3\nf 1 3 4\n",
        "f -4 -3 -2 -1\n",
        "\tf\t1 2 3\n  f 1 3 4\n",
        "f 1 2 3 \\\n4\n",
    ],
)
def test_every_way_to_write_a_square_gives_it(tmp_path, faces):
    (part,) = load(tmp_path, SQUARE + faces).parts
    area, normals = areas_and_normals(part)
    assert area == pytest.approx(1)
    np.testing.assert_allclose(normals, [[0, 0, 1]] * 2)
    assert part.normals is None


def test_a_pentagon_beside_a_triangle_keeps_its_area(tmp_path):
    pentagon = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 1 2 0\nv 0 1 0\nf 1 2 3 4 5\n"
    assert areas_and_normals(load(tmp_path, pentagon).parts[0])[0] == pytest.approx(3)
    assert areas_and_normals(load(tmp_path, pentagon + "f 1 3 5\n").parts[0])[0] == pytest.approx(4)


def test_relative_numbers_count_from_where_they_stand(tmp_path):
    (part,) = load(tmp_path, SQUARE + "f -4 -3 -2 -1\n" + SQUARE.replace(" 0\n", " 5\n") + "f -4 -3 -2 -1\n").parts
    assert len(part.faces) == 4
    assert {tuple(p) for p in part.positions} == {(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 5)}


def test_normals_are_kept_and_v_is_counted_from_above(tmp_path):
    text = SQUARE + UV + "vn 0 0 2\nusemtl paint\nf 1/1/1 2/2/1 3/3/1 4/4/1\n"
    (tmp_path / "wood.png").write_bytes(png(CHECKER))
    (part,) = load(tmp_path, text, "newmtl paint\nmap_Kd wood.png\n").parts
    np.testing.assert_array_equal(part.normals, [[0, 0, 1]] * 4)
    np.testing.assert_allclose(part.texcoords, np.stack([part.positions[:, 0], 1 - part.positions[:, 1]], axis=-1))


def test_factors_roughness_and_metallic_are_read(tmp_path):
    (part,) = load_material(tmp_path, "Kd 0.1 0.2 0.3\nPr 0.25\nPm 0.75\nNs 10").parts
    np.testing.assert_array_equal(part.material.base_color, np.float32([0.1, 0.2, 0.3]))
    assert (part.material.roughness, part.material.metallic) == (0.25, 0.75)


def test_roughness_comes_from_the_exponent_or_is_one_half(tmp_path):
    assert load_material(tmp_path, "Ns 98").parts[0].material.roughness == pytest.approx(np.sqrt(2 / 100))
    assert load_material(tmp_path, "Kd 1 1 1").parts[0].material.roughness == 0.5


def test_a_texture_is_linearised_and_replaces_the_placeholder_beside_it(tmp_path):
    (tmp_path / "my wood.png").write_bytes(png(CHECKER))
    asset = load_material(tmp_path, "Kd 0.8 0.8 0.8\nmap_Kd -mm 0 1 -clamp on my wood.png", UV)
    np.testing.assert_allclose(asset.parts[0].material.base_color, srgb_to_linear(CHECKER / 255), atol=1e-6)
    assert asset.parts[0].material.wrap == "clamp"
    assert asset.ignored == ("MTL Kd beside map_Kd", "MTL map option -mm")


def test_maps_are_scaled_and_shifted_and_a_name_may_begin_with_a_digit(tmp_path):
    (tmp_path / "3d wood.png").write_bytes(png(CHECKER))
    asset = load_material(tmp_path, "map_Kd -s 2 0.5 1 -o -.25 1e-1 3d wood.png", UV)
    u, v, _ = asset.parts[0].positions.T  # as the file has them, v from below
    expected = np.stack([2 * u - 0.25, 1 - (0.5 * v + 0.1)], axis=-1)
    np.testing.assert_allclose(asset.parts[0].texcoords, expected, atol=1e-12)
    assert asset.ignored == ()


def test_maps_of_one_material_that_lie_differently_are_named(tmp_path):
    (tmp_path / "wood.png").write_bytes(png(CHECKER))
    asset = load_material(tmp_path, "map_Pr wood.png\nmap_Kd -s 2 wood.png", UV)
    np.testing.assert_allclose(asset.parts[0].texcoords[:, 0], 2 * asset.parts[0].positions[:, 0])
    assert asset.ignored == ("MTL maps of one material that lie differently (the first one's options are used)",)


def test_two_materials_with_odd_names_make_two_parts(tmp_path):
    text = SQUARE + "usemtl dark wood #2\nf 1 2 3\nusemtl usemtl \nf 1 3 4\n"
    parts = load(tmp_path, text, "newmtl dark wood #2\nKd 0.25 0 0\nnewmtl usemtl\nKd 0 0 0.5\n").parts
    look = {tuple(part.material.base_color): part.positions.tolist() for part in parts}
    assert look[0.25, 0, 0] == [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    assert look[0, 0, 0.5] == [[0, 0, 0], [1, 1, 0], [0, 1, 0]]


def test_statements_that_are_not_modelled_are_named(tmp_path):
    assert load_material(tmp_path, "Ke 0 0 0\nmap_Bump bumps.png\nillum 2").ignored == ("MTL map_bump",)


@pytest.mark.parametrize("statement", ["d 0.5", "d -halo 0.9", "Tr 0.3", "map_d mask.png", "d 0"])
def test_transparent_materials_are_refused(tmp_path, statement):
    with pytest.raises(RejectedAsset, match="transparent: material 'paint'"):
        load_material(tmp_path, statement)


@pytest.mark.parametrize("statement", ["d 1.0", "Tr 0", "Tr 1.000", "d 1\nTr 0"])
def test_opaque_materials_are_accepted_whichever_way_tr_counts(tmp_path, statement):
    assert len(load_material(tmp_path, statement).parts) == 1


def test_what_is_missing_is_named(tmp_path):
    assert "missing: 'gone.mtl'" in reason(tmp_path, f"mtllib gone.mtl\n{SQUARE}f 1 2 3\n")
    assert "'other'" in reason(tmp_path, f"{SQUARE}usemtl other\nf 1 2 3\n", "newmtl paint\n")
    texture = "newmtl paint\nmap_Kd gone.png\n"
    assert "missing: 'gone.png'" in reason(tmp_path, f"{SQUARE}usemtl paint\nf 1 2 3\n", texture)
    texture = "newmtl paint\nmap_Kd ..\\gone.png\n"
    assert "outside its own folder" in reason(tmp_path, f"{SQUARE}usemtl paint\nf 1 2 3\n", texture)


def test_broken_text_is_refused(tmp_path):
    assert reason(tmp_path, SQUARE) == "has no faces"
    assert reason(tmp_path, "") == "has no faces"
    assert "not finite" in reason(tmp_path, SQUARE.replace("1 1 0", "1 nan 0") + "f 1 2 3\n")
    assert "broken" in reason(tmp_path, SQUARE + "f 1 2 9\n")
    assert "positions of shape (3, 2)" in reason(tmp_path, SQUARE.replace("1 1 0", "1 1") + "f 1 2 3\n")
    assert "broken" in reason(tmp_path, SQUARE.replace("1 1 0", "1 x 0") + "f 1 2 3\n")


def test_repeated_corners_are_removed_and_counted(tmp_path):
    asset = load(tmp_path, SQUARE + "f 1 1 3\nf 1 2 3\n")
    assert len(asset.parts[0].faces) == 1
    assert asset.ignored == ("1 degenerate faces",)


def test_of_faces_on_the_same_corners_that_of_the_first_material_is_kept_whatever_their_order(tmp_path):
    back = SQUARE.replace("v 1 0 0", "v 1 0 0\nv 1 0 0")  # vertex 3 is vertex 2 again
    text = back + "usemtl red\nf 1 2 4\nusemtl blue\nf 4 3 1\nf 1 4 5\n"
    asset = load(tmp_path, text, "newmtl blue\nKd 0 0 1\nnewmtl red\nKd 1 0 0\n")
    faces = {tuple(part.material.base_color): len(part.faces) for part in asset.parts}
    assert faces == {(1, 0, 0): 1, (0, 0, 1): 1}
    assert asset.ignored == ("1 doubled faces (one of each is kept)",)


@pytest.mark.parametrize("line", ["Kd nan 0 0", "Pm nan", "Pr inf\nKd 1 nan 1"])
def test_a_material_that_is_not_finite_is_refused(line, tmp_path):
    (tmp_path / "a.mtl").write_text(f"newmtl a\n{line}\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    with pytest.raises(RejectedAsset, match="not finite"):
        load_mesh(tmp_path / "a.obj")
