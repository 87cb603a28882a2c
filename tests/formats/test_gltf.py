"""glTF files: geometry, transforms and materials against values that the tests write down themselves.

What Draco and meshopt packed is read as it was before; damaged and boasting data is refused.
"""

import sys

import numpy as np
import pytest
import trimesh
from support.gltf_files import CHECKER, CORNERS, SQUARE, UV, GltfBuilder, instanced, one_square, png, skinned
from support.mesh_files import glass, painted, refusal, square
from support.packed_meshes import COLORS, MESHOPT, draco_square, meshopt_files
from support.point_tables import WHOLE, as_scan

from spnr_jax.errors import UserError
from spnr_jax.formats.clouds import read_cloud
from spnr_jax.formats.gltf import metallic_roughness
from spnr_jax.formats.gltf_file import unpack
from spnr_jax.formats.meshes import load_mesh
from spnr_jax.formats.surface_points import sample_surface
from spnr_jax.kernels.imaging import srgb_to_linear

LINEAR = srgb_to_linear(CHECKER / 255)
TEXELS = np.random.default_rng(2).integers(0, 256, (2, 3, 4))


def corners_in_space(part):
    return {tuple(np.round(p, 6)) for p in part.positions[part.faces.ravel()]}


def face_crosses(part):
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    return np.cross(b - a, c - a)


def test_node_transforms_are_chained_from_the_root(tmp_path):
    builder = GltfBuilder()
    child = builder.mesh(builder.primitive(), root=False, translation=[1, 0, 0])
    half_turn_about_y = [0, 1, 0, 0]
    builder.node(children=[child], rotation=half_turn_about_y, scale=[2, 3, 4])
    (part,) = load_mesh(builder.write(tmp_path / "nodes.glb")).parts
    assert corners_in_space(part) == {(-2, 0, 0), (-4, 0, 0), (-4, 3, 0), (-2, 3, 0)}


@pytest.mark.parametrize("scale", [[-1, 1, 1], [1, 1, -1], [-2, -3, -1], [1, 3, 0.5]])
def test_normals_are_those_of_the_faces_however_a_node_stretches_and_mirrors_them(tmp_path, scale):
    slanted = CORNERS.copy()
    slanted[2:, 2] = 1  # the plane z = y, normal (0, -1, 1)
    normals = np.tile(np.float32([0, -0.6, 0.6]), (4, 1))
    (part,) = one_square(tmp_path, positions=slanted, node={"scale": scale}, NORMAL=normals).parts
    outside = np.array([0, -1, 1]) / scale
    np.testing.assert_allclose(part.normals[0], outside / np.linalg.norm(outside), atol=1e-6)
    for normals in (part.normals[:2], face_crosses(part)):
        np.testing.assert_allclose(normals / np.linalg.norm(normals, axis=1)[:, None], part.normals[[0, 0]], atol=1e-6)


QUARTER = [-(0.5**0.5), 0, 0, 0.5**0.5]  # a turn about x, by which y up becomes z up


@pytest.mark.parametrize("node", [{}, {"translation": [7, 0, 0], "scale": [3, 1, 1]}])
def test_a_skin_lies_where_its_joints_put_it_whatever_its_own_node_says(tmp_path, node):
    inverse = np.diag([2.0, 2, 2, 1])
    inverse[:3, 3] = [0, 0, 1]
    asset = load_mesh(skinned(armature={"scale": [10] * 3, "rotation": QUARTER}, inverse=inverse, **node).write(
        tmp_path / "skin.glb"
    ))  # fmt: skip
    (part,) = asset.parts
    assert corners_in_space(part) == {(20 * x, 10, -20 * y) for x, y, _ in CORNERS}
    np.testing.assert_allclose(part.normals, [[0, 1, 0]] * 4, atol=1e-6)
    assert not asset.ignored


