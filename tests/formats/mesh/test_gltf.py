"""glTF files: geometry, transforms and materials against values that the tests write down themselves."""

import numpy as np
import pytest
from support.gltf_files import CHECKER, CORNERS, SQUARE, UV, GltfBuilder, one_square, png

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.gltf import INSTANCING
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.surface_points import sample_surface


def corners_in_space(part):
    return {tuple(np.round(p, 6)) for p in part.positions[part.faces.ravel()]}


def face_normals(part):
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


class TestGeometry:
    def test_node_transforms_are_chained_from_the_root(self, tmp_path):
        builder = GltfBuilder()
        child = builder.mesh(builder.primitive(), translation=[1, 0, 0])
        builder.document["scenes"][0]["nodes"] = []
        half_turn_about_y = [0, 1, 0, 0]
        builder.node(children=[child], rotation=half_turn_about_y, scale=[2, 3, 4])
        (part,) = load_mesh(builder.write(tmp_path / "nodes.glb")).parts
        assert corners_in_space(part) == {(-2, 0, 0), (-4, 0, 0), (-4, 3, 0), (-2, 3, 0)}

    def test_a_mirrored_node_keeps_faces_and_normals_on_the_same_side(self, tmp_path):
        normals = np.tile(np.float32([0, 0, 1]), (4, 1))
        for scale in ([-1, 1, 1], [1, 1, -1], [-2, -3, -1]):
            (part,) = one_square(tmp_path, node={"scale": scale}, NORMAL=normals).parts
            outside = np.sign(scale[2]) * np.array([0, 0, 1])
            np.testing.assert_allclose(face_normals(part), [outside] * 2, atol=1e-9)
            np.testing.assert_allclose(part.normals, [outside] * 4, atol=1e-9)

    def test_normals_follow_the_inverse_transpose(self, tmp_path):
        slanted = CORNERS.copy()
        slanted[2:, 2] = 1  # the plane z = y, normal (0, -1, 1)
        normals = np.tile(np.float32([0, -0.6, 0.6]), (4, 1))
        (part,) = one_square(tmp_path, positions=slanted, node={"scale": [1, 3, 0.5]}, NORMAL=normals).parts
        np.testing.assert_allclose(part.normals[:2], face_normals(part), atol=1e-6)

    def test_parts_with_equal_materials_merge_and_others_stay_apart(self, tmp_path):
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

    def test_strips_fans_and_lists_describe_the_same_square(self, tmp_path):
        for mode, order in ((4, SQUARE), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])):
            (part,) = one_square(tmp_path, indices=np.array(order, np.uint16), mode=mode).parts
            assert len(part.faces) == 2
            np.testing.assert_allclose(face_normals(part), [[0, 0, 1]] * 2)

    def test_quantised_and_strided_positions_are_decoded(self, tmp_path):
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

    def test_sparse_accessors_replace_the_named_rows(self, tmp_path):
        builder = GltfBuilder()
        primitive = builder.primitive()
        rows, values = builder.view(np.uint16([2]).tobytes()), builder.view(np.float32([5, 6, 7]).tobytes())
        builder.document["accessors"][primitive["attributes"]["POSITION"]]["sparse"] = {
            "count": 1,
            "indices": {"bufferView": rows, "componentType": 5123},
            "values": {"bufferView": values},
        }
        builder.mesh(primitive)
        (part,) = load_mesh(builder.write(tmp_path / "sparse.glb")).parts
        np.testing.assert_array_equal(part.positions, [*CORNERS[:2], [5, 6, 7], CORNERS[3]])


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


def without_data():
    builder = GltfBuilder()
    primitive = builder.primitive()
    del builder.document["accessors"][0]["bufferView"]
    builder.mesh(primitive)
    return builder


def looping():
    builder = GltfBuilder()
    builder.node(children=[0])
    return plain(builder)


def with_corner(value):
    positions = CORNERS.copy()
    positions[2, 1] = value
    return plain(positions=positions)


TRANSMISSION = {"KHR_materials_transmission": {"transmissionFactor": 0.5}}
OUTSIDE = "../secret.png", "a/../../secret.png", "/etc/hostname", "..%2fsecret.png", "file:///x", "C:\\x.png"
REFUSED = (
    (looking(alphaMode="BLEND"), "is transparent: material 'glass' has alphaMode BLEND"),
    (looking(alphaMode="MASK"), "is transparent: material 'glass' has alphaMode MASK"),
    (looking(extensions=TRANSMISSION), "KHR_materials_transmission"),
    *((plain(GltfBuilder(extensionsRequired=[x])), x) for x in ("KHR_gaussian_splatting", "ABC_unheard_of")),
    (without_data(), "holds no data"),
    (plain(GltfBuilder(asset={"version": "1.0"})), "glTF 1.0"),
    (textured("textures/gone.png"), "missing: 'textures/gone.png'"),
    *((textured(uri), "outside its own folder") for uri in OUTSIDE),
    (textured("broken.png"), "broken.png"),
    (GltfBuilder(), "has no faces"),
    (plain(indices=SQUARE[:4], mode=1), "has no faces"),
    *((with_corner(value), "not finite") for value in (np.nan, np.inf)),
    (plain(positions=np.ones_like(CORNERS)), "zero extent"),
    (plain(indices=np.array([0, 1, 9], np.uint16)), "vertices 0 to 9 of 4"),
    (plain(NORMAL=np.ones((3, 3), np.float32)), "normals of shape (3, 3) where (4, 3) is needed"),
    (looping(), "not a tree"),
)


