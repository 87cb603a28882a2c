"""Normal maps tilt sampled normals: along u with red, up the picture with green, whatever turns or mirrors the map."""

import numpy as np
import pytest
from support.gltf_files import CORNERS, UV, GltfBuilder

from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.surface_points import sample_surface, tilted

RED, GREEN, FLAT = (0.6, 0.0, 0.8), (0.0, 0.6, 0.8), (0.0, 0.0, 1.0)
X, Y = np.array([0.6, 0, 0.8]), np.array([0, 0.6, 0.8])


def sampled(tmp_path, normal, uv=UV, node=None, scale=None, transform=None, **attributes):
    """The normals at points of a square that faces +z with a map of one normal."""
    builder = GltfBuilder()
    texels = np.tile(np.rint((np.array(normal) + 1) / 2 * 255).astype(np.uint8), (2, 2, 1))
    info = {"index": builder.texture(texels)} | ({"scale": scale} if scale is not None else {})
    if transform:
        info["extensions"] = {"KHR_texture_transform": transform}
    material = builder.material(normalTexture=info)
    builder.mesh(builder.primitive(material=material, TEXCOORD_0=uv, **attributes), **(node or {}))
    asset = load_mesh(builder.write(tmp_path / "bumpy.glb"), transparent_parts="opaque")
    assert asset.ignored == ()
    return sample_surface(asset, 10, 0).normals


@pytest.mark.parametrize(("normal", "expected"), [(RED, X), (GREEN, Y), (FLAT, [0, 0, 1])])
def test_red_tilts_along_u_and_green_up_the_picture(tmp_path, normal, expected):
    np.testing.assert_allclose(sampled(tmp_path, normal), [expected] * 10, atol=0.01)


@pytest.mark.parametrize(
    ("uv", "of_red", "of_green"),
    [
        (UV[:, ::-1], -Y, -X),  # transposed: a quarter turn and a mirror
        (UV * [-1, 1], X * [-1, 1, 1], Y),  # mirrored in u alone
        (1 - UV, X * [-1, 1, 1], Y * [1, -1, 1]),  # half a turn
    ],
)
def test_mirrored_and_turned_coordinates_turn_the_tilt(tmp_path, uv, of_red, of_green):
    for normal, expected in ((RED, of_red), (GREEN, of_green)):
        expected = np.array([*expected[:2], 0.8])
        np.testing.assert_allclose(sampled(tmp_path, normal, uv.astype(np.float32)), [expected] * 10, atol=0.01)


def test_the_transform_of_the_map_turns_the_tilt(tmp_path):
    found = sampled(tmp_path, RED, transform={"rotation": np.pi / 2})
    steps = UV @ np.array([[0, 1], [-1, 0]]).T  # as the extension turns coordinates
    along_u = np.linalg.lstsq(CORNERS[:, :2] - 0.5, steps[:, 0] - steps[:, 0].mean(), rcond=None)[0]
    np.testing.assert_allclose(found[:, :2], [0.6 * along_u / np.linalg.norm(along_u)] * 10, atol=0.01)


def test_vertex_normals_are_what_is_tilted(tmp_path):
    leaning = np.tile(np.float32([0, 0.6, 0.8]), (4, 1))
    found = sampled(tmp_path, RED, NORMAL=leaning)
    np.testing.assert_allclose(found, [0.8 * leaning[0] + [0.6, 0, 0]] * 10, atol=0.01)


def test_where_the_coordinates_have_no_area_the_normal_stays():
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 3, float)
    texcoords = np.array([[[0, 0], [0, 0], [0, 0]], [[0, 0], [1, 1], [2, 2]], [[0, 0], [1, 0], [0, 1]]], float)
    normals = np.tile([0.0, 0, 1], (3, 1))
    found = tilted(normals, np.array([RED, RED, (0, 0, 0)]), corners, texcoords)
    np.testing.assert_array_equal(found, normals)