def test_a_vertex_hangs_on_more_than_four_joints(tmp_path):
    builder = skinned()
    more = {"JOINTS_1": np.full((4, 4), 1, np.uint8), "WEIGHTS_1": np.tile(np.float32([0.5, 0, 0, 0]), (4, 1))}
    attributes = builder.document["meshes"][0]["primitives"][0]["attributes"]
    attributes |= {name: builder.accessor(values) for name, values in more.items()}
    builder.document["skins"][0]["joints"].append(builder.node(translation=[0, 0, 8]))
    (part,) = load_mesh(builder.write(tmp_path / "skin.glb")).parts
    assert corners_in_space(part) == {(x, y, 4) for x, y, _ in CORNERS}


def test_a_joint_of_another_scene_and_vertices_without_joints_are_at_rest(tmp_path):
    builder = skinned(armature={"translation": [9, 0, 0]}, translation=[0, 2, 0])
    builder.document["scenes"][0]["nodes"].pop()
    (part,) = load_mesh(builder.write(tmp_path / "scene.glb")).parts
    assert corners_in_space(part) == {tuple(corner) for corner in CORNERS}
    builder = skinned(armature={"translation": [9, 0, 0], "rotation": [0, 0, 0, 0]}, translation=[0, 2, 0])
    builder.document["meshes"][0]["primitives"][0]["attributes"].pop("JOINTS_0")
    asset = load_mesh(builder.write(tmp_path / "bare.glb"))
    assert corners_in_space(asset.parts[0]) == {(x, y + 2, 0) for x, y, _ in CORNERS}
    assert "skins of vertices that name no joints" in asset.ignored


def test_of_vertices_that_parts_share_each_keeps_its_own(tmp_path):
    builder = GltfBuilder()
    whole = builder.primitive(np.concatenate([CORNERS, CORNERS + [0, 0, 5]]).astype(np.float32))
    other = whole | {"indices": builder.accessor(SQUARE + np.uint16(4)), "material": builder.material(doubleSided=True)}
    builder.document["accessors"].append({"sparse": {}})  # of an attribute that nobody reads
    whole["attributes"]["_FEATURE"] = len(builder.document["accessors"]) - 1
    builder.document["materials"][0]["pbrMetallicRoughness"] = {"baseColorFactor": [1, 0, 0, 1]}
    builder.mesh(whole, other)
    parts = load_mesh(builder.write(tmp_path / "shared.glb")).parts
    assert [len(part.positions) for part in parts] == [4, 4]
    assert [{z for _, _, z in corners_in_space(part)} for part in parts] == [{0}, {5}]


def test_instances_are_drawn_each_in_its_place_and_hidden_nodes_with_their_children_are_not(tmp_path):
    builder = instanced(scale=[2, 2, 2])
    child = builder.mesh(builder.primitive(CORNERS * 9), root=False)
    builder.node(children=[child], extensions={"KHR_node_visibility": {"visible": False}})
    (part,) = load_mesh(builder.write(tmp_path / "a.glb")).parts
    moved = {(2 * x + 2, 2 * y, 0) for x, y, _ in CORNERS} | {(-2 * x, 2 * y + 10, 0) for x, y, _ in CORNERS}
    assert corners_in_space(part) == moved


def test_parts_with_equal_materials_merge_and_others_stay_apart(tmp_path):
    builder = GltfBuilder()
    for number, (name, color) in enumerate((("a", [1, 0, 0, 1]), ("c", [0, 0, 1, 1]), ("b", [1, 0, 0, 1]))):
        material = builder.material(name=name, pbrMetallicRoughness={"baseColorFactor": color})
        builder.mesh(builder.primitive(material=material), translation=[0, 0, number])
    first, second = load_mesh(builder.write(tmp_path / "three.glb")).parts
    assert {z for _, _, z in corners_in_space(first)} == {0, 2}
    assert {z for _, _, z in corners_in_space(second)} == {1}


@pytest.mark.parametrize("unlit", [False, True])
def test_a_part_without_a_material_is_a_rough_metal_for_references_and_none_for_pictures(tmp_path, unlit):
    builder = GltfBuilder()
    material = builder.material(extensions={"KHR_materials_unlit": {}}) if unlit else None
    builder.mesh(builder.primitive(material=material))
    path = builder.write(tmp_path / "plain.glb")
    for asset, expected in ((load_mesh(path), (1, 1)), (load_mesh(path, transparent_parts="opaque"), (0.5, 0))):
        assert (asset.parts[0].material.roughness, asset.parts[0].material.metallic) == expected
        assert any("parts without a material" in note for note in asset.notes) == (expected == (0.5, 0) and not unlit)


