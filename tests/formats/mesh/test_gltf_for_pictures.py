"""glTF files as pictures need them: textures with coordinates of their own, instances, what is dropped in one line."""

from pathlib import Path

import numpy as np
import pytest
from support.gltf_files import CORNERS, UV, GltfBuilder

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.gltf import INSTANCING
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.surface_points import sample_surface

HARD = Path(__file__).parents[4] / "shared" / "data" / "hard"


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

    def test_a_transform_of_one_texture_moves_it_alone(self, tmp_path):
        moved = {"extensions": {"KHR_texture_transform": {"scale": [2, 1], "offset": [0.5, 0]}}}
        (x, _), roughness = (values.T for values in self.two_textures(tmp_path, moved))
        phase = (2 * x + 0.5) % 1
        clear = np.abs(phase % 0.5 - 0.25) < 0.15
        np.testing.assert_allclose(roughness[clear], phase[clear] > 0.5, atol=1e-6)

    def test_a_set_of_its_own_is_read(self, tmp_path):
        (_, y), roughness = (
            values.T for values in self.two_textures(tmp_path, {"texCoord": 1}, TEXCOORD_1=CORNERS[:, 1::-1].copy())
        )
        clear = np.abs(y - 0.5) > 0.1
        inside = clear & (y > 0.05) & (y < 0.95)
        np.testing.assert_allclose(roughness[inside], y[inside] > 0.5, atol=1e-6)

    def test_a_wrap_mode_of_its_own_is_kept(self, tmp_path):
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
