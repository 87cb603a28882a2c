"""For pictures, transparent parts are drawn or left out and missing images are gone without; for references neither."""

import numpy as np
import pytest
from support.gltf_files import UV, GltfBuilder

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.surface_points import sample_surface

AWAY = [10.0, 0.0, 0.0]  # where the opaque square stands


def two_squares(tmp_path, texels=None, factor=1.0, name="leaf", **material):
    """A file of an opaque blue square and one of the material under test."""
    builder = GltfBuilder()
    blue = builder.material(pbrMetallicRoughness={"baseColorFactor": [0, 0, 1, 1]})
    builder.mesh(builder.primitive(material=blue), translation=AWAY)
    pbr = {"baseColorFactor": [1, 1, 1, factor]}
    if texels is not None:
        pbr["baseColorTexture"] = {"index": builder.texture(texels, wrapS=33071, wrapT=33071)}
    tested = builder.material(name=name, pbrMetallicRoughness=pbr, **material)
    builder.mesh(builder.primitive(material=tested, TEXCOORD_0=UV))
    return builder.write(tmp_path / "two.glb")


def half_transparent(low=0, high=255):
    """Texels red throughout, whose left half has one alpha and whose right half another."""
    texels = np.zeros((8, 8, 4), np.uint8)
    texels[..., 0] = 255
    texels[..., 3] = np.where(np.arange(8) < 4, low, high)
    return texels


def share_of_tested(asset, count=2000):
    points = sample_surface(asset, count, 0)
    return points, np.mean(points.positions[:, 0] < 5)


@pytest.mark.parametrize("parts", ["opaque", "skip"])
def test_a_mask_has_points_where_its_alpha_reaches_the_cut_off_alone(tmp_path, parts):
    path = two_squares(tmp_path, half_transparent(100, 200), alphaMode="MASK", alphaCutoff=0.5)
    asset = load_mesh(path, transparent_parts=parts)
    points, share = share_of_tested(asset)
    tested = points.positions[points.positions[:, 0] < 5]
    assert len(points.positions) == 2000
    assert tested[:, 0].min() > 0.5 - 1 / 16
    assert share == pytest.approx(1 / 3, abs=0.04)  # half a square beside a whole one
    assert asset.notes == ("surface only where the alpha of the texture reaches its cut-off: 'leaf'",)


def test_a_mask_that_hides_nothing_changes_nothing_and_one_that_hides_all_leaves_the_part_out(tmp_path):
    path = two_squares(tmp_path, half_transparent(200, 200), alphaMode="MASK")
    asset = load_mesh(path, transparent_parts="opaque")
    assert all(part.material.opacity is None for part in asset.parts)
    assert asset.notes == ()
    path = two_squares(tmp_path, half_transparent(200, 200), factor=0.1, alphaMode="MASK")
    asset = load_mesh(path, transparent_parts="opaque")
    assert share_of_tested(asset)[1] == 0
    assert asset.notes == ("left out, wholly below the alpha cut-off: 'leaf'",)


@pytest.mark.parametrize(
    "material",
    [
        {"factor": 0.2, "alphaMode": "BLEND"},
        {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.9}}},
        {"texels": half_transparent(60, 60), "alphaMode": "BLEND"},
    ],
)
def test_glass_is_drawn_in_its_colour_or_left_out(tmp_path, material):
    path = two_squares(tmp_path, **material)
    opaque, skipped = (load_mesh(path, transparent_parts=parts) for parts in ("opaque", "skip"))
    assert share_of_tested(opaque)[1] == pytest.approx(0.5, abs=0.05)
    assert share_of_tested(skipped)[1] == 0
    assert opaque.notes == ("transparent parts drawn as opaque (--transparent-parts skip leaves them out): 'leaf'",)
    assert skipped.notes == ("transparent parts left out (--transparent-parts opaque draws them): 'leaf'",)
    with pytest.raises(RejectedAsset, match="is transparent: material 'leaf'"):
        load_mesh(path)


def test_empty_space_around_blended_leaves_is_no_surface(tmp_path):
    path = two_squares(tmp_path, half_transparent(5, 200), alphaMode="BLEND")
    for parts in ("opaque", "skip"):
        points, share = share_of_tested(load_mesh(path, transparent_parts=parts))
        assert share == pytest.approx(1 / 3, abs=0.04)
        assert points.positions[points.positions[:, 0] < 5, 0].min() > 0.5 - 1 / 8


