"""Mesh folders and files: ids, the formats without materials, and real files where they are at hand."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.gltf_files import CORNERS, SQUARE, UV, GltfBuilder

from data_gen.plan.sources import find_meshes
from spnr_jax.errors import UserError
from spnr_jax.formats.meshes import load_mesh
from spnr_jax.formats.surface_points import normalise, sample_surface

DATA = Path(__file__).parents[3] / "shared" / "data"
FACES = SQUARE.reshape(2, 3)


def write(path, text=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def ids(folder, *names):
    for name in names:
        write(folder / name)
    return {identifier: str(path.relative_to(folder)) for identifier, path in find_meshes(folder)}


def test_ids_are_stems_or_the_folder_of_a_lone_obj_or_gltf(tmp_path):
    found = ids(tmp_path, "b.glb", "a.PLY", "pan/model.obj", "pan/model.mtl", "lamp/scene.gltf", "x/cup.glb")
    expected = {"a": "a.PLY", "b": "b.glb", "cup": "x/cup.glb", "lamp": "lamp/scene.gltf", "pan": "pan/model.obj"}
    assert list(found.items()) == list(expected.items())


def test_ids_are_unique_even_where_letter_case_and_cleaning_collide(tmp_path):
    found = ids(tmp_path, "a b.glb", "a_b.glb", "a?b.glb", "A_B.GLB", "ä.off", "ö.off", "a_b.glb.ply")
    assert len(found) == 7
    assert len({name.casefold() for name in found}) == 7
    assert all(set(name) <= set("abcdefghijklmnopqrstuvwxyzABGLP._-0123456789") for name in found)
    assert all(name[0] not in "._-" for name in found)


@pytest.mark.parametrize("suffix", ["ply", "stl", "stl_ascii", "off", "obj"])
def test_geometry_without_materials_is_grey_half_rough_and_no_metal(tmp_path, suffix):
    path = tmp_path / f"a.{suffix.removesuffix('_ascii')}"
    trimesh.Trimesh(CORNERS, FACES, process=False).export(path, file_type=suffix)
    (part,) = load_mesh(path).parts
    found = {tuple(map(tuple, triangle)) for triangle in part.positions[part.faces]}
    assert found == {tuple(map(tuple, triangle)) for triangle in CORNERS[FACES].astype(float)}
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


# For pictures, transparent parts are drawn or left out and missing images are gone without; for references neither

CUT = "surface only where the alpha of the texture reaches its cut-off: 'leaf'"
BELOW = "left out, wholly below the alpha cut-off: 'leaf'"
DRAWN = "transparent parts drawn as opaque (--transparent-parts skip leaves them out): 'leaf'"
LEFT_OUT = "transparent parts left out (--transparent-parts opaque draws them): 'leaf'"
GLASS = {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.9}}}
MASK, BLEND = {"alphaMode": "MASK"}, {"alphaMode": "BLEND"}
ALL, HALF, NONE = 1 / 2, 1 / 3, 0  # share of the points on a square beside a whole one, of which so much is there


def half_transparent(low=0, high=255):
    """Texels red throughout, whose left half has one alpha and whose right half another."""
    texels = np.zeros((8, 8, 4), np.uint8)
    texels[..., 0] = 255
    texels[..., 3] = np.where(np.arange(8) < 4, low, high)
    return texels


def gltf(folder, texels=None, factor=1.0, material=()):
    """A file of an opaque blue square far away and one of the material under test."""
    builder = GltfBuilder()
    blue = builder.material(pbrMetallicRoughness={"baseColorFactor": [0, 0, 1, 1]})
    builder.mesh(builder.primitive(material=blue), translation=[10, 0, 0])
    pbr = {"baseColorFactor": [1, 1, 1, factor]}
    if texels is not None:
        pbr["baseColorTexture"] = {"index": builder.texture(texels, wrapS=33071, wrapT=33071)}
    tested = builder.material(name="leaf", pbrMetallicRoughness=pbr, **dict(material))
    builder.mesh(builder.primitive(material=tested, TEXCOORD_0=UV))
    return builder.write(folder / "two.glb")


def obj(folder, statement, texels=None):
    """The same as OBJ and MTL."""
    if texels is not None:
        Image.fromarray(texels).save(folder / "mask.png")
    (folder / "look.mtl").write_text(f"newmtl leaf\n{statement}\nnewmtl plain\nKd 0 0 1\n")
    corners = "".join(f"v {x + a} {y} 0\n" for a in (0, 10) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl leaf\nf 1/1 2/2 3/3 4/4\nusemtl plain\nf 5/1 6/2 7/3 8/4\n"
    (folder / "a.obj").write_text(f"mtllib look.mtl\n{corners}{faces}")
    return folder / "a.obj"


def share_of_tested(asset, spread="random"):
    points = sample_surface(asset, 900, 0, spread).positions
    assert len(points) == 900
    tested = points[points[:, 0] < 5]
    return len(tested) / 900, tested[:, 0].min(initial=1)


CASES = {  # writer, its arguments; share and note for `opaque` and for `skip`
    "mask": (gltf, (half_transparent(100, 200), 1.0, MASK), (HALF, CUT), (HALF, CUT)),
    "mask that hides nothing": (gltf, (half_transparent(200, 200), 1.0, MASK), (ALL, None), (ALL, None)),
    "mask that hides all": (gltf, (half_transparent(200, 200), 0.1, MASK), (NONE, BELOW), (NONE, BELOW)),
    "glass of a factor": (gltf, (None, 0.2, BLEND), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "glass that transmits": (gltf, (None, 1.0, GLASS), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "glass of texels": (gltf, (half_transparent(60, 60), 1.0, BLEND), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "empty space around blended leaves": (
        gltf, (half_transparent(5, 200), 1.0, BLEND), (HALF, DRAWN), (HALF, LEFT_OUT),
    ),
    "blended in name alone": (gltf, (half_transparent(255, 255), 1.0, BLEND), (ALL, None), (ALL, None)),
    "OBJ's d": (obj, ("Kd 1 0 0\nd 0.3",), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "OBJ's Tr": (obj, ("Kd 1 0 0\nTr 0.8",), (ALL, DRAWN), (NONE, LEFT_OUT)),
    "grey map_d": (obj, ("map_d -clamp on mask.png", half_transparent()[..., 3]), (HALF, CUT), (HALF, CUT)),
    "alpha of map_d": (obj, ("map_d -clamp on mask.png", half_transparent()), (HALF, CUT), (HALF, CUT)),
}  # fmt: skip


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
    if note or writer is gltf:
        with pytest.raises(UserError, match="is transparent: material 'leaf'"):
            load_mesh(path)


def test_an_object_of_which_nothing_is_left_says_why(tmp_path):
    builder = GltfBuilder()
    material = builder.material(name="glass", alphaMode="BLEND", pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0]})
    builder.mesh(builder.primitive(material=material))
    with pytest.raises(UserError, match="has nothing to draw: transparent parts left out .* 'glass'"):
        load_mesh(builder.write(tmp_path / "glass.glb"), transparent_parts="skip")
    nearly = half_transparent(0, 0)
    nearly[0, 0, 3] = 255
    builder = GltfBuilder()
    pbr = {"baseColorTexture": {"index": builder.texture(nearly)}}
    holes = builder.material(alphaMode="MASK", pbrMetallicRoughness=pbr)
    builder.mesh(builder.primitive(material=holes, TEXCOORD_0=UV / 4 + 0.5))
    asset = load_mesh(builder.write(tmp_path / "holes.glb"), transparent_parts="opaque")
    with pytest.raises(UserError, match="next to no surface"):
        sample_surface(asset, 20, 0)


def test_missing_images_and_libraries_leave_plain_values_and_are_named(tmp_path):
    builder = GltfBuilder()
    color, surface, normal = (builder.texture(uri=f"maps/{name}.png") for name in ("color", "surface", "normal"))
    pbr = {"baseColorTexture": {"index": color}, "metallicRoughnessTexture": {"index": surface}}
    material = builder.material(pbrMetallicRoughness=pbr, normalTexture={"index": normal})
    builder.mesh(builder.primitive(material=material, TEXCOORD_0=UV))
    bare, wood = builder.write(tmp_path / "bare.glb"), obj(tmp_path, "map_Kd C:\\maps\\wood.png\nPr 0.25")
    asset = load_mesh(bare, transparent_parts="opaque")
    points = sample_surface(asset, 20, 0)
    for values, expected in ((points.base_color, 0.5), (points.roughness, 0.5), (points.metallic, 0)):
        np.testing.assert_allclose(values, expected, atol=0.01)
    assert asset.notes[0].startswith("plain values taken where it names a file that is missing: 'maps/color.png', ")
    asset = load_mesh(wood, transparent_parts="opaque")
    assert asset.notes == ("plain values taken where it names a file outside its own folder: 'C:/maps/wood.png'",)
    (tmp_path / "look.mtl").unlink()
    asset = load_mesh(wood, transparent_parts="opaque")
    assert "names a file that is missing: 'look.mtl'" in asset.notes[0]
    assert "uses a material that no library defines: 'leaf', 'plain'" in asset.notes[1]
    for path, name in ((bare, "maps/color.png"), (wood, "look.mtl")):
        with pytest.raises(UserError, match=f"missing: '{name}'"):
            load_mesh(path)
