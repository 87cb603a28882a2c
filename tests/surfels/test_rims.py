"""Gaps between random points, beside SciPy's Voronoi diagram; what is no gap stays as it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import Delaunay
from support.surfel_clouds import estimate, even_square

from spnr_jax.surfels import discs
from spnr_jax.surfels.neighbors import nearest
from spnr_jax.surfels.rules import RULES


def widened(points):
    """How much wider the discs of points (n, 2) of a plane are than a spacing, and the spacing."""
    spacing = np.full(len(points), 1 / np.sqrt(len(points)), np.float32)
    near = nearest(np.pad(points, ((0, 0), (0, 1)))).T
    place = np.float32(((points[near] - points[None]) / spacing[0]).transpose(0, 2, 1))
    bridge = jax.jit(discs.bridge_gaps, static_argnums=2)
    return np.asarray(bridge(jnp.asarray(place), jnp.ones(near.shape), RULES)), spacing


def gaps(points, spacing):
    """Radii in spacings of the largest empty circle through each point, by the Delaunay triangulation."""
    corners = Delaunay(points).simplices
    a, b, c = (points[corners[:, i]] for i in range(3))
    sides = [np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (b, c), (c, a))]
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    radius = np.prod(sides, axis=0) / (4 * area)
    largest = np.zeros(len(points))
    np.maximum.at(largest, corners.ravel(), np.repeat(radius, 3))
    return largest / spacing


def test_discs_beside_a_gap_are_as_wide_as_the_voronoi_diagram_has_it():
    points = np.random.default_rng(0).random((3000, 2))
    found, spacing = widened(points)
    inner = (np.abs(points - 0.5) < 0.4).all(axis=1)
    radius = gaps(points, spacing)
    inner &= radius < 1.6  # of wider ones the far side is not among the neighbours
    expected = np.maximum(radius / RULES.bridged, 1)
    ratio = (found / expected)[inner]
    # 16 directions miss a vertex by 11 degrees at most; some gaps are wider than the 20 neighbours reach
    low, high = np.quantile(ratio, [0.02, 0.97])
    assert low > 0.75
    assert high < 1.001
    np.testing.assert_allclose(ratio.mean(), 0.97, atol=0.02)


def test_where_the_surface_ends_nothing_grows_without_limit():
    found, _ = widened(np.random.default_rng(1).random((3000, 2)))
    assert found.max() <= RULES.widest_gap / RULES.bridged + 1e-6


@pytest.mark.parametrize("count", [400, 4096])
def test_even_points_are_told_from_random_ones_and_keep_the_holes_of_their_surface(count):
    square = np.pad(even_square(count), ((0, 0), (0, 1)))
    hole = np.linalg.norm(square, axis=1) < 4 / np.sqrt(count)  # two spacings

    def spacing(positions):
        return estimate(positions).spacing

    whole, pierced = spacing(square), spacing(square[~hole])
    np.testing.assert_allclose(pierced.max(), whole.max(), rtol=0.15)
    random = np.random.default_rng(2).random((count, 3)) * [1, 1, 0]
    assert np.ptp(np.log(spacing(random))) > np.log(1.5)
