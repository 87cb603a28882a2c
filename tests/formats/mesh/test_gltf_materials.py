"""Materials and textures of glTF files against values that the tests write down themselves."""

import io

import numpy as np
import pytest
from PIL import Image, features
from support.gltf_files import CHECKER, CORNERS, SQUARE, UV, GltfBuilder, one_square, textured_square

from spnr_jax.formats.columns import srgb_to_linear
from spnr_jax.formats.mesh.gltf_materials import metallic_roughness
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.surface_points import sample_surface

LINEAR = srgb_to_linear(CHECKER / 255)


def surfaced(tmp_path, **info):
    """The asset of a square whose texture of roughness and metallic has a textureInfo."""
    builder = GltfBuilder()
    surface = {"index": builder.texture(CHECKER), **info}
    pbr = {"metallicRoughnessTexture": surface, "roughnessFactor": 0.5}
    if info:
        pbr["baseColorTexture"] = {"index": builder.texture(CHECKER)}
    material = builder.material(pbrMetallicRoughness=pbr)
    return one_square(tmp_path, builder, material=material, TEXCOORD_0=UV, TEXCOORD_1=UV)


def test_factors_are_exact_in_float32(tmp_path):
    builder = GltfBuilder()
    color, roughness, metallic = [0.0252, 0.31415926, 0.9], 0.123456, 0.654321
    pbr = {"baseColorFactor": [*color, 1.0], "roughnessFactor": roughness, "metallicFactor": metallic}
    (part,) = one_square(tmp_path, builder, material=builder.material(pbrMetallicRoughness=pbr)).parts
    np.testing.assert_array_equal(part.material.base_color, np.float32(color))
    assert (part.material.roughness, part.material.metallic) == (np.float32(roughness), np.float32(metallic))
    assert part.material.base_color.dtype == part.material.roughness.dtype == np.float32


def test_a_base_color_texture_is_linearised_and_multiplied_by_its_factor(tmp_path):
    (part,) = textured_square(tmp_path, factors={"baseColorFactor": [0.5, 1, 0.25, 1]}).parts
    np.testing.assert_allclose(part.material.base_color, LINEAR * [0.5, 1, 0.25], atol=1e-6)
    np.testing.assert_array_equal(part.texcoords, UV)


def test_roughness_is_green_and_metallic_blue_of_the_linear_texture(tmp_path):
    look = surfaced(tmp_path).parts[0].material
    np.testing.assert_allclose(look.roughness, CHECKER[..., 1] / 255 * 0.5, atol=1e-6)
    np.testing.assert_allclose(look.metallic, CHECKER[..., 2] / 255, atol=1e-6)


def test_a_second_texture_with_its_own_coordinates_becomes_its_mean_and_is_named(tmp_path):
    asset = surfaced(tmp_path, texCoord=1)
    mean = 0.5 * CHECKER[..., 1].mean() / 255
    np.testing.assert_allclose(asset.parts[0].material.roughness, mean, atol=0.5 / 255)
    assert any("second texture" in note for note in asset.ignored)


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
    base_color, metallic = metallic_roughness(np.array([0.4, 0.2, 0.1]), srgb_to_linear(texels[..., :3] / 255))
    np.testing.assert_allclose(part.material.roughness, 1 - texels[..., 3] / 255, atol=1e-6)
    np.testing.assert_allclose(part.material.metallic, metallic, atol=1e-5)
    np.testing.assert_allclose(part.material.base_color, base_color, atol=1e-5)


@pytest.mark.skipif(not features.check("webp"), reason="this Pillow cannot decode WebP")
def test_webp_textures_are_preferred_to_their_fallback(tmp_path):
    builder, stream = GltfBuilder(), io.BytesIO()
    texture = builder.texture(uri="fallback-that-is-not-there.png")
    Image.fromarray(CHECKER.astype(np.uint8)).save(stream, "webp", lossless=True)
    (tmp_path / "checker.webp").write_bytes(stream.getvalue())
    builder.document["images"].append({"uri": "checker.webp"})
    builder.document["textures"][texture]["extensions"] = {"EXT_texture_webp": {"source": 1}}
    material = builder.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
    (part,) = one_square(tmp_path, builder, material=material, TEXCOORD_0=UV).parts
    np.testing.assert_allclose(part.material.base_color, LINEAR, atol=1e-6)


def test_what_is_not_modelled_is_named(tmp_path):
    builder = GltfBuilder(animations=[{"channels": [], "samplers": []}])
    texture, sheen = {"index": builder.texture(CHECKER)}, {"KHR_materials_sheen": {}}
    more = {"normalTexture": texture, "occlusionTexture": texture, "emissiveFactor": [0, 0.1, 0], "extensions": sheen}
    material = builder.material(**more)
    builder.mesh(builder.primitive(indices=SQUARE[:4], mode=1))
    asset = one_square(tmp_path, builder, material=material)
    named = "KHR_materials_sheen, LINES primitives, animations, emissive, normalTexture, occlusionTexture"
    assert ", ".join(asset.ignored) == named


def test_a_texture_on_faces_without_coordinates_becomes_its_mean_and_is_named(tmp_path):
    asset = textured_square(tmp_path, info={"texCoord": 3})
    np.testing.assert_allclose(asset.parts[0].material.base_color, LINEAR.mean(axis=(0, 1)), atol=1e-6)
    assert any("without texture coordinates" in note for note in asset.ignored)
