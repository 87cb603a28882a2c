"""Borders of two colours: where they are found, where they are not, and how straight they are drawn."""

import numpy as np
import pytest
from support.surfel_clouds import estimate, shape

ACROSS, AT = np.array([0.8, 0.6]), 0.1
RED, BLUE = np.array([0.7, 0.1, 0.1]), np.array([0.1, 0.2, 0.6])


def parted(spread="even"):
    """Points of a plane, its axes, how far each point lies beyond a line in it, and the spacing."""
    positions, normals, spacing = shape("plane", 2000, spread)
    axes = np.linalg.svd(positions - positions.mean(axis=0))[2][:2]
    return positions, axes, positions @ axes.T @ ACROSS - AT, spacing


@pytest.mark.parametrize(("spread", "most"), [("even", 0.9), ("random", 0.75)])
def test_the_line_between_two_colours_is_found_beside_it_and_nowhere_else(spread, most):
    positions, axes, beyond, spacing = parted(spread)
    found = estimate(positions, np.where(beyond[:, None] > 0, BLUE, RED))
    inner = np.abs(positions @ axes.T).max(axis=1) < 0.5 * np.abs(positions @ axes.T).max()
    border, jump = found.border, found.jump
    has = np.abs(jump).max(axis=1) > 0.9 * np.abs(RED - BLUE).max()
    assert np.mean(has[inner & (np.abs(beyond) < 0.7 * spacing)]) > most
    assert not jump[inner & (np.abs(beyond) > 4 * spacing)].any()
    near = inner & has & (np.abs(beyond) < 0.7 * spacing)
    way = -np.sign(beyond[near])[:, None] * (ACROSS @ axes)
    assert np.median(np.sum(border[near, :3] * way, axis=1)) > 0.97
    assert np.median(np.abs(border[near, 3] - np.abs(beyond[near]))) < 0.2 * spacing
    np.testing.assert_allclose(jump[near], np.where(beyond[near, None] > 0, RED - BLUE, BLUE - RED), atol=0.06)
    alone = estimate(positions, np.tile(RED, (len(positions), 1)))
    assert np.abs(found.gradient[near]).max() * spacing < 0.2
    assert not alone.jump.any()


def test_one_colour_a_gradient_and_speckles_have_no_borders():
    positions, _, beyond, _ = parted()
    smooth = 0.5 + 0.4 * beyond[:, None] * [1.0, -1, 0.5]
    speckled = np.where(np.random.default_rng(0).uniform(size=(len(positions), 1)) < 0.4, BLUE, RED)
    steep = 0.6 + 0.3 * np.sin(10 * beyond)[:, None] * [1.0, -1, 1]
    for color, most in ((np.tile(RED, (len(positions), 1)), 0), (smooth, 0), (steep, 0), (speckled, 0.03)):
        jump = estimate(positions, color).jump
        assert np.mean(np.abs(jump).max(axis=1) > 0.1) <= most


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_points_have_finite_borders(count):
    colors = np.stack([RED, BLUE] * 3)[:count]
    found = estimate(np.linspace(-0.5, 0.5, count)[:, None] * [1.0, 0.3, 0.2], colors)
    for name in ("border", "jump"):
        assert np.isfinite(getattr(found, name)).all()
