"""glTF files: geometry, transforms and materials against values that the tests write down themselves.

What Draco and meshopt packed is read as it was before; damaged and boasting data is refused.
"""

import sys

import numpy as np
import pytest
from support.gltf_files import CHECKER, CORNERS, SQUARE, UV, GltfBuilder, one_square, png, textured_square
from support.packed_meshes import COLORS, MESHOPT, draco_square, meshopt_files
from support.point_tables import WHOLE, as_scan

from spnr_jax.errors import UserError
from spnr_jax.formats.clouds import read_cloud
from spnr_jax.formats.columns import srgb_to_linear
from spnr_jax.formats.gltf import metallic_roughness, unpack
from spnr_jax.formats.meshes import load_mesh
from spnr_jax.formats.surface_points import sample_surface


def corners_in_space(part):
    return {tuple(np.round(p, 6)) for p in part.positions[part.faces.ravel()]}


def face_normals(part):
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def test_node_transforms_are_chained_from_the_root(tmp_path):
    builder = GltfBuilder()
    child = builder.mesh(builder.primitive(), translation=[1, 0, 0])
    builder.document["scenes"][0]["nodes"] = []
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
    np.testing.assert_allclose(part.normals[:2], face_normals(part), atol=1e-6)
    outside = np.array([0, -1, 1]) / scale
    np.testing.assert_allclose(part.normals[0], outside / np.linalg.norm(outside), atol=1e-6)


def test_parts_with_equal_materials_merge_and_others_stay_apart(tmp_path):
    builder = GltfBuilder()
    red, same, blue = (
        builder.material(name=name, pbrMetallicRoughness={"baseColorFactor": color})
        for name, color in (("a", [1, 0, 0, 1]), ("b", [1, 0, 0, 1]), ("c", [0, 0, 1, 1]))
    )
    for number, material in enumerate((red, blue, same)):
        builder.mesh(builder.primitive(material=material), translation=[0, 0, number])
    first, second = load_mesh(builder.write(tmp_path / "three.glb")).parts
    assert {z for _, _, z in corners_in_space(first)} == {0, 2}
    assert {z for _, _, z in corners_in_space(second)} == {1}


def test_strips_fans_and_lists_describe_the_same_square(tmp_path):
    for mode, order in ((4, SQUARE), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])):
        (part,) = one_square(tmp_path, indices=np.array(order, np.uint16), mode=mode).parts
        assert len(part.faces) == 2
        np.testing.assert_allclose(face_normals(part), [[0, 0, 1]] * 2)


def test_quantised_and_strided_positions_are_decoded(tmp_path):
    builder = GltfBuilder(extensionsRequired=["KHR_mesh_quantization"])
    padded = np.zeros((4, 4), np.int16)
    padded[:, :3] = CORNERS * 32767
    index = builder.accessor(padded, normalized=True)
    builder.document["accessors"][index]["type"] = "VEC3"
    builder.document["bufferViews"][-1]["byteStride"] = 8
    primitive = builder.primitive()
    primitive["attributes"]["POSITION"] = index
    builder.mesh(primitive)
    (part,) = load_mesh(builder.write(tmp_path / "quantised.glb")).parts
    np.testing.assert_array_equal(part.positions, CORNERS)


def textured(uri):
    """A document with a square whose material has a texture of that name."""
    builder = GltfBuilder()
    texture = {"index": builder.texture(uri=uri)}
    builder.mesh(builder.primitive(material=builder.material(pbrMetallicRoughness={"baseColorTexture": texture})))
    return builder


def plain(builder=None, **primitive):
    """A document with a square."""
    builder = builder or GltfBuilder()
    builder.mesh(builder.primitive(**primitive))
    return builder


def looking(**material):
    """A document with a square of a material."""
    builder = GltfBuilder()
    return plain(builder, material=builder.material(name="glass", **material))


def changed(builder, change):
    """The document after a change, with a square where it has none."""
    change(builder)
    return builder if builder.document["meshes"] else plain(builder)


