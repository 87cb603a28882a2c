"""Triangles of polygons and strips beside plain loops, and normals where a texture says nothing."""

import numpy as np
import pytest

from spnr_jax.kernels.triangles import face_crosses, strip_faces, tilt_normals, triangulate


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_triangles_of_a_polygon_have_its_area_and_sense_wherever_it_begins_and_however_it_lies(axis):
    corners = np.array([(0, 0, 0), (2, 0, 0), (2, 0.5, 0), (0.5, 0.5, 0), (0.5, 2, 0), (0, 2, 0)])
    for roll in range(6):
        for sense in (1, -1):
            positions = np.roll(np.roll(corners, roll, axis=0)[::sense], axis, axis=1)
            faces, owner = triangulate(positions, np.arange(6), [6])
            crosses = sense * face_crosses(positions, faces)[:, (axis + 2) % 3]
            assert (crosses > 0).all()
            assert crosses.sum() == pytest.approx(2 * 1.75)
            assert owner.tolist() == [0] * 4


def test_strips_that_follow_one_another_begin_anew():
    strips = [[0, 1, 3, 2], [], [4, 5], [7, 6, 5], [1, 2, 3, 4, 5]]
    expected = []
    for strip in strips:
        for i in range(len(strip) - 2):
            a, b, c = strip[i : i + 3]
            expected.append((b, a, c) if i % 2 else (a, b, c))
    order = np.array([number for strip in strips for number in (*strip, -1)])
    assert list(map(tuple, strip_faces(order))) == expected
    assert strip_faces(order[:2]).shape == strip_faces(order[:0]).shape == (0, 3)


def test_where_the_coordinates_have_no_area_the_normal_stays():
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 3, float)
    texcoords = np.array([[[0, 0], [0, 0], [0, 0]], [[0, 0], [1, 1], [2, 2]], [[0, 0], [1, 0], [0, 1]]], float)
    normals = np.tile([0.0, 0, 1], (3, 1))
    found = tilt_normals(normals, np.array([(0.6, 0.0, 0.8)] * 2 + [(0, 0, 0)]), corners, texcoords)
    np.testing.assert_array_equal(found, normals)