class TestRejections:
    """Every file that cannot be used is refused with one line that says why."""

    def reason(self, path):
        with pytest.raises(RejectedAsset) as caught:
            load_mesh(path)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    @pytest.mark.parametrize(("builder", "words"), REFUSED, ids=[words for _, words in REFUSED])
    def test_documents(self, tmp_path, builder, words):
        folder = tmp_path / "inside"
        folder.mkdir()
        (tmp_path / "secret.png").write_bytes(png(CHECKER))
        (folder / "broken.png").write_bytes(png(CHECKER)[:40])
        assert words in self.reason(builder.write(folder / "bad.glb"))

    def test_buffers_that_are_missing_or_shorter_than_their_views(self, tmp_path):
        builder = plain()
        path = builder.write(tmp_path / "bad.gltf")
        (tmp_path / "data.bin").write_bytes(builder.binary[:-20])
        assert "truncated" in self.reason(path)
        (tmp_path / "data.bin").unlink()
        assert "missing: 'data.bin'" in self.reason(path)


class TestCoordinates:
    """Each texture is looked up where its own coordinates say."""

    # roughness 0 in the left half, 1 in the right
    HALVES = np.tile(np.array([[0, 0, 0]] * 8 + [[0, 255, 255]] * 8, np.uint8), (4, 1, 1))

    def two_textures(self, tmp_path, info=None, sampler=None, **attributes):
        builder = GltfBuilder()
        color = {"index": builder.texture(np.full((2, 2, 3), 255))}
        surface = {"index": builder.texture(self.HALVES, **(sampler or {}))} | (info or {})
        pbr = {"baseColorTexture": color, "metallicRoughnessTexture": surface}
        material = builder.material(pbrMetallicRoughness=pbr)
        builder.mesh(builder.primitive(material=material, TEXCOORD_0=UV, **attributes))
        asset = load_mesh(builder.write(tmp_path / "a.glb"), transparent_parts="opaque")
        assert asset.ignored == ()
        points = sample_surface(asset, 400, 0)
        return points.positions[:, :2], points.roughness

    def test_a_transform_a_set_and_a_wrap_mode_of_one_texture_count_for_it_alone(self, tmp_path):
        moved = {"extensions": {"KHR_texture_transform": {"scale": [2, 1], "offset": [0.5, 0]}}}
        (x, _), roughness = (values.T for values in self.two_textures(tmp_path, moved))
        phase = (2 * x + 0.5) % 1
        clear = np.abs(phase % 0.5 - 0.25) < 0.15
        np.testing.assert_allclose(roughness[clear], phase[clear] > 0.5, atol=1e-6)
        turned = CORNERS[:, 1::-1].copy()
        (_, y), roughness = (values.T for values in self.two_textures(tmp_path, {"texCoord": 1}, TEXCOORD_1=turned))
        inside = (np.abs(y - 0.5) > 0.1) & (y > 0.05) & (y < 0.95)
        np.testing.assert_allclose(roughness[inside], y[inside] > 0.5, atol=1e-6)
        clamp = {"wrapS": 33071, "wrapT": 33071}
        moved = {"extensions": {"KHR_texture_transform": {"scale": [4, 1]}}}
        (x, _), roughness = (values.T for values in self.two_textures(tmp_path, moved, clamp))
        assert (roughness[x > 0.2] == 1).all()


class TestInstances:
    """EXT_mesh_gpu_instancing draws a mesh at every row of its attributes."""

    MOVES = np.float32([[0, 0, 0], [5, 0, 0], [0, 5, 0]])

    def instanced(self, tmp_path, name="a.glb", **attributes):
        builder = GltfBuilder(extensionsRequired=[INSTANCING])
        accessors = {key: builder.accessor(values) for key, values in attributes.items()}
        extension = {INSTANCING: {"attributes": accessors}}
        builder.mesh(builder.primitive(), translation=[0, 0, 1], extensions=extension)
        return builder.write(tmp_path / name)

    def test_moves_turns_and_scales_happen_in_the_frame_of_the_node(self, tmp_path):
        half_turn_about_z = np.float32([[0, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]])
        scales = np.float32([[1, 1, 1], [1, 1, 1], [2, 3, 1]])
        path = self.instanced(tmp_path, TRANSLATION=self.MOVES, ROTATION=half_turn_about_z, SCALE=scales)
        (part,) = load_mesh(path).parts
        low, high = part.positions.reshape(3, 4, 3).min(axis=1), part.positions.reshape(3, 4, 3).max(axis=1)
        np.testing.assert_allclose(low, [[0, 0, 1], [4, -1, 1], [0, 5, 1]], atol=1e-6)
        np.testing.assert_allclose(high, [[1, 1, 1], [5, 0, 1], [2, 8, 1]], atol=1e-6)
        assert len(part.faces) == 6

    def test_columns_that_do_not_agree_are_refused(self, tmp_path):
        for attributes in ({"SCALE": self.MOVES[:2]}, {"ROTATION": self.MOVES}):
            with pytest.raises(RejectedAsset, match="attributes do not agree"):
                load_mesh(self.instanced(tmp_path, TRANSLATION=self.MOVES, **attributes))

    def test_a_small_file_cannot_ask_for_any_number_of_faces(self, tmp_path):
        builder = GltfBuilder()
        rows = np.zeros((3000, 3), np.float32)
        extension = {INSTANCING: {"attributes": {"TRANSLATION": builder.accessor(rows)}}}
        indices = np.zeros(3 * 6000, np.uint16)
        builder.mesh(builder.primitive(indices=indices), extensions=extension)
        with pytest.raises(RejectedAsset, match="repeats its meshes more than can be read"):
            load_mesh(builder.write(tmp_path / "many.glb"))
        with pytest.raises(RejectedAsset, match="131073 instances"):
            load_mesh(self.instanced(tmp_path, TRANSLATION=np.zeros((2**17 + 1, 3), np.float32)))