MANY = plain(indices=np.zeros(3 * 30_000, np.uint16))
TRANSMISSION = {"KHR_materials_transmission": {"transmissionFactor": 0.5}}
OUTSIDE = "../secret.png", "a/../../secret.png", "/etc/hostname", "..%2fsecret.png", "file:///x", "C:\\x.png"
REFUSED = (
    (looking(alphaMode="BLEND"), "is transparent: material 'glass' has alphaMode BLEND"),
    (looking(alphaMode="MASK"), "is transparent: material 'glass' has alphaMode MASK"),
    (looking(extensions=TRANSMISSION), "KHR_materials_transmission"),
    *((plain(GltfBuilder(extensionsRequired=[x])), x) for x in ("EXT_mesh_gpu_instancing", "ABC_unheard_of")),
    (changed(plain(), lambda b: b.document["accessors"][0].pop("bufferView")), "accessor 0 is sparse or holds no data"),
    (changed(plain(), lambda b: b.document["accessors"][0].update(sparse={})), "accessor 0 is sparse"),
    (plain(GltfBuilder(asset={"version": "1.0"})), "glTF 1.0"),
    (textured("textures/gone.png"), "missing: 'textures/gone.png'"),
    *((textured(uri), "outside its own folder") for uri in OUTSIDE),
    (textured("broken.png"), "broken.png"),
    (textured("a.ktx2"), "cannot be read: a.ktx2 (KTX2, which is not read: convert it to PNG"),
    (changed(MANY, lambda b: [b.node(mesh=0) for _ in range(300)]), "repeats its meshes more than can be read"),
    (GltfBuilder(), "has no faces"),
    (plain(indices=SQUARE[:4], mode=1), "has no faces"),
    *((plain(positions=np.where(CORNERS > 0, np.float32(value), 0)), "not finite") for value in (np.nan, np.inf)),
    (plain(positions=np.ones_like(CORNERS)), "zero extent"),
    (plain(indices=np.array([0, 1, 9], np.uint16)), "vertices 0 to 9 of 4"),
    (plain(NORMAL=np.ones((3, 3), np.float32)), "normals of shape (3, 3) where (4, 3) is needed"),
    (changed(GltfBuilder(), lambda b: b.node(children=[0])), "not a tree"),
)


def reason(path):
    with pytest.raises(UserError) as caught:
        load_mesh(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(("builder", "words"), REFUSED)
def test_what_cannot_be_used_is_refused_in_one_line(tmp_path, builder, words):
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "secret.png").write_bytes(png(CHECKER))
    (folder / "broken.png").write_bytes(png(CHECKER)[:40])
    (folder / "a.ktx2").write_bytes(b"\xabKTX 20\xbb\r\n\x1a\n")
    assert words in reason(builder.write(folder / "bad.glb"))


def test_buffers_that_are_missing_or_shorter_than_their_views_are_named(tmp_path):
    path = plain().write(tmp_path / "bad.gltf")
    (tmp_path / "data.bin").write_bytes(b"short")
    assert "truncated" in reason(path)
    (tmp_path / "data.bin").unlink()
    assert "missing: 'data.bin'" in reason(path)


# Materials

LINEAR = srgb_to_linear(CHECKER / 255)


def test_a_base_color_texture_is_linearised_and_multiplied_by_its_factor(tmp_path):
    (part,) = textured_square(tmp_path, factors={"baseColorFactor": [0.5, 1, 0.25, 1]}).parts
    np.testing.assert_allclose(part.material.base_color, LINEAR * [0.5, 1, 0.25], atol=1e-6)
    np.testing.assert_array_equal(part.texcoords, UV)


@pytest.mark.parametrize("texcoord", [0, 1])
def test_roughness_is_green_and_metallic_blue_and_of_a_texture_that_lies_differently_the_mean(tmp_path, texcoord):
    builder = GltfBuilder()
    surface = {"index": builder.texture(CHECKER), "texCoord": texcoord}
    pbr = {"metallicRoughnessTexture": surface, "roughnessFactor": 0.5}
    pbr["baseColorTexture"] = {"index": builder.texture(CHECKER)}
    material = builder.material(pbrMetallicRoughness=pbr)
    asset = one_square(tmp_path, builder, material=material, TEXCOORD_0=UV, TEXCOORD_1=UV)
    look, texels = asset.parts[0].material, CHECKER.mean(axis=(0, 1), keepdims=True) if texcoord else CHECKER
    np.testing.assert_allclose(2 * look.roughness, texels[..., 1] / 255, atol=2e-3)
    np.testing.assert_allclose(look.metallic, texels[..., 2] / 255, atol=2e-3)
    assert any("second texture" in note for note in asset.ignored) == bool(texcoord)


