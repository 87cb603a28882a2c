"""glTF files: geometry, transforms and materials against values that the tests write down themselves."""

import base64

import numpy as np
import pytest
from support.gltf_files import CHECKER, CORNERS, SQUARE, UV, GltfBuilder, one_square, png, textured_square

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.meshes import load_mesh


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

    def test_a_matrix_is_read_column_by_column(self, tmp_path):
        matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]
        (part,) = one_square(tmp_path, node={"matrix": matrix}).parts
        np.testing.assert_array_equal(part.positions.min(axis=0), [5, 6, 7])

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

    def test_smooth_and_flat_parts_of_one_material_stay_apart(self, tmp_path):
        builder = GltfBuilder()
        builder.mesh(builder.primitive(), builder.primitive(NORMAL=np.tile(np.float32([0, 0, 2]), (4, 1))))
        flat, smooth = load_mesh(builder.write(tmp_path / "mixed.glb")).parts
        assert flat.normals is None
        np.testing.assert_array_equal(smooth.normals, [[0, 0, 1]] * 4)

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

    def test_gltf_with_files_beside_it_equals_the_packed_file(self, tmp_path):
        builder = GltfBuilder()
        texture = builder.texture(uri="my%20texture.png")
        (tmp_path / "my texture.png").write_bytes(png(CHECKER))
        material = builder.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
        builder.mesh(builder.primitive(material=material, TEXCOORD_0=UV))
        beside = load_mesh(builder.write(tmp_path / "beside.gltf"))
        builder.document["images"][0] = {"uri": "data:image/png;base64," + base64.b64encode(png(CHECKER)).decode()}
        packed = load_mesh(builder.write(tmp_path / "packed.glb"))
        np.testing.assert_array_equal(beside.parts[0].positions, packed.parts[0].positions)
        np.testing.assert_array_equal(beside.parts[0].material.base_color, packed.parts[0].material.base_color)