def test_the_texture_of_roughness_and_metallic_of_an_unlit_material_keeps_its_values(tmp_path):
    builder = GltfBuilder()
    surface = {"index": builder.texture(np.full((2, 2, 3), 255, np.uint8))}
    unlit = {"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": {"metallicRoughnessTexture": surface}}
    builder.mesh(builder.primitive(material=builder.material(**unlit), TEXCOORD_0=UV))
    look = load_mesh(builder.write(tmp_path / "a.glb"), transparent_parts="opaque").parts[0].material
    assert (look.roughness == 1).all()
    assert (look.metallic == 1).all()


@pytest.mark.parametrize(("mode", "order"), [(4, SQUARE), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_strips_fans_and_lists_describe_the_same_square(tmp_path, mode, order):
    (part,) = one_square(tmp_path, indices=np.array(order, np.uint16), mode=mode).parts
    np.testing.assert_allclose(face_crosses(part), [[0, 0, 1]] * 2)


def test_quantised_and_strided_positions_are_decoded(tmp_path):
    builder = GltfBuilder(extensionsRequired=["KHR_mesh_quantization"])
    primitive = builder.primitive(np.pad(CORNERS * 32767, ((0, 0), (0, 1))).astype(np.int16))
    builder.document["accessors"][0] |= {"type": "VEC3", "normalized": True}
    builder.document["bufferViews"][0]["byteStride"] = 8
    builder.mesh(primitive)
    (part,) = load_mesh(builder.write(tmp_path / "quantised.glb")).parts
    np.testing.assert_array_equal(part.positions, CORNERS)


# What is refused


def repeat(document):
    document["nodes"] += [{"mesh": 0}] * 300
    document["scenes"][0]["nodes"] = list(range(301))


TRANSMISSION = {"KHR_materials_transmission": {"transmissionFactor": 0.5}}
OUTSIDE = (
    "../secret.png",
    "a/../../secret.png",
    "/etc/hostname",
    "..%2fsecret.png",
    "file:///x",
    "C:\\x.png",
    "w\ud83d.png",
)
REFUSED = (
    (glass(alphaMode="BLEND"), "is transparent: material 'glass' has alphaMode BLEND"),
    (glass(alphaMode="MASK"), "is transparent: material 'glass' has alphaMode MASK"),
    (glass(extensions=TRANSMISSION), "KHR_materials_transmission"),
    (square(GltfBuilder(extensionsRequired=["ABC_unheard_of"])), "ABC_unheard_of"),
    (skinned(joints=[[1, 7, 7, 7]] * 4), "joint 1 of 1"),
    (square(change=lambda d: d["accessors"][0].pop("bufferView")), "accessor 0 is sparse or holds no data"),
    (square(change=lambda d: d["accessors"][0].update(sparse={})), "accessor 0 is sparse"),
    (square(GltfBuilder(asset={"version": "1.0"})), "glTF 1.0"),
    (glass("textures/gone.png"), "missing: 'textures/gone.png'"),
    *((glass(uri), "names a file that is missing") for uri in OUTSIDE),
    (glass("broken.png"), "broken.png"),
    (glass(pbrMetallicRoughness={"roughnessFactor": [0.1, 0.2, 0.3]}), "roughness of shape (3,)"),
    (glass("a.ktx2"), "cannot be read: a.ktx2 (KTX2, which is not read: convert it to PNG"),
    (square(change=repeat, indices=np.zeros(3 * 30_000, np.uint16)), "repeats its meshes more than can be read"),
    (GltfBuilder(), "has no faces"),
    (square(indices=SQUARE[:4], mode=1), "has no faces"),
    *((square(positions=np.where(CORNERS > 0, np.float32(value), 0)), "not finite") for value in (np.nan, np.inf)),
    (square(positions=np.ones_like(CORNERS)), "zero extent"),
    (square(indices=np.array([0, 1, 9], np.uint16)), "vertices 0 to 9 of 4"),
    (square(NORMAL=np.ones((3, 3), np.float32)), "normals of shape (3, 3) where (4, 3) is needed"),
    (square(change=lambda d: d["nodes"][0].update(children=[0])), "not a tree"),
    (square(change=lambda d: d["bufferViews"][0].update(byteStride=4)), "elements that overlap"),
)


@pytest.mark.parametrize(("builder", "words"), REFUSED)
def test_what_cannot_be_used_is_refused_in_one_line(tmp_path, builder, words):
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "secret.png").write_bytes(png(CHECKER))
    (folder / "broken.png").write_bytes(png(CHECKER)[:40])
    (folder / "a.ktx2").write_bytes(b"\xabKTX 20\xbb\r\n\x1a\n")
    assert words in refusal(builder.write(folder / "bad.glb"))


def test_buffers_that_are_missing_or_shorter_than_their_views_are_named(tmp_path):
    path = square().write(tmp_path / "bad.gltf")
    (tmp_path / "data.bin").write_bytes(b"short")
    assert "truncated" in refusal(path)
    (tmp_path / "data.bin").unlink()
    assert "missing: 'data.bin'" in refusal(path)


# Materials

GLOSS = "KHR_materials_pbrSpecularGlossiness"
GLOSSY = metallic_roughness(np.array([0.4, 0.2, 0.1]), srgb_to_linear(TEXELS[..., :3] / 255))
GREEN, BLUE = CHECKER[..., 1] / 255, CHECKER[..., 2] / 255
# "utilizes only the lower left quadrant of the source image, rotated clockwise 90 degrees"
MOVED = {"extensions": {"KHR_texture_transform": {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}}}
QUADRANT = [[0.5, 1], [0.5, 0.5], [0, 0.5], [0, 1]]


def glossy(builder):
    look = {"specularGlossinessTexture": {"index": builder.texture(TEXELS)}, "diffuseFactor": [0.4, 0.2, 0.1, 1]}
    return {"extensions": {GLOSS: look | {"glossinessFactor": 0.75}}}


LOOKS = {  # what makes a material; what the part or its material has; what is ignored
    "color": (painted(baseColorFactor=[0.5, 1, 0.25, 1]), {"base_color": LINEAR * [0.5, 1, 0.25], "texcoords": UV}, ()),
    "green and blue": (painted(surface={}, roughnessFactor=0.5), {"roughness": GREEN / 2, "metallic": BLUE}, ()),
    "the mean of another place": (
        painted(surface={"texCoord": 1}), {"roughness": [[GREEN.mean()]], "metallic": [[BLUE.mean()]]}, ["second "],
    ),
    "repeated": (painted(), {"wrap": "repeat"}, ()),
    "mirrored": (painted(33648), {"wrap": "mirror"}, ["wrapT"]),
    "clamped": (painted(33071), {"wrap": "clamp"}, ["wrapT"]),
    "the extension's own example of a transform": (painted(info=MOVED), {"texcoords": QUADRANT}, ()),
    "no coordinates": (
        painted(info={"texCoord": 3}), {"base_color": LINEAR.mean(axis=(0, 1))}, ["without texture coordinates"]
    ),
    "the older workflow": (
        glossy, {"base_color": GLOSSY[0], "metallic": GLOSSY[1], "roughness": 1 - 0.75 * TEXELS[..., 3] / 255}, ()
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", LOOKS)
def test_a_material_is_what_its_textures_and_factors_say(tmp_path, case):
    (make, expected, ignored), builder = LOOKS[case], GltfBuilder()
    asset = one_square(tmp_path, builder, material=builder.material(**make(builder)), TEXCOORD_0=UV, TEXCOORD_1=UV)
    found = vars(asset.parts[0]) | vars(asset.parts[0].material)
    assert found["wrap"] == expected.get("wrap", "repeat")
    for name in expected.keys() - {"wrap"}:
        np.testing.assert_allclose(found[name], expected[name], atol=2e-3 if "mean" in case else 1e-5)
    assert [words in note for words, note in zip(ignored, asset.ignored, strict=True)] == [True] * len(ignored)


@pytest.mark.parametrize("strict", [False, True])
def test_colours_on_a_texture_multiply_it_and_for_references_their_mean_does(tmp_path, strict):
    two = {
        "positions": np.concatenate([CORNERS, CORNERS + [2, 0, 0]]).astype(np.float32),
        "indices": np.array([*SQUARE, *(SQUARE + 4)], np.uint16),
        "TEXCOORD_0": np.tile(UV * 0 + 0.5, (2, 1)),
        "COLOR_0": np.repeat(np.float32([[1, 1, 1], [0.25, 0.5, 0.75]]), 4, axis=0),
    }
    builder = GltfBuilder()
    asset = one_square(tmp_path, builder, material=builder.material(**painted()(builder)), **two)
    if not strict:
        asset = load_mesh(tmp_path / "square.glb", transparent_parts="opaque")
    points = sample_surface(asset, 50, 0)
    one, other = (points.base_color[points.positions[:, 0] * side < side * 1.5][0] for side in (1, -1))
    np.testing.assert_allclose(other / one, [1, 1, 1] if strict else [0.25, 0.5, 0.75], atol=1e-5)
    assert any("over a texture (their mean is used)" in note for note in asset.ignored) == strict


@pytest.mark.parametrize("kind", ["mesh", "points"])
def test_vertex_colours_that_trimesh_wrote_are_srgb_as_in_its_other_files(tmp_path, kind):
    colors = np.uint8([[0, 20, 40, 255], [60, 90, 120, 255], [128, 160, 188, 255], [210, 230, 255, 255]])
    shape = trimesh.PointCloud(CORNERS, colors)
    if kind == "mesh":
        shape = trimesh.Trimesh(CORNERS, SQUARE.reshape(-1, 3), vertex_colors=colors, process=False)
    shape.export(tmp_path / "a.glb")
    asset = load_mesh(tmp_path / "a.glb", transparent_parts="opaque")
    np.testing.assert_allclose(asset.parts[0].colors, srgb_to_linear(colors[:, :3] / 255), atol=1e-6)
    assert "vertex colours taken as sRGB, as trimesh writes them" in asset.notes


def test_specular_glossiness_keeps_plain_dielectrics_and_finds_plain_metals():
    black, wood, gold = [0, 0, 0], [0.4, 0.2, 0.1], [1.0, 0.8, 0.3]
    diffuse, specular = np.array([wood, black, black]), np.array([[0.04] * 3, gold, black])
    expected = np.array([wood, gold, black])
    base_color, metallic = metallic_roughness(diffuse, specular)
    np.testing.assert_allclose(base_color, expected, atol=2e-2)
    np.testing.assert_allclose(metallic, [0, 1, 0], atol=2e-2)
    base_color, metallic = metallic_roughness(diffuse[None], specular.repeat(3, axis=0)[None])  # images of two sizes
    np.testing.assert_allclose(base_color[0], expected.repeat(3, axis=0), atol=2e-2)
    np.testing.assert_allclose(metallic, [[0, 0, 0, 1, 1, 1, 0, 0, 0]], atol=2e-2)


def test_a_primitive_without_positions_and_a_header_padded_with_zeros_cost_no_mesh(tmp_path):
    path = square(change=lambda d: d["meshes"][0]["primitives"].append({"attributes": {}})).write(tmp_path / "a.gltf")
    assert b'"count": 4,' in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(b'"count": 4,', b'"count": 4.0,') + b"\0\0")
    asset = load_mesh(path)
    np.testing.assert_array_equal(asset.parts[0].positions, CORNERS)
    assert "primitives without positions" in asset.ignored


def test_what_is_not_modelled_is_named(tmp_path):
    builder = GltfBuilder(animations=[{"channels": []}], extensionsUsed=["KHR_lights_punctual"])
    texture, sheen = {"index": builder.texture(CHECKER)}, {"KHR_materials_sheen": {}}
    more = {"normalTexture": texture, "occlusionTexture": texture, "emissiveFactor": [0, 0.1, 0], "extensions": sheen}
    material = builder.material(**more)
    builder.mesh(builder.primitive(indices=SQUARE[:4], mode=1))
    asset = one_square(tmp_path, builder, material=material)
    named = ["KHR_lights_punctual", "KHR_materials_sheen", "LINES primitives", "animations", "emissive"]
    assert asset.ignored == (*named, "normalTexture", "occlusionTexture")


# Packed meshes

ROUNDED = "directions in 8 bytes"  # the only one in which the last bit is a matter of rounding


@pytest.mark.parametrize("name", MESHOPT)
def test_meshopt_data_is_what_its_encoders_decoder_says_and_cut_anywhere_it_is_refused(name):
    case = MESHOPT[name]
    found = unpack(memoryview(case["packed"]), case)
    theirs, ours = (np.frombuffer(data, "<i2").astype(int) for data in (case["plain"], found))
    np.testing.assert_allclose(ours, theirs, atol=1 if name == ROUNDED else 0)
    for length in {*range(0, len(case["packed"]), 7), len(case["packed"]) - 1}:
        with pytest.raises(UserError, match="holds meshopt"):
            unpack(memoryview(case["packed"][:length]), case)


def test_meshopt_counts_widths_formats_and_filters_that_cannot_be_are_refused():
    case = MESHOPT["noise, format 0"]
    changes = [{"byteStride": stride} for stride in (0, 3, 6, 260)] + [{"packed": b"\xa7" + case["packed"][1:]}]
    changes += [{"count": count} for count in (case["count"] * 2**6, 3 * 2**28, -3)]  # before room is made for them
    for change in (*changes, *({"filter": kind} for kind in ("SEPIA", "QUATERNION", "COLOR"))):
        with pytest.raises(UserError, match="broken|cannot be read"):
            unpack(memoryview((case | change)["packed"]), case | change)


def written(folder):
    """A file whose buffers meshopt packed."""
    for name, content in meshopt_files().items():
        (folder / name).write_bytes(content)
    return folder / "mesh.gltf"


def test_a_file_whose_buffers_meshopt_packed_is_read(tmp_path):
    places = np.frombuffer(MESHOPT["two blocks of steps, format 1"]["plain"], "<u2").reshape(300, 4)[:, :3]
    corners = np.frombuffer(MESHOPT["a grid"]["plain"], "<u4").reshape(-1, 3)
    (part,) = load_mesh(written(tmp_path)).parts
    found = {face.tobytes() for face in part.positions[part.faces]}
    assert len(found) > 30  # some have no area
    assert found <= {face.tobytes() for face in places[corners].astype(float)}


def test_positions_faces_and_normalised_colours_come_out_of_a_draco_mesh(tmp_path):
    (part,) = load_mesh(draco_square().write(tmp_path / "packed.glb")).parts
    expected = CORNERS + [1, 0, 0]
    order, at = np.lexsort(part.positions.T), np.lexsort(expected.T)
    np.testing.assert_allclose(part.positions[order], expected[at], atol=1e-4)
    np.testing.assert_allclose(part.colors[order], COLORS[at] / 255)
    np.testing.assert_allclose(face_crosses(part), [[0, 0, 1]] * 2, atol=1e-3)


def test_a_draco_mesh_that_lacks_something_or_is_cut_anywhere_is_refused_in_one_line(tmp_path):
    builders = [draco_square(**e) for e in ({"attributes": {"POSITION": 77}}, {"attributes": {}}, {"bufferView": 99})]
    for length in range(0, builders[0].document["bufferViews"][0]["byteLength"], 5):
        builders.append(draco_square())
        builders[-1].document["bufferViews"][0]["byteLength"] = length
    words = "has no POSITION in its Draco mesh", "broken or truncated", "Draco mesh that is broken or cut off"
    for builder in builders:
        said = refusal(builder.write(tmp_path / "bad.glb"))
        assert any(phrase in said for phrase in words)


@pytest.mark.parametrize("package", ["laspy", "lazrs", "meshoptimizer", "DracoPy"])
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, package):
    as_scan(tmp_path / "a.las", WHOLE)
    made = {"meshoptimizer": written, "DracoPy": lambda folder: draco_square().write(folder / "a.glb")}
    path = made.get(package, lambda folder: folder / "a.las")(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    extra = "formats" if path.suffix == ".las" else "meshes"
    with pytest.raises(UserError, match=rf"needs the package {package} .* 'spnr-jax\[{extra}\]'"):
        read_cloud(path)
