"""Triangles of polygons and strips beside plain loops, and normals where a texture says nothing."""

import itertools

import numpy as np
import pytest

from spnr_jax.kernels.triangles import face_crosses, strip_faces, tilt_normals, triangulate


def around(radius) -> np.ndarray:
    """Corners (n, 2) at these distances from 0, one angle after the other."""
    angle = np.linspace(0, 2 * np.pi, len(radius), endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.asarray(radius)[:, None]


STAR = around([1, 0.4] * 5)
TIMES = np.random.default_rng(0).integers(1, 3, (9, 10))  # that each corner of a star is named
POLYGONS = {
    "an L": [(0, 0), (2, 0), (2, 0.5), (0.5, 0.5), (0.5, 2), (0, 2)],
    "a bridge to a hole": [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)],
    **{f"a star, corners named {times} times": np.repeat(STAR, times, axis=0) for times in TIMES},
    "many corners in waves": around(1 + 0.3 * np.cos(16 * np.linspace(0, 2 * np.pi, 240, endpoint=False))),
}


@pytest.mark.parametrize("name", POLYGONS)
def test_triangles_of_a_polygon_have_its_area_and_sense_wherever_it_begins_and_however_it_lies(name):
    """Then no triangle lies beside it or over another one."""
    corners = np.pad(np.array(POLYGONS[name], float), ((0, 0), (0, 1)))
    area = np.cross(corners, np.roll(corners, -1, axis=0))[:, 2].sum()
    for roll, sense in itertools.product(range(min(len(corners), 12)), (1, -1)):
        axis = roll % 3
        positions = np.roll(np.roll(corners, roll, axis=0)[::sense], axis, axis=1)
        faces, owner = triangulate(positions, np.arange(len(corners)), [len(corners)])
        crosses = sense * face_crosses(positions, faces)[:, (axis + 2) % 3]
        assert (crosses > -1e-12).all()
        assert crosses.sum() == pytest.approx(area)
        assert owner.tolist() == [0] * (len(corners) - 2)


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
