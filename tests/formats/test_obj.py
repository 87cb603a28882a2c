"""OBJ + MTL files: geometry and materials against values that the tests write down themselves."""

import numpy as np
import pytest
from support.gltf_files import png

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import srgb_to_linear
from spnr_jax.formats.meshes import load_mesh

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


SQUARES = "f 1 2 3 4\n", "f 1 2 3\nf 1 3 4\n", "f -4 -3 -2 -1\n", "\tf\t1 2 3\n  f 1 3 4\n", "f 1 2 3 \\\n4\n"


@pytest.mark.parametrize("faces", SQUARES)
def test_every_way_to_write_a_square_gives_it_and_relative_numbers_count_from_where_they_stand(tmp_path, faces):
    (part,) = load(tmp_path, SQUARE + faces + SQUARE.replace(" 0\n", " 5\n") + "f -4 -3 -2 -1\n").parts
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a), [[0, 0, 1]] * 4)
    assert {tuple(p) for p in part.positions} == {(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 5)}
    assert part.normals is None


def test_normals_are_kept_and_v_is_counted_from_above(tmp_path):
    text = SQUARE + UV + "vn 0 0 2\nusemtl paint\nf 1/1/1 2/2/1 3/3/1 4/4/1\n"
    (tmp_path / "wood.png").write_bytes(png(CHECKER))
    (part,) = load(tmp_path, text, "newmtl paint\nmap_Kd wood.png\n").parts
    np.testing.assert_array_equal(part.normals, [[0, 0, 1]] * 4)
    np.testing.assert_allclose(part.texcoords, np.stack([part.positions[:, 0], 1 - part.positions[:, 1]], axis=-1))


def test_a_texture_is_linearised_and_replaces_the_placeholder_beside_it(tmp_path):
    (tmp_path / "3d wood.png").write_bytes(png(CHECKER))
    asset = load_material(tmp_path, "Kd 0.8 0.8 0.8\nmap_Kd -s 2 -.5 1e-1 -clamp on 3d wood.png", UV)
    np.testing.assert_allclose(asset.parts[0].material.base_color, srgb_to_linear(CHECKER / 255), atol=1e-6)
    assert asset.parts[0].material.wrap == "clamp"
    assert asset.ignored == ("MTL Kd beside map_Kd", "MTL map option -s")


def test_two_materials_with_odd_names_make_two_parts(tmp_path):
    text = SQUARE + "usemtl dark wood #2\nf 1 2 3\nusemtl usemtl \nf 1 3 4\n"
    parts = load(tmp_path, text, "newmtl dark wood #2\nKd 0.25 0 0\nnewmtl usemtl\nKd 0 0 0.5\n").parts
    look = {tuple(part.material.base_color): part.positions.tolist() for part in parts}
    assert look[0.25, 0, 0] == [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    assert look[0, 0, 0.5] == [[0, 0, 0], [1, 1, 0], [0, 1, 0]]


def test_of_faces_on_the_same_corners_that_of_the_first_material_is_kept_whatever_their_order(tmp_path):
    back = SQUARE.replace("v 1 0 0", "v 1 0 0\nv 1 0 0")  # vertex 3 is vertex 2 again
    text = back + "usemtl red\nf 1 2 4\nusemtl blue\nf 4 3 1\nf 1 4 5\n"
    asset = load(tmp_path, text, "newmtl blue\nKd 0 0 1\nnewmtl red\nKd 1 0 0\n")
    faces = {tuple(part.material.base_color): len(part.faces) for part in asset.parts}
    assert faces == {(1, 0, 0): 1, (0, 0, 1): 1}
    assert asset.ignored == ("1 doubled faces (one of each is kept)",)


@pytest.mark.parametrize(
    ("mtl", "roughness", "metallic"),
    [
        ("Kd 0.1 0.2 0.3\nPr 0.25\nPm 0.75\nNs 10", 0.25, 0.75),
        ("Kd 0.1 0.2 0.3\nNs 98\nd 1\nTr 0", np.sqrt(2 / 100), 0),
        ("Kd 0.1 0.2 0.3\nTr 1.000\nd 1.0", 0.5, 0),
    ],
)
def test_an_opaque_material_has_its_colour_and_the_roughness_of_pr_or_of_the_exponent(
    tmp_path, mtl, roughness, metallic
):
    look = load_material(tmp_path, mtl).parts[0].material
    np.testing.assert_array_equal(look.base_color, np.float32([0.1, 0.2, 0.3]))
    np.testing.assert_allclose([look.roughness, look.metallic], [roughness, metallic], rtol=1e-6)


TRANSPARENT = "d 0.5", "d -halo 0.9", "d 0", "Tr 0.3", "map_d mask.png"
PAINTED = f"{SQUARE}usemtl paint\nf 1 2 3\n"


@pytest.mark.parametrize(
    ("text", "mtl", "words"),
    [
        *((PAINTED, f"newmtl paint\n{line}\n", "is transparent: material 'paint'") for line in TRANSPARENT),
        *((PAINTED, f"newmtl paint\n{line}\n", "not finite") for line in ("Kd nan 0 0", "Pm nan")),
        (PAINTED, "newmtl paint\nmap_Kd gone.png\n", "missing: 'gone.png'"),
        (PAINTED, "newmtl paint\nmap_Kd ..\\gone.png\n", "outside its own folder"),
        (PAINTED, "newmtl other\n", "'paint'"),
        (f"mtllib gone.mtl\n{SQUARE}f 1 2 3\n", None, "missing: 'gone.mtl'"),
        (SQUARE, None, "has no faces"),
        ("", None, "has no faces"),
        (SQUARE.replace("1 1 0", "1 nan 0") + "f 1 2 3\n", None, "not finite"),
        (SQUARE + "f 1 2 9\n", None, "name v 9 of 4: broken"),
        (SQUARE.replace("1 1 0", "1 1") + "f 1 2 3\n", None, "broken"),
        (SQUARE + "f -5 2 3\n", None, "before the first"),
        (SQUARE.replace("1 1 0", "1 x 0") + "f 1 2 3\n", None, "broken"),
        (SQUARE + "f 1 1 3\n", None, "no face with an area"),
    ],
)  # fmt: skip
def test_what_is_transparent_missing_or_broken_is_refused_in_one_line(tmp_path, text, mtl, words):
    with pytest.raises(UserError, match=words) as caught:
        load(tmp_path, text, mtl)
    assert "\n" not in str(caught.value)
