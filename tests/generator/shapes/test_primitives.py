"""Laws of the part builders: closed, facing outward, of the volume and area that geometry gives them."""

import numpy as np
import pytest
from support.handmade import enclosed_volume

from data_gen.procedural import planes
from data_gen.shapes import primitives
from data_gen.shapes.primitives import circle, curve, rounded_rectangle, superellipse

BENT = np.column_stack([np.zeros(9), np.linspace(0, 1, 9), 0.2 * np.sin(np.linspace(0, 3, 9))])
SHEET = np.stack([*np.meshgrid(np.linspace(-1, 1, 5), np.linspace(0, 1, 4)), np.zeros((4, 5))], axis=-1)
CLOSED = {
    "box": lambda: primitives.box((1, 2, 3)),
    "bevelled box": lambda: primitives.box((0.3, 0.2, 0.1), 0.02),
    "rounded box": lambda: primitives.box((0.3, 0.2, 0.5), 0.05, 3),
    "prism": lambda: primitives.prism(superellipse(20, 0.4, (1, 2)), 0.5, 0.1),
    "lathe": lambda: primitives.lathe([(0.2, 0), (0.5, 0.3), (0.0, 1.0)]),
    "ring": lambda: primitives.lathe([(1, 0), (1.2, 0), (1.2, 0.3), (1, 0.3)], closed=True),
    "cylinder": lambda: primitives.cylinder(0.4, 2.0, 16, 0.05),
    "tube": lambda: primitives.tube(BENT, 0.1),
    "superellipsoid": lambda: primitives.superellipsoid((1, 2, 3), 0.4, 0.3),
    "shell": lambda: primitives.shell(SHEET + [0, 0, 0.1] * SHEET[..., :1] ** 2, 0.1),
    "moulding": lambda: primitives.moulding(1.0, 0.7, [(0, 0), (0.1, 0), (0.1, 0.02), (0, 0.05)]),
    "wing": lambda: planes.surface((0, 0, 0.1), (0.5, 0.05, 0), (0.2, 0.1), 0.13, sections=3),
    "turned and mirrored": lambda: primitives.mirror(primitives.turn(primitives.lathe([(0.2, 0), (0.1, 1)]), "x", 40)),
}


def volume(mesh):
    return enclosed_volume(mesh.positions, mesh.faces)


def face_area_vectors(positions, faces):
    """(f, 3) half cross products."""
    a, b, c = positions[faces.T]
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("name", CLOSED)
def test_closed_builders_have_each_edge_once_in_each_direction_and_faces_and_normals_look_outwards(name):
    mesh = CLOSED[name]()
    _, place = np.unique(mesh.positions.round(7) + 0.0, axis=0, return_inverse=True)
    faces = place.reshape(-1)[mesh.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(edge) for edge in edges} == {tuple(edge) for edge in edges[:, ::-1]}
    area = face_area_vectors(mesh.positions, mesh.faces)
    assert volume(mesh) > 0
    assert np.linalg.norm(area, axis=1).min() > 1e-9
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-9)
    assert np.einsum("fk,fck->fc", area, mesh.normals[mesh.faces]).min() > 0


def test_volumes_are_those_of_the_closed_forms():
    polygon = 24 / 2 * np.sin(2 * np.pi / 24)  # area of the 24-gon in the unit circle
    assert volume(primitives.box((1, 2, 3))) == pytest.approx(6)
    assert volume(primitives.cylinder(0.5, 2.0)) == pytest.approx(polygon * 0.25 * 2)
    assert volume(primitives.lathe([(1, 0), (0, 3)])) == pytest.approx(polygon)
    assert volume(primitives.lathe([(1, 0), (2, 0), (2, 1), (1, 1)], closed=True)) == pytest.approx(3 * polygon)
    assert volume(primitives.tube([(0, 0, 0), (1, 2, 2)], 0.1, segments=24)) == pytest.approx(polygon * 0.01 * 3)
    assert volume(primitives.shell(SHEET, 0.25)) == pytest.approx(2 * 0.25)
    assert volume(primitives.prism(rounded_rectangle(2, 1), 0.5)) == pytest.approx(1)
    frame = primitives.moulding(1.0, 0.7, [(0, 0), (0.1, 0), (0.1, 0.05), (0, 0.05)])
    assert volume(frame) == pytest.approx((1.2 * 0.9 - 1.0 * 0.7) * 0.05)
    fine = primitives.superellipsoid((2, 4, 6), 1, 1, rows=64, segments=96)
    assert volume(fine) == pytest.approx(4 / 3 * np.pi * 6, rel=3e-3)


def test_smooth_sides_get_radial_normals_and_hard_edges_stay_hard():
    mesh = primitives.cylinder(0.5, 2.0)
    flat = np.abs(mesh.normals[:, 1]) > 0.5
    np.testing.assert_allclose(np.abs(mesh.normals[flat, 1]), 1)
    radial = mesh.positions[~flat] * (2, 0, 2)
    np.testing.assert_allclose(mesh.normals[~flat], radial, atol=1e-9)
    np.testing.assert_allclose(np.abs(primitives.box((1, 2, 3)).normals).max(axis=1), 1)


@pytest.mark.parametrize(
    "mesh", [primitives.box((1, 2, 3)), primitives.cylinder(0.5, 2.0), primitives.prism(circle(12), 0.3)]
)
def test_texture_coordinates_of_flat_sides_keep_lengths(mesh):
    size = np.linalg.norm(face_area_vectors(mesh.positions, mesh.faces), axis=1)
    flat = np.column_stack([mesh.texcoords, np.zeros(len(mesh.texcoords))])
    np.testing.assert_allclose(np.linalg.norm(face_area_vectors(flat, mesh.faces), axis=1), size)


def test_tube_rings_stay_at_their_radius_from_the_path_and_square_to_it():
    path = curve([(0, 0, 0), (0, 1, 0), (1, 1.5, 0.5), (2, 1, 1)], 40)
    mesh = primitives.tube(path, 0.1, segments=8)
    nearest = np.linalg.norm(mesh.positions[:, None] - path, axis=-1).min(axis=1)
    caps = nearest < 1e-9  # their centres
    np.testing.assert_allclose(nearest[~caps], 0.1, atol=0.002)
    assert caps.sum() == 2


def test_smooth_normals_do_not_reach_from_one_open_end_of_a_sheet_to_the_other():
    angle = np.radians([0, 10, 20, 30])[:, None] + np.zeros(2)
    arc = np.stack([np.zeros_like(angle) + [0, 1], np.sin(angle), np.cos(angle)], axis=-1)
    mesh = primitives.patch(arc)
    end = np.isclose(mesh.positions[:, 1], 0)
    np.testing.assert_allclose(mesh.normals[end], np.tile([0, np.sin(np.radians(5)), np.cos(np.radians(5))], (2, 1)))


def test_turn_is_counter_clockwise_seen_from_the_positive_end_of_the_axis():
    mesh = primitives.Mesh(np.eye(3), np.array([[0, 1, 2]]), np.eye(3), np.zeros((3, 2)))
    np.testing.assert_allclose(primitives.turn(mesh, "y", 90).positions, [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(primitives.turn(mesh, "x", 90).normals, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
