"""Meshes without materials, OBJ with MTL, what lets light through or is missing, and real files."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.gltf_files import CHECKER, CORNERS, SQUARE, UV, GltfBuilder
from support.mesh_files import (
    TEXCOORDS,
    TEXTURE,
    UNIT_UV,
    VERTICES,
    gltf_leaf,
    half_transparent,
    obj_leaf,
    refusal,
    two_squares_ply,
    write_obj,
)

from data_gen.plan.sources import find_meshes
from spnr_jax.errors import UserError
from spnr_jax.formats.meshes import load_mesh
from spnr_jax.formats.surface_points import normalise, sample_surface
from spnr_jax.kernels.imaging import srgb_to_linear

DATA = Path(__file__).parents[3] / "shared" / "data"


@pytest.mark.parametrize("suffix", ["ply", "stl", "stl_ascii", "off", "obj"])
def test_geometry_without_materials_is_grey_half_rough_and_no_metal(tmp_path, suffix):
    path, faces = tmp_path / f"a.{suffix.removesuffix('_ascii')}", SQUARE.reshape(2, 3)
    trimesh.Trimesh(CORNERS, faces, process=False).export(path, file_type=suffix)
    (part,) = load_mesh(path).parts
    found = {tuple(map(tuple, triangle)) for triangle in part.positions[part.faces]}
    assert found == {tuple(map(tuple, triangle)) for triangle in CORNERS[faces].astype(float)}
    np.testing.assert_array_equal(part.material.base_color, [0.5, 0.5, 0.5])
    assert (part.material.roughness, part.material.metallic) == (0.5, 0)


def test_unused_vertices_go_and_normals_become_unit(tmp_path):
    builder = GltfBuilder()
    positions = np.concatenate([np.full((3, 3), 50, np.float32), CORNERS])
    normals = np.tile(np.float32([0, 0, 3]), (7, 1))
    normals[4] = 0
    builder.mesh(builder.primitive(positions, SQUARE + np.uint16(3), NORMAL=normals))
    asset = load_mesh(builder.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(asset.parts[0].positions, CORNERS)
    np.testing.assert_array_equal(asset.parts[0].normals, [[0, 0, 1]] * 4)
    assert asset.ignored == ("some normals without a direction (the faces' are used)",)


def test_a_grey_placeholder_does_not_darken_colours_of_vertices(tmp_path):
    text = "".join(f"v {x} {y} 0 0 1 0\n" for x, y in ((0, 0), (1, 0), (0, 1))) + "usemtl paint\nf 1 2 3\n"
    for color, expected in (("0.8 0.8 0.8", 1.0), ("0.5 0.25 0", np.float32([0.5, 0.25, 0]))):
        asset = load_mesh(write_obj(tmp_path, text, f"newmtl paint\nKd {color}\nPr 0.25\n"))
        np.testing.assert_array_equal(asset.parts[0].material.base_color, np.broadcast_to(expected, 3))
        assert asset.parts[0].material.roughness == 0.25
        assert ("MTL Kd beside colours of the vertices" in asset.ignored) == (np.ndim(expected) == 0)


def test_a_ply_has_its_textures_by_face_or_by_vertex(tmp_path):
    Image.fromarray(CHECKER.astype(np.uint8)).save(tmp_path / "the image.png")
    comment, of_vertex = "comment TextureFile the image.png\n", "property float s\nproperty float t\n"
    by_face = two_squares_ply(comment, "", TEXTURE, "", 2 * [f"{UNIT_UV} 0"])
    for content in (by_face, two_squares_ply(comment, of_vertex, "", "{0} {1}", ["", ""])):
        (tmp_path / "a.ply").write_text(content)
        (part,) = load_mesh(tmp_path / "a.ply").parts
        np.testing.assert_array_equal(part.texcoords, part.positions[:, :2] * [1, -1] + [0, 1])
        np.testing.assert_allclose(part.material.base_color, srgb_to_linear(CHECKER / 255), atol=1e-6)
    (tmp_path / "the image.png").unlink()
    asset = load_mesh(tmp_path / "a.ply", transparent_parts="opaque")
    assert any("missing: 'the image.png'" in note for note in asset.notes)
    np.testing.assert_array_equal(asset.parts[0].material.base_color, 0.5)


# Real files

REAL = pytest.mark.skipif(not DATA.is_dir(), reason="the folder of real mesh files is not beside this checkout")
REFUSED = {  # as references
    "blend_muscle_car": "is transparent: material 'Lamp_glass.003' has alphaMode BLEND",
    "lines_and_triangles_window": "is transparent: material 'Glass_Crystal' has alphaMode BLEND",
    "missing_texture_wicker_chair": "names a file that is missing: 'textures/Wicker_chair_baseColor.png'",
}


@REAL
def test_each_hard_file_is_read_or_refused_with_the_right_reason():
    found = dict(find_meshes(DATA / "hard"))
    assert len(found) == 10
    for name, path in found.items():
        if name in REFUSED:
            with pytest.raises(UserError, match=REFUSED[name]):
                load_mesh(path)
            continue
        points = sample_surface(normalise(load_mesh(path))[0], 256, 0)
        assert all(np.isfinite(values).all() for values in points)
        for values in (points.base_color, points.roughness, points.metallic):
            assert 0 <= values.min() <= values.max() <= 1
        np.testing.assert_allclose(np.linalg.norm(points.normals, axis=-1), 1, atol=1e-5)
        assert np.linalg.norm(points.positions, axis=-1).max() <= 1 + 1e-5


@REAL
@pytest.mark.parametrize("name", ["sk_777_219", "kenney_racer", "sk_seat_ba", "negative_scale_test"])
def test_geometry_agrees_with_trimesh(name):
    path = next(DATA.glob(f"*/**/{name}.glb"))
    theirs, asset = trimesh.load_scene(path).to_geometry(), load_mesh(path)
    ours = np.concatenate([part.positions[part.faces] for part in asset.parts])
    np.testing.assert_allclose([ours.min(axis=(0, 1)), ours.max(axis=(0, 1))], theirs.bounds, rtol=1e-5, atol=1e-5)
    area = np.linalg.norm(np.cross(ours[:, 1] - ours[:, 0], ours[:, 2] - ours[:, 0]), axis=-1).sum() / 2
    assert area == pytest.approx(theirs.area, rel=1e-5)


# OBJ and MTL

PAINTED = f"{VERTICES}usemtl paint\nf 1 2 3 4\n"
TEXTURED = f"{VERTICES}{TEXCOORDS}vn 0 0 2\nusemtl paint\nf 1/1/1 2/2/1 3/3/1 4/4/1\n"


SQUARES = "f 1 2 3 4\n", "f 1 2 3\nf 1 3 4\n", "f -4 -3 -2 -1\n", "\tf\t1 2 3\n  f 1 3 4\n"


@pytest.mark.parametrize("faces", SQUARES)
def test_every_way_to_write_a_square_gives_it_and_relative_numbers_count_from_where_they_stand(tmp_path, faces):
    (part,) = load_mesh(
        write_obj(tmp_path, VERTICES + faces + VERTICES.replace(" 0\n", " 5\n") + "f -4 -3 -2 -1\n")
    ).parts
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a), [[0, 0, 1]] * 4)
    assert {tuple(p) for p in part.positions} == {(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 5)}
    assert part.normals is None


def test_normals_are_kept_and_v_is_counted_from_above(tmp_path):
    (part,) = load_mesh(write_obj(tmp_path, TEXTURED, "newmtl paint\nmap_Kd pine.png\n")).parts
    np.testing.assert_array_equal(part.normals, [[0, 0, 1]] * 4)
    np.testing.assert_allclose(part.texcoords, np.stack([part.positions[:, 0], 1 - part.positions[:, 1]], axis=-1))


@pytest.mark.parametrize(
    ("options", "scale", "offset"), [("-s 2 0.5 1", (2, 0.5), (0, 0)), ("-o .25 -s 3", (3, 1), (0.25, 0))]
)
def test_texture_coordinates_are_scaled_and_moved_as_the_map_says(tmp_path, options, scale, offset):
    (part,) = load_mesh(write_obj(tmp_path, TEXTURED, f"newmtl paint\nmap_Kd {options} pine.png\n")).parts
    upright = part.positions[:, :2] * scale + offset
    np.testing.assert_allclose(part.texcoords, np.stack([upright[:, 0], 1 - upright[:, 1]], axis=-1))


LINEAR = srgb_to_linear(CHECKER / 255)
PLACEHOLDER = "Kd 0.8 0.8 0.8\nmap_Kd -s 2 -.5 1e-1 -clamp on 3d wood.png"
LOOKS = [  # statements; base colour, roughness, metallic, wrap mode; what is ignored
    (PLACEHOLDER, (LINEAR, 0.5, 0, "clamp"), ("MTL Kd beside map_Kd",)),
    ("map_Kd -S 1 1 1 3d wood.png -clamp on -s 2 2 2", (LINEAR, 0.5, 0, "clamp"), ("MTL map option -S",)),
    ("Kd 0.1 0.2 0.3\nNs 98\nKs 0 0 0", (np.float32([0.1, 0.2, 0.3]), 0.5, 0, "repeat"), ()),
    ("Kd 0.1 0.2 0.3\nPr 0.25\nPm 0.75\nNs 10", (np.float32([0.1, 0.2, 0.3]), 0.25, 0.75, "repeat"), ()),
    ("Kd 0.1 0.2 0.3\nNs 98\nd 1\nTr 0", (np.float32([0.1, 0.2, 0.3]), np.sqrt(2 / 100), 0, "repeat"), ()),
    ("Kd 0.1 0.2 0.3\nTr 1.000\nd 1.0", (np.float32([0.1, 0.2, 0.3]), 0.5, 0, "repeat"), ()),
]


@pytest.mark.parametrize(("mtl", "expected", "ignored"), LOOKS)
def test_an_opaque_material_has_its_colour_or_texture_and_its_roughness(tmp_path, mtl, expected, ignored):
    asset = load_mesh(write_obj(tmp_path, TEXTURED, f"newmtl paint\n{mtl}\n"))
    look, (color, roughness, metallic, wrap) = asset.parts[0].material, expected
    np.testing.assert_allclose(look.base_color, color, rtol=0, atol=1e-6 if color.ndim > 1 else 0)
    np.testing.assert_allclose([look.roughness, look.metallic], [roughness, metallic], rtol=1e-6)
    assert (look.wrap, asset.ignored) == (wrap, ignored)


@pytest.mark.parametrize(
    ("head", "shininess"), [("# Blender 4.1.1 MTL File: 'None'", 1000), ("# Blender MTL File: ''", 900)]
)
def test_the_roughness_of_blenders_files_is_the_one_that_it_wrote_them_from(tmp_path, head, shininess):
    for roughness in (0.2, 0.5, 1):
        text = f"{head}\nnewmtl paint\nNs {shininess * (1 - roughness) ** 2:.6f}\n"
        look = load_mesh(write_obj(tmp_path, PAINTED, text)).parts[0].material
        assert look.roughness == pytest.approx(roughness, abs=1e-6)


def test_materials_with_odd_names_of_two_libraries_in_one_line_make_two_parts(tmp_path):
    for library, name, color in (("one 1", "dark wood #2", "0.25 0 0"), ("two 1", "usemtl", "0 0 0.5")):
        (tmp_path / f"{library}.mtl").write_text(f"newmtl {name}\nKd {color}\n")
    text = f"mtllib one 1.mtl two 1.mtl\n{VERTICES}usemtl dark wood #2\nf 1 2 3\nusemtl usemtl \nf 1 3 4\n"
    parts = load_mesh(write_obj(tmp_path, text)).parts
    look = {tuple(part.material.base_color): part.positions.tolist() for part in parts}
    assert look == {(0.25, 0, 0): [[0, 0, 0], [1, 0, 0], [1, 1, 0]], (0, 0, 0.5): [[0, 0, 0], [1, 1, 0], [0, 1, 0]]}


def test_vertices_without_a_colour_among_others_are_white_and_counted(tmp_path):
    mixed = VERTICES.replace("0 0 0", "0 0 0 1 0 0 # red") + "v -nan(ind) 0 0\nf 1 2 3\nf 1 3 4\nf 1 2 5\n"
    asset = load_mesh(write_obj(tmp_path, mixed), transparent_parts="opaque")
    np.testing.assert_array_equal(asset.parts[0].colors, [[1, 0, 0], *3 * [[1, 1, 1]]])
    bytes_of_one = write_obj(tmp_path, mixed.replace("0 0 0 1 0 0", "0 0 0 255 0 0") + "l 1 2\n")
    asset = load_mesh(bytes_of_one, transparent_parts="opaque")
    np.testing.assert_array_equal(asset.parts[0].colors, [[1, 0, 0], *3 * [[1, 1, 1]]])
    assert "lines" in asset.ignored
    assert any("4 of 5 vertices have no colour" in note for note in asset.notes)


def test_an_image_that_cannot_be_read_leaves_plain_values_for_pictures(tmp_path):
    path = write_obj(tmp_path, TEXTURED, "newmtl paint\nKd 0 0.5 0\nmap_Kd light.exr\n")
    (tmp_path / "light.exr").write_bytes(b"v/1\1" + bytes(99))
    asset = load_mesh(path, transparent_parts="opaque")
    np.testing.assert_array_equal(asset.parts[0].material.base_color, [0, 0.5, 0])
    assert any("cannot be read: light.exr (is not an image)" in note for note in asset.notes)
    assert "light.exr" in refusal(path)


def test_of_faces_on_the_same_corners_that_of_the_first_material_is_kept_whatever_their_order(tmp_path):
    back = VERTICES.replace("v 1 0 0", "v 1 0 0\nv 1 0 0")  # vertex 3 is vertex 2 again
    text = back + "usemtl red\nf 1 2 4\nusemtl blue\nf 4 3 1\nf 1 4 5\n"
    asset = load_mesh(write_obj(tmp_path, text, "newmtl blue\nKd 0 0 1\nnewmtl red\nKd 1 0 0\n"))
    assert {tuple(p.material.base_color): len(p.faces) for p in asset.parts} == {(1, 0, 0): 1, (0, 0, 1): 1}
    assert asset.ignored == ("1 doubled faces (one of each is kept)",)


TRANSPARENT = "d 0.5", "d -halo 0.9", "d 0", "Tr 0.3", "map_d mask.png"
BROKEN = [  # text, library, words of the refusal
    *((PAINTED, f"newmtl paint\n{line}\n", "is transparent: material 'paint'") for line in TRANSPARENT),
    *((PAINTED, f"newmtl paint\n{line}\n", "not finite") for line in ("Kd nan 0 0", "Pm nan")),
    (PAINTED, "newmtl paint\nmap_Kd gone.png\n", "missing: 'gone.png'"),
    (PAINTED, "newmtl paint\nmap_Kd ..\\gone.png\n", "missing: '../gone.png'"),
    (PAINTED, "newmtl other\n", "'paint'"),
    (f"mtllib gone.mtl\n{VERTICES}f 1 2 3\n", None, "missing: 'gone.mtl'"),
    (VERTICES, None, "has no faces"),
    ("", None, "has no faces"),
    (VERTICES.replace("1 1 0", "1 nan 0") + "f 1 2 3\n", None, "not finite"),
    (VERTICES + "f 1 2 9\n", None, "name v 9 of 4: broken"),
    (VERTICES.replace("1 1 0", "1 1") + "f 1 2 3\n", None, "v 3: expected 3 numbers, found '1 1'"),
    (VERTICES + "f -5 2 3\n", None, "before the first"),
    (VERTICES.replace("1 1 0", "1 0;5 0") + "f 1 2 3\n", None, "v 3: expected 3 numbers, found '1 0;5 0'"),
    (VERTICES + "f 1 1 3\n", None, "no face with an area"),
]


@pytest.mark.parametrize(("text", "mtl", "words"), BROKEN)
def test_what_is_transparent_missing_or_broken_is_refused_in_one_line(tmp_path, text, mtl, words):
    assert words in refusal(write_obj(tmp_path, text, mtl))


# For pictures, transparent parts are drawn or left out and missing images are gone without; for references neither

CUT = "surface only where the alpha of the texture reaches its cut-off: 'leaf'"
BELOW = "left out, wholly below the alpha cut-off: 'leaf'"
DRAWN = "transparent parts drawn as opaque (--transparent-parts skip leaves them out): 'leaf'"
LEFT_OUT = "transparent parts left out (--transparent-parts opaque draws them): 'leaf'"
GLASS = {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.9}}}
MASK, BLEND = {"alphaMode": "MASK"}, {"alphaMode": "BLEND"}
ALL, HALF, NONE = 1 / 2, 1 / 3, 0  # share of the points on a square beside a whole one, of which so much is there


def share_of_tested(asset, spread="random"):
    points = sample_surface(asset, 900, 0, spread).positions
    assert len(points) == 900
    tested = points[points[:, 0] < 5]
    return len(tested) / 900, tested[:, 0].min(initial=1)


CASES = {  # writer, its arguments; share and note for `opaque` and for `skip`
    "mask": (gltf_leaf, (half_transparent(100, 200), 1.0, MASK), (HALF, CUT), (HALF, CUT)),
    "mask that hides nothing": (gltf_leaf, (half_transparent(200, 200), 1.0, MASK), (ALL, None), (ALL, None)),
    "mask that hides all": (gltf_leaf, (half_transparent(200, 200), 0.1, MASK), (NONE, BELOW), (NONE, BELOW)),
    "glass of a factor": (gltf_leaf, (None, 0.2, BLEND), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "glass that transmits": (gltf_leaf, (None, 1.0, GLASS), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "glass of texels": (gltf_leaf, (half_transparent(60, 60), 1.0, BLEND), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "space around blended leaves": (gltf_leaf, (half_transparent(5, 200), 1.0, BLEND), (HALF, DRAWN), (HALF, LEFT_OUT)),
    "blended in name alone": (gltf_leaf, (half_transparent(255, 255), 1.0, BLEND), (ALL, None), (ALL, None)),
    "OBJ's d": (obj_leaf, ("Kd 1 0 0\nd 0.3",), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "OBJ's Tr": (obj_leaf, ("Kd 1 0 0\nTr 0.8",), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "grey map_d": (obj_leaf, ("map_d -clamp on mask.png", half_transparent()[..., 3]), (HALF, CUT), (HALF, CUT)),
    "alpha of map_d": (obj_leaf, ("map_d -clamp on mask.png", half_transparent()), (HALF, CUT), (HALF, CUT)),
    "map_d of opaque colours": (obj_leaf, ("map_d mask.png", np.uint8(CHECKER)), (ALL, None), (ALL, None)),
}


@pytest.mark.parametrize("parts", ["opaque", "skip"])
@pytest.mark.parametrize("case", CASES)
def test_what_lets_light_through_is_drawn_cut_out_or_left_out_and_said(tmp_path, case, parts):
    writer, arguments, *expected = CASES[case]
    path, (share, note) = writer(tmp_path, *arguments), expected[parts == "skip"]
    asset = load_mesh(path, transparent_parts=parts)
    found, left = share_of_tested(asset)
    assert found == pytest.approx(share, abs=0.06)
    assert left > 0.5 - 1 / 8 or share != HALF
    assert asset.notes == ((note,) if note else ())
    assert share_of_tested(asset, "even")[0] > 0 or share == NONE
    if note or writer is gltf_leaf:
        with pytest.raises(UserError, match="is transparent: material 'leaf'"):
            load_mesh(path)


def test_an_object_of_which_nothing_is_left_says_why(tmp_path):
    with pytest.raises(UserError, match="has nothing to draw: transparent parts left out .* 'leaf'"):
        load_mesh(gltf_leaf(tmp_path, None, 0.0, BLEND, alone=True), transparent_parts="skip")
    nearly = half_transparent(0, 0)
    nearly[0, 0, 3] = 255
    asset = load_mesh(gltf_leaf(tmp_path, nearly, 1.0, MASK, UV / 4 + 0.5, alone=True), transparent_parts="opaque")
    with pytest.raises(UserError, match="next to no surface"):
        sample_surface(asset, 20, 0)


def test_missing_images_and_libraries_leave_plain_values_and_are_named(tmp_path):
    builder = GltfBuilder()
    color, surface, normal = (builder.texture(uri=f"maps/{name}.png") for name in ("color", "surface", "normal"))
    pbr = {"baseColorTexture": {"index": color}, "metallicRoughnessTexture": {"index": surface}}
    material = builder.material(pbrMetallicRoughness=pbr, normalTexture={"index": normal})
    builder.mesh(builder.primitive(material=material, TEXCOORD_0=UV))
    bare, wood = builder.write(tmp_path / "bare.glb"), obj_leaf(tmp_path, "map_Kd C:\\maps\\wood.png\nPr 0.25")
    asset = load_mesh(bare, transparent_parts="opaque")
    points = sample_surface(asset, 20, 0)
    for values, expected in ((points.base_color, 0.5), (points.roughness, 0.5), (points.metallic, 0)):
        np.testing.assert_allclose(values, expected, atol=0.01)
    assert asset.notes[0].startswith("plain values taken where it names a file that is missing: 'maps/color.png', ")
    asset = load_mesh(wood, transparent_parts="opaque")
    assert asset.notes == ("plain values taken where it names a file that is missing: 'C:/maps/wood.png'",)
    (tmp_path / "look.mtl").unlink()
    asset = load_mesh(wood, transparent_parts="opaque")
    assert "names a file that is missing: 'look.mtl'" in asset.notes[0]
    assert "uses a material that no library defines: 'leaf', 'plain'" in asset.notes[1]