def test_an_object_of_which_nothing_is_left_says_why(tmp_path):
    builder = GltfBuilder()
    material = builder.material(name="glass", alphaMode="BLEND", pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0]})
    builder.mesh(builder.primitive(material=material))
    with pytest.raises(RejectedAsset, match="has nothing to draw: transparent parts left out .* 'glass'"):
        load_mesh(builder.write(tmp_path / "glass.glb"), transparent_parts="skip")
    nearly = half_transparent(0, 0)
    nearly[0, 0, 3] = 255
    builder = GltfBuilder()
    pbr = {"baseColorTexture": {"index": builder.texture(np.tile(nearly, (1, 1, 1)))}}
    builder.mesh(
        builder.primitive(
            material=builder.material(alphaMode="MASK", pbrMetallicRoughness=pbr), TEXCOORD_0=UV / 4 + 0.5
        )
    )
    asset = load_mesh(builder.write(tmp_path / "holes.glb"), transparent_parts="opaque")
    with pytest.raises(RejectedAsset, match="next to no surface"):
        sample_surface(asset, 20, 0)


def test_missing_images_leave_plain_values_and_are_named(tmp_path):
    builder = GltfBuilder()
    color, surface, normal = (builder.texture(uri=f"maps/{name}.png") for name in ("color", "surface", "normal"))
    pbr = {"baseColorTexture": {"index": color}, "metallicRoughnessTexture": {"index": surface}}
    material = builder.material(pbrMetallicRoughness=pbr, normalTexture={"index": normal})
    builder.mesh(builder.primitive(material=material, TEXCOORD_0=UV))
    path = builder.write(tmp_path / "bare.glb")
    asset = load_mesh(path, transparent_parts="opaque")
    points = sample_surface(asset, 20, 0)
    np.testing.assert_allclose(points.base_color, 0.5, atol=0.01)
    np.testing.assert_allclose(points.roughness, 0.5, atol=0.01)
    np.testing.assert_array_equal(points.metallic, 0)
    (note,) = asset.notes
    assert note.startswith("plain values taken where it names a file that is missing: 'maps/color.png', ")
    with pytest.raises(RejectedAsset, match="missing: 'maps/color.png'"):
        load_mesh(path)


class TestObj:
    """The same of OBJ and MTL."""

    SQUARES = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 10 0 0\nv 11 0 0\nv 11 1 0\nv 10 1 0\n"
    FACES = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl leaf\nf 1/1 2/2 3/3 4/4\nusemtl plain\nf 5/1 6/2 7/3 8/4\n"

    def write(self, tmp_path, leaf):
        (tmp_path / "look.mtl").write_text(f"newmtl leaf\n{leaf}\nnewmtl plain\nKd 0 0 1\n")
        (tmp_path / "a.obj").write_text(f"mtllib look.mtl\n{self.SQUARES}{self.FACES}")
        return tmp_path / "a.obj"

    @pytest.mark.parametrize("grey", [True, False])
    def test_map_d_is_a_cut_out_by_its_grey_or_its_alpha(self, tmp_path, grey):
        from PIL import Image

        texels = half_transparent()
        Image.fromarray(texels[..., 3] if grey else texels).save(tmp_path / "mask.png")
        asset = load_mesh(self.write(tmp_path, "map_d -clamp on mask.png"), transparent_parts="opaque")
        points, share = share_of_tested(asset)
        assert share == pytest.approx(1 / 3, abs=0.04)
        assert points.positions[points.positions[:, 0] < 5, 0].min() > 0.5 - 1 / 16

    def test_missing_libraries_images_and_materials_leave_plain_values(self, tmp_path):
        path = self.write(tmp_path, "map_Kd C:\\maps\\wood.png\nPr 0.25")
        asset = load_mesh(path, transparent_parts="opaque")
        assert asset.notes == ("plain values taken where it names a file outside its own folder: 'C:/maps/wood.png'",)
        assert np.float32(0.25) in [part.material.roughness for part in asset.parts]
        (tmp_path / "look.mtl").unlink()
        asset = load_mesh(path, transparent_parts="opaque")
        assert "names a file that is missing: 'look.mtl'" in asset.notes[0]
        assert "uses a material that no library defines: 'leaf', 'plain'" in asset.notes[1]
        with pytest.raises(RejectedAsset, match=r"missing: 'look.mtl'"):
            load_mesh(path)