class TestRejections:
    """Every file that cannot be used is refused with one line that says why."""

    def reason(self, path):
        with pytest.raises(RejectedAsset) as caught:
            load_mesh(path)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    def reason_of(self, tmp_path, builder, **primitive):
        builder.mesh(builder.primitive(**primitive))
        return self.reason(builder.write(tmp_path / "bad.glb"))

    @pytest.mark.parametrize("mode", ["BLEND", "MASK"])
    def test_alpha_modes(self, tmp_path, mode):
        builder = GltfBuilder()
        material = builder.material(name="glass", alphaMode=mode)
        assert self.reason_of(tmp_path, builder, material=material) == (
            f"is transparent: material 'glass' has alphaMode {mode}"
        )

    def test_transmission_but_not_a_transmission_of_zero(self, tmp_path):
        for factor in (0, 0.5):
            builder = GltfBuilder()
            extension = {"KHR_materials_transmission": {"transmissionFactor": factor}}
            material = builder.material(name="glass", extensions=extension)
            if factor:
                assert "KHR_materials_transmission" in self.reason_of(tmp_path, builder, material=material)
            else:
                assert len(one_square(tmp_path, builder, material=material).parts) == 1

    def test_a_transparent_material_that_nothing_uses_is_harmless(self, tmp_path):
        builder = GltfBuilder()
        builder.material(alphaMode="BLEND")
        assert len(one_square(tmp_path, builder).parts) == 1

    @pytest.mark.parametrize("name", ["KHR_gaussian_splatting", "ABC_unheard_of"])
    def test_extensions_that_the_file_requires_and_we_lack(self, tmp_path, name):
        assert name in self.reason_of(tmp_path, GltfBuilder(extensionsRequired=[name]))

    def test_a_compressed_accessor_that_is_not_declared(self, tmp_path):
        builder = GltfBuilder()
        primitive = builder.primitive()
        del builder.document["accessors"][0]["bufferView"]
        builder.mesh(primitive)
        assert "holds no data" in self.reason(builder.write(tmp_path / "bad.glb"))

    def test_gltf_one(self, tmp_path):
        assert "glTF 1.0" in self.reason_of(tmp_path, GltfBuilder(asset={"version": "1.0"}))

    def test_missing_textures_are_named(self, tmp_path):
        builder = GltfBuilder()
        texture = {"index": builder.texture(uri="textures/gone.png")}
        material = builder.material(pbrMetallicRoughness={"baseColorTexture": texture})
        assert "missing: 'textures/gone.png'" in self.reason_of(tmp_path, builder, material=material)

    def test_missing_buffers_are_named(self, tmp_path):
        builder = GltfBuilder()
        builder.mesh(builder.primitive())
        path = builder.write(tmp_path / "bad.gltf")
        (tmp_path / "data.bin").unlink()
        assert "missing: 'data.bin'" in self.reason(path)

    @pytest.mark.parametrize(
        "uri", ["../secret.png", "a/../../secret.png", "/etc/hostname", "..%2fsecret.png", "file:///x", "C:\\x.png"]
    )
    def test_names_that_leave_the_folder(self, tmp_path, uri):
        folder = tmp_path / "inside"
        folder.mkdir()
        (tmp_path / "secret.png").write_bytes(png(CHECKER))
        builder = GltfBuilder()
        material = builder.material(pbrMetallicRoughness={"baseColorTexture": {"index": builder.texture(uri=uri)}})
        assert "outside its own folder" in self.reason_of(folder, builder, material=material)

    def test_an_image_that_is_none(self, tmp_path):
        (tmp_path / "broken.png").write_bytes(png(CHECKER)[:40])
        builder = GltfBuilder()
        texture = {"index": builder.texture(uri="broken.png")}
        material = builder.material(pbrMetallicRoughness={"baseColorTexture": texture})
        assert "broken.png" in self.reason_of(tmp_path, builder, material=material)

    def test_files_cut_anywhere(self, tmp_path):
        builder = GltfBuilder()
        builder.mesh(builder.primitive())
        whole = builder.glb()
        path = tmp_path / "cut.glb"
        for length in [0, 3, 11, 13, 30, len(whole) // 2, len(whole) - 1]:
            path.write_bytes(whole[:length])
            assert "truncated" in self.reason(path)

    def test_a_buffer_that_is_shorter_than_its_views(self, tmp_path):
        builder = GltfBuilder()
        builder.mesh(builder.primitive())
        path = builder.write(tmp_path / "short.gltf")
        (tmp_path / "data.bin").write_bytes(builder.binary[:-20])
        assert "truncated" in self.reason(path)

    def test_nothing_to_draw(self, tmp_path):
        assert self.reason(GltfBuilder().write(tmp_path / "empty.glb")) == "has no faces"
        assert self.reason_of(tmp_path, GltfBuilder(), indices=SQUARE[:4], mode=1) == "has no faces"

    def test_coordinates_that_are_not_finite(self, tmp_path):
        for bad in (np.nan, np.inf):
            positions = CORNERS.copy()
            positions[2, 1] = bad
            assert "not finite" in self.reason_of(tmp_path, GltfBuilder(), positions=positions)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
    def test_texture_coordinates_that_lead_nowhere(self, tmp_path, bad):
        with pytest.raises(RejectedAsset, match="texture coordinates that are not finite"):
            textured_square(tmp_path, TEXCOORD_0=np.where(UV == 0, np.float32(bad), UV))

    def test_all_vertices_in_one_point(self, tmp_path):
        assert "zero extent" in self.reason_of(tmp_path, GltfBuilder(), positions=np.ones_like(CORNERS))

    def test_indices_beyond_the_vertices(self, tmp_path):
        assert "vertices 0 to 9 of 4" in self.reason_of(tmp_path, GltfBuilder(), indices=np.array([0, 1, 9], np.uint16))

    def test_columns_of_the_wrong_length(self, tmp_path):
        reason = self.reason_of(tmp_path, GltfBuilder(), NORMAL=np.ones((3, 3), np.float32))
        assert "normals of shape (3, 3) where (4, 3) is needed" in reason

    def test_a_scene_that_loops(self, tmp_path):
        builder = GltfBuilder()
        builder.node(children=[0])
        assert "not a tree" in self.reason_of(tmp_path, builder)
