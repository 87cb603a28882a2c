"""The surface of a density is a closed mesh in the file's frame, and wears the materials of the nearest points."""

import io

import numpy as np
import pytest
import trimesh

from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.up_axis import ROTATIONS
from spnr_jax.kernels.records import PointCloud
from spnr_jax.tools.density_grid import DensityGrid
from spnr_jax.tools.mesh_export import mesh_of

RADIUS, CENTRE = 2.0, np.array([5.0, -3.0, 1.0])


def ball_grid(origin=(0, 0, 0)) -> DensityGrid:
    """Density that falls with the distance from CENTRE, RADIUS at RADIUS."""
    spacing, lowest = 0.2, CENTRE - 3.07  # no vertex falls on a place of the grid
    axes = [lowest[i] + spacing * np.arange(31) for i in range(3)]
    distance = np.linalg.norm(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - CENTRE, axis=-1)
    density = (2 * RADIUS - distance).astype(np.float32)
    return DensityGrid(density=density, lowest=lowest, spacing=spacing, voxel=1.0, origin=np.array(origin, float))


def ball_cloud(up="y", origin=(0, 0, 0)) -> PlacedCloud:
    """Points of the ball: red, rough and no metal where the file's x is large, else blue, smooth and metal."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(600, 3))
    in_file = CENTRE + RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    right = in_file[:, 0] > CENTRE[0]
    rotation = np.array(ROTATIONS[up], float)
    cloud = PointCloud(
        positions=np.float32(in_file @ rotation.T),
        base_color=np.where(right[:, None], np.float32([1, 0, 0]), np.float32([0, 0, 1])),
        roughness=np.where(right, np.float32(1), np.float32(0.25)),
        metallic=np.where(right, np.float32(0), np.float32(1)),
        mask=np.ones(600, bool),
    )
    return PlacedCloud(cloud=cloud, up=up, rotation=rotation, origin=np.array(origin, float))


def loaded(content: bytes) -> trimesh.Scene:
    return trimesh.load(io.BytesIO(content), file_type="glb")


def welded(content: bytes) -> trimesh.Trimesh:
    """All primitives as one mesh, vertices of the same place as one."""
    whole = loaded(content).to_geometry()
    mesh = trimesh.Trimesh(np.round(whole.vertices, 5), whole.faces, process=False)
    mesh.merge_vertices()
    return mesh


def test_a_ball_becomes_a_closed_mesh_of_its_size_in_its_place_with_the_outside_outside():
    content, num_faces = mesh_of(ball_grid(), ball_cloud(), level=RADIUS)
    mesh = welded(content)
    assert len(mesh.faces) == num_faces
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.volume, 4 / 3 * np.pi * RADIUS**3, rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTRE, axis=1), RADIUS, atol=0.01)


@pytest.mark.parametrize("up", ["y", "z", "-x"])
def test_each_place_wears_the_material_of_the_points_there_whichever_way_is_up(tmp_path, up):
    (tmp_path / "a.glb").write_bytes(mesh_of(ball_grid(), ball_cloud(up), level=RADIUS)[0])
    parts = load_mesh(tmp_path / "a.glb").parts
    sides = {"right": False, "left": False}
    for part in parts:
        x = part.positions[part.faces].mean(axis=1)[:, 0] - CENTRE[0]
        if abs(x).max() > 0.5 * RADIUS:
            side = "right" if x.mean() > 0 else "left"
            sides[side] = True
            expected = (1.0, 0.0) if side == "right" else (0.25, 1.0)
            assert (part.material.roughness, part.material.metallic) == expected
    assert all(sides.values())
    mesh = loaded((tmp_path / "a.glb").read_bytes())
    for geometry in mesh.geometry.values():
        far = np.abs(geometry.vertices[:, 0] - CENTRE[0]) > 0.5 * RADIUS
        outward = ((geometry.vertices - CENTRE) * geometry.vertex_normals).sum(axis=1) / RADIUS
        assert outward[far].size == 0 or outward[far].min() > 0.9


def test_a_mesh_far_from_the_origin_keeps_its_precision():
    origin = (500_000.0, 4_000_000.0, 100.0)
    bounds = loaded(mesh_of(ball_grid(origin), ball_cloud(origin=origin), level=RADIUS)[0]).bounds
    np.testing.assert_allclose(bounds, np.array(origin) + CENTRE + [[-RADIUS] * 3, [RADIUS] * 3], atol=0.02)


def test_a_surface_at_the_edge_of_the_grid_is_closed():
    grid = DensityGrid(
        density=np.ones((5, 5, 5), np.float32), lowest=np.zeros(3), spacing=1.0, voxel=1.0, origin=np.zeros(3)
    )
    mesh = welded(mesh_of(grid, ball_cloud(), level=0.5)[0])
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [[-0.5] * 3, [4.5] * 3])


def test_fog_without_a_surface_is_refused():
    with pytest.raises(ValueError, match="no surface to write as a mesh: the density is at most 3.8.*, not 9"):
        mesh_of(ball_grid(), ball_cloud(), level=9.0)
