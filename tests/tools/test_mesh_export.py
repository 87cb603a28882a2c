"""The surface of what is solid is a closed mesh in the file's frame, and wears the materials of the nearest points."""

import dataclasses
import io

import numpy as np
import pytest
import trimesh
from support.solid_ball import CENTRE, RADIUS, ball_cloud, ball_grid

from spnr_jax.formats.meshes import load_mesh
from spnr_jax.tools.mesh_export import Grid, is_closed, mesh_of


def loaded(content: bytes) -> trimesh.Trimesh:
    """The file's only mesh in its place, just as trimesh reads it."""
    scene = trimesh.load(io.BytesIO(content), file_type="glb")
    assert len(scene.geometry) == 1
    return scene.to_geometry()


def test_a_ball_becomes_a_closed_mesh_of_its_size_in_its_place_with_the_outside_outside():
    solid = mesh_of(ball_grid(), ball_cloud())
    mesh = loaded(solid.content)
    assert len(mesh.faces) == solid.faces
    assert mesh.is_watertight
    assert solid.watertight
    np.testing.assert_allclose(mesh.volume, 4 / 3 * np.pi * RADIUS**3, rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTRE, axis=1), RADIUS, atol=0.01)


def shown_at(material, texcoords):
    """(roughness, metallic) at texture coordinates, by the bilinear rule of glTF."""
    height, width = material.roughness.shape
    places = np.clip(texcoords * [width, height] - 0.5, 0, [width - 1, height - 1])
    left = np.minimum(places.astype(int), [width - 2, height - 2])
    (a, b) = (places - left).T
    i, j = left.T
    channels = [material.roughness, material.metallic]
    rows = [[(1 - a) * c[j + k, i] + a * c[j + k, i + 1] for k in (0, 1)] for c in channels]
    return [(1 - b) * above + b * below for above, below in rows]


@pytest.mark.parametrize("up", ["y", "z", "-x"])
def test_each_place_wears_the_material_of_the_points_there_whichever_way_is_up(tmp_path, up):
    (tmp_path / "a.glb").write_bytes(mesh_of(ball_grid(), ball_cloud(up)).content)
    (part,) = load_mesh(tmp_path / "a.glb").parts
    x = part.positions[:, 0] - CENTRE[0]
    roughness, metallic = shown_at(part.material, part.texcoords)
    for side, color, shine in (x > 0.5, [1, 0, 0], (1, 0)), (x < -0.5, [0, 0, 1], (0.25, 1)):
        np.testing.assert_allclose(part.colors[side], np.broadcast_to(color, (side.sum(), 3)), atol=1e-6)
        np.testing.assert_allclose(roughness[side], shine[0], atol=1e-3)
        np.testing.assert_allclose(metallic[side], shine[1], atol=1e-3)
    outward = ((part.positions - CENTRE) * part.normals).sum(axis=1) / RADIUS
    assert outward.min() > 0.9


def test_a_surface_with_a_hole_or_a_face_that_is_turned_around_is_not_called_closed():
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    assert is_closed(faces)
    assert not is_closed(faces[:3])
    assert not is_closed(np.concatenate([faces[:3], faces[3:, ::-1]]))
    assert not is_closed(np.concatenate([faces, faces[:1]]))


def test_a_mesh_far_from_the_origin_keeps_its_precision():
    origin = (500_000.0, 4_000_000.0, 100.0)
    bounds = loaded(mesh_of(ball_grid(origin), ball_cloud(origin=origin)).content).bounds
    np.testing.assert_allclose(bounds, np.array(origin) + CENTRE + [[-RADIUS] * 3, [RADIUS] * 3], atol=0.02)


def test_a_surface_at_the_edge_of_the_grid_is_closed():
    grid = Grid(values=np.ones((5, 5, 5), np.float32), lowest=np.zeros(3), spacing=1.0, origin=np.zeros(3))
    mesh = loaded(mesh_of(grid, ball_cloud()).content)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [[-0.5] * 3, [4.5] * 3])


def test_a_grid_without_a_surface_is_refused():
    grid = ball_grid()
    with pytest.raises(ValueError, match="no surface to write as a mesh: .* show nothing solid"):
        mesh_of(dataclasses.replace(grid, values=0.5 * grid.values), ball_cloud())