@pytest.mark.parametrize(("code", "wrap"), [(10497, "repeat"), (33648, "mirror"), (33071, "clamp")])
def test_the_sampler_decides_the_wrap_mode(tmp_path, code, wrap):
    asset = textured_square(tmp_path, sampler={"wrapS": code, "wrapT": 10497})
    assert asset.parts[0].material.wrap == wrap
    assert any("wrapT" in note for note in asset.ignored) == (wrap != "repeat")


def test_the_texture_transform_selects_the_quadrant_of_the_extensions_own_example(tmp_path):
    # "utilizes only the lower left quadrant of the source image, rotated clockwise 90 degrees"
    moved = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    (part,) = textured_square(tmp_path, info={"extensions": {"KHR_texture_transform": moved}}).parts
    np.testing.assert_allclose(part.texcoords, [[0.5, 1], [0.5, 0.5], [0, 0.5], [0, 1]], atol=1e-6)


@pytest.mark.parametrize("strict", [False, True])
def test_colours_on_a_texture_multiply_it_and_for_references_their_mean_does(tmp_path, strict):
    colors = np.repeat(np.float32([[1, 1, 1], [0.25, 0.5, 0.75]]), 4, axis=0)
    two = {
        "positions": np.concatenate([CORNERS, CORNERS + [2, 0, 0]]).astype(np.float32),
        "indices": np.array([*SQUARE, *(SQUARE + 4)], np.uint16),
        "TEXCOORD_0": np.tile(UV * 0 + 0.5, (2, 1)),
        "COLOR_0": colors,
    }
    asset = textured_square(tmp_path, **two)
    if not strict:
        asset = load_mesh(tmp_path / "square.glb", transparent_parts="opaque")
    points = sample_surface(asset, 50, 0)
    one = points.base_color[points.positions[:, 0] < 1.5][0]
    other = points.base_color[points.positions[:, 0] > 1.5][0]
    np.testing.assert_allclose(other / one, [1, 1, 1] if strict else [0.25, 0.5, 0.75], atol=1e-5)
    assert any("over a texture (their mean is used)" in note for note in asset.ignored) == strict


def test_specular_glossiness_keeps_plain_dielectrics_and_finds_plain_metals():
    diffuse, specular = np.array([[0.4, 0.2, 0.1], [0, 0, 0]]), np.array([[0.04] * 3, [1.0, 0.8, 0.3]])
    base_color, metallic = metallic_roughness(diffuse, specular)
    np.testing.assert_allclose(base_color, [[0.4, 0.2, 0.1], [1.0, 0.8, 0.3]], atol=2e-2)
    np.testing.assert_allclose(metallic, [0, 1], atol=2e-2)


def test_specular_glossiness_textures_are_converted_texel_by_texel(tmp_path):
    texels = np.random.default_rng(2).integers(0, 256, (2, 3, 4))
    builder = GltfBuilder()
    gloss = {"specularGlossinessTexture": {"index": builder.texture(texels)}, "diffuseFactor": [0.4, 0.2, 0.1, 1]}
    material = builder.material(extensions={"KHR_materials_pbrSpecularGlossiness": gloss})
    (part,) = one_square(tmp_path, builder, material=material, TEXCOORD_0=UV).parts
    expected = metallic_roughness(np.array([0.4, 0.2, 0.1]), srgb_to_linear(texels[..., :3] / 255))
    found = part.material.base_color, part.material.metallic, part.material.roughness
    for values, wanted in zip(found, (*expected, 1 - texels[..., 3] / 255), strict=True):
        np.testing.assert_allclose(values, wanted, atol=1e-5)


