"""Surface points: uniform by area, materials as the renderer sees them, and the textures that these come from."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.gltf_files import CORNERS, SQUARE, UV, GltfBuilder, png
from support.handmade import plain

from spnr_jax.formats.assets import Asset, Part, decode_image, decode_texels
from spnr_jax.formats.meshes import load_mesh
from spnr_jax.formats.surface_points import normalise, sample_surface

FACES = SQUARE.reshape(2, 3)


def square(size=1.0, offset=(0, 0, 0), look=None, **columns):
    return Part(positions=CORNERS.astype(float) * size + offset, faces=FACES, material=look or plain(), **columns)


def test_centre_goes_to_zero_and_half_the_diagonal_to_one():
    asset = Asset(parts=(square(3.0, (10, 20, 30)), square(1.0, (11, 21, 34))))
    moved, transform = normalise(asset)
    corners = np.concatenate([part.positions for part in moved.parts])
    np.testing.assert_allclose(corners.min(axis=0), -corners.max(axis=0), atol=1e-12)
    assert np.linalg.norm(np.ptp(corners, axis=0)) == pytest.approx(2)
    assert transform == {"centre": [11.5, 21.5, 32.0], "scale": pytest.approx(2 / np.sqrt(9 + 9 + 16))}


def test_points_are_uniform_by_area_on_the_faces_that_they_name():
    parts = (square(1.0), square(3.0, (5, 0, 0)), square(0.0), square(1.0, (0, 0, 3)))
    points = sample_surface(Asset(parts=parts), 20_000, 0)
    # four standard deviations of a share of 20000 draws
    expected = np.array([1, 1, 9, 9, 0, 0, 1, 1]) / 22
    np.testing.assert_allclose(np.bincount(points.face) / 20_000, expected, atol=4 * 0.5 / np.sqrt(20_000))
    corners = np.concatenate([part.positions[part.faces] for part in parts])[points.face]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    inside = (np.linalg.pinv(edges) @ (points.positions - corners[:, 0])[..., None])[..., 0]
    np.testing.assert_allclose((edges @ inside[..., None])[..., 0] + corners[:, 0], points.positions, atol=1e-5)
    assert inside.min() > -1e-5
    assert inside.sum(axis=1).max() < 1 + 1e-5
    # moments of the uniform distribution on the triangle (0,0) (1,0) (0,1)
    np.testing.assert_allclose(inside.mean(axis=0), [1 / 3, 1 / 3], atol=0.01)
    np.testing.assert_allclose(np.cov(inside.T), [[1 / 18, -1 / 36], [-1 / 36, 1 / 18]], atol=2e-3)


def test_the_material_is_looked_up_where_the_point_lies():
    ramp = np.tile(np.linspace(0, 1, 64, dtype=np.float32), (64, 1))  # value of texel centre i is i / 63
    look = plain(color=np.stack([ramp, ramp.T, np.ones((64, 64))], axis=-1), roughness=1 - ramp.T[:, :2], metallic=0.25)
    tint = np.tile([0.5, 1.0, 0.5], (4, 1))
    part = square(look=replace(look, wrap="clamp"), texcoords=UV.astype(float), colors=tint)
    points = sample_surface(Asset(parts=(part,)), 1000, 3)
    u, v = points.positions[:, 0], 1 - points.positions[:, 1]

    def texel(coordinate):
        return np.clip((coordinate * 64 - 0.5) / 63, 0, 1)

    np.testing.assert_allclose(points.base_color[:, 0], 0.5 * texel(u), atol=1e-5)
    np.testing.assert_allclose(points.base_color[:, 1], texel(v), atol=1e-5)
    np.testing.assert_allclose(points.base_color[:, 2], 0.5, atol=1e-6)
    np.testing.assert_allclose(points.roughness, 1 - texel(v), atol=1e-5)
    np.testing.assert_array_equal(points.metallic, np.float32(0.25))


def test_normals_are_the_faces_or_the_interpolated_ones_and_always_unit():
    tilted = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, 1], [-1, 0, 1]]) / np.sqrt(2)
    flat = sample_surface(Asset(parts=(square(),)), 200, 5)
    smooth = sample_surface(Asset(parts=(square(normals=tilted),)), 200, 5)
    np.testing.assert_array_equal(flat.normals, np.tile(np.float32([0, 0, 1]), (200, 1)))
    expected = np.stack([2 * smooth.positions[:, 0] - 1, np.zeros(200), np.ones(200)], axis=-1)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(smooth.normals, expected, atol=1e-5)


# Normal maps

RED, GREEN = (0.6, 0.0, 0.8), (0.0, 0.6, 0.8)
X, Y = np.array([0.6, 0, 0.8]), np.array([0, 0.6, 0.8])


def bumpy_normals(tmp_path, normal, uv=UV, transform=None, **attributes):
    """The normals at points of a square that faces +z with a map of one normal."""
    builder = GltfBuilder()
    texels = np.tile(np.rint((np.array(normal) + 1) / 2 * 255).astype(np.uint8), (2, 2, 1))
    extensions = {"KHR_texture_transform": transform} if transform else {}
    material = builder.material(normalTexture={"index": builder.texture(texels), "extensions": extensions})
    builder.mesh(builder.primitive(material=material, TEXCOORD_0=uv, **attributes))
    asset = load_mesh(builder.write(tmp_path / "bumpy.glb"), transparent_parts="opaque")
    assert asset.ignored == ()
    return sample_surface(asset, 10, 0).normals


TURNS = [  # coordinates; what red, which tilts along u, and green, up the picture, become
    (UV, X, Y),
    (UV[:, ::-1], -Y, -X),  # transposed: a quarter turn and a mirror
    (UV * [-1, 1], X * [-1, 1, 1], Y),  # mirrored in u alone
    (1 - UV, X * [-1, 1, 1], Y * [1, -1, 1]),  # half a turn
]


@pytest.mark.parametrize(("uv", "of_red", "of_green"), TURNS)
def test_a_normal_map_tilts_along_the_coordinates_however_they_are_turned(tmp_path, uv, of_red, of_green):
    for normal, (x, y, _) in ((RED, of_red), (GREEN, of_green)):
        np.testing.assert_allclose(bumpy_normals(tmp_path, normal, uv.astype("f4")), [[x, y, 0.8]] * 10, atol=0.01)


def test_the_transform_of_the_map_turns_the_tilt(tmp_path):
    found = bumpy_normals(tmp_path, RED, transform={"rotation": np.pi / 2})
    steps = UV @ np.array([[0, 1], [-1, 0]]).T  # as the extension turns coordinates
    along_u = np.linalg.lstsq(CORNERS[:, :2] - 0.5, steps[:, 0] - steps[:, 0].mean(), rcond=None)[0]
    np.testing.assert_allclose(found[:, :2], [0.6 * along_u / np.linalg.norm(along_u)] * 10, atol=0.01)


def test_vertex_normals_are_what_is_tilted(tmp_path):
    leaning = np.tile(np.float32([0, 0.6, 0.8]), (4, 1))
    found = bumpy_normals(tmp_path, RED, NORMAL=leaning)
    np.testing.assert_allclose(found, [0.8 * leaning[0] + [0.6, 0, 0]] * 10, atol=0.01)


# Texels


def test_shrinking_by_a_whole_factor_takes_the_mean_of_each_block():
    texels = np.random.default_rng(0).integers(0, 256, (2048, 6, 3), dtype=np.uint8)
    expected = (texels / 255).reshape(1024, 2, 3, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(decode_texels(texels), expected, atol=1e-6)


def test_grey_images_of_sixteen_bits_or_floats_are_scaled_not_clipped():
    stream = png(np.zeros((1, 1, 3)))
    assert decode_image(stream).tolist() == [[[0, 0, 0, 255]]]
    shares, numbers = np.float32([[-1, 128 / 255, 1]]), np.float32([[np.nan, 128, 300]])
    for levels in (np.array([[0, 32896, 65535]], np.uint16), shares, numbers):
        stream = io.BytesIO()
        Image.fromarray(levels).save(stream, "tiff")
        assert decode_texels(decode_image(stream.getvalue())[..., 1]).tolist() == [[0, np.float32(128 / 255), 1]]