def test_what_is_not_modelled_is_named(tmp_path):
    builder = GltfBuilder(animations=[{"channels": []}], extensionsUsed=["EXT_mesh_gpu_instancing"])
    texture, sheen = {"index": builder.texture(CHECKER)}, {"KHR_materials_sheen": {}}
    more = {"normalTexture": texture, "occlusionTexture": texture, "emissiveFactor": [0, 0.1, 0], "extensions": sheen}
    material = builder.material(**more)
    builder.mesh(builder.primitive(indices=SQUARE[:4], mode=1))
    asset = one_square(tmp_path, builder, material=material)
    named = ["EXT_mesh_gpu_instancing", "KHR_materials_sheen", "LINES primitives", "animations", "emissive"]
    assert asset.ignored == (*named, "normalTexture", "occlusionTexture")


def test_a_texture_on_faces_without_coordinates_becomes_its_mean_and_is_named(tmp_path):
    asset = textured_square(tmp_path, info={"texCoord": 3})
    np.testing.assert_allclose(asset.parts[0].material.base_color, LINEAR.mean(axis=(0, 1)), atol=1e-6)
    assert any("without texture coordinates" in note for note in asset.ignored)


# Packed meshes

ROUNDED = "directions in 8 bytes"  # the only one in which the last bit is a matter of rounding
READ = {name: case for name, case in MESHOPT.items() if case["filter"] != "COLOR"}


@pytest.mark.parametrize("name", READ)
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


def test_a_file_whose_buffers_meshopt_packed_is_read(tmp_path):
    for name, content in meshopt_files().items():
        (tmp_path / name).write_bytes(content)
    places = np.frombuffer(MESHOPT["two blocks of steps, format 1"]["plain"], "<u2").reshape(300, 4)[:, :3]
    corners = np.frombuffer(MESHOPT["a grid"]["plain"], "<u4").reshape(-1, 3)
    (part,) = load_mesh(tmp_path / "mesh.gltf").parts
    found = {face.tobytes() for face in part.positions[part.faces]}
    assert len(found) > 30  # some have no area
    assert found <= {face.tobytes() for face in places[corners].astype(float)}


def test_positions_faces_and_normalised_colours_come_out_of_a_draco_mesh(tmp_path):
    (part,) = load_mesh(draco_square().write(tmp_path / "packed.glb")).parts
    expected = CORNERS + [1, 0, 0]
    order, at = np.lexsort(part.positions.T), np.lexsort(expected.T)
    np.testing.assert_allclose(part.positions[order], expected[at], atol=1e-4)
    np.testing.assert_allclose(part.colors[order], COLORS[at] / 255)
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a), [[0, 0, 1]] * 2, atol=1e-3)


def test_a_draco_mesh_that_lacks_something_or_is_cut_anywhere_is_refused_in_one_line(tmp_path):
    lacking = [{"attributes": {"POSITION": 77}}, {"attributes": {}}, {"bufferView": 99}]
    builders = [draco_square(**extension) for extension in lacking]
    for length in range(0, builders[0].document["bufferViews"][0]["byteLength"], 5):
        builders.append(draco_square())
        builders[-1].document["bufferViews"][0]["byteLength"] = length
    words = "has no POSITION in its Draco mesh|broken or truncated|Draco mesh that is broken or cut off"
    for builder in builders:
        with pytest.raises(UserError, match=words) as caught:
            load_mesh(builder.write(tmp_path / "bad.glb"))
        assert "\n" not in str(caught.value)


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    paths = dict.fromkeys(("laspy", "lazrs"), tmp_path / "a.las") | {"meshoptimizer": tmp_path / "mesh.gltf"}
    paths["DracoPy"] = draco_square().write(tmp_path / "a.glb")
    as_scan(paths["laspy"], WHOLE)
    for name, content in meshopt_files().items():
        (tmp_path / name).write_bytes(content)
    for package, path in paths.items():
        extra = "formats" if path.suffix == ".las" else "meshes"
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            with pytest.raises(UserError, match=rf"needs the package {package} .* 'spnr-jax\[{extra}\]'"):
                read_cloud(path)
