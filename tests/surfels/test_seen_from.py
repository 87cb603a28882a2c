"""Which directions see a point: laws on simple bodies, and a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
from support.surfel_clouds import shape, tangents

from spnr_jax.surfels import sides
from spnr_jax.surfels.sides import DIRECTIONS, choose_cell, choose_grid, compute_visibility

GRID = 64
_seen_from = jax.jit(compute_visibility, static_argnames="grid")


def seen(positions, normals, spacing, mask=None):
    """`compute_visibility` of NumPy arrays with points equally far apart."""
    count = len(positions)
    arrays = (jnp.asarray(np.asarray(x, np.float32).T) for x in (positions, np.broadcast_to(normals, (count, 3))))
    mask = jnp.asarray(np.ones(count, bool) if mask is None else mask)
    cell = jnp.maximum(sides.CELL * jnp.float32(spacing), sides.BOX / GRID)
    return np.asarray(_seen_from(*arrays, jnp.full(count, spacing, jnp.float32), mask, cell, grid=GRID)).T


def loop(positions, normals, spacing):
    """The same in float64, cell by cell."""
    cell, grid = max(sides.CELL * spacing, sides.BOX / GRID), GRID
    out = np.zeros((len(positions), len(DIRECTIONS)))
    for d, axes in enumerate(zip(DIRECTIONS, *tangents(DIRECTIONS), strict=True)):
        towards, right, up = np.float64(axes)

        def in_the_middle(p, n, column, row, right=right, up=up, towards=towards):
            """How much nearer the plane through a point is in the middle of a cell."""
            slopes = np.array([-(n @ right), -(n @ up)]) / (np.sign(n @ towards) * max(abs(n @ towards), 1e-3))
            slopes *= min(1, sides.STEEPEST / max(np.hypot(*slopes), 1e-3))
            middle = cell * (np.array([column, row]) + 0.5 - grid / 2)
            return slopes @ (middle - [p @ right, p @ up])

        buffer = {}
        for p, n in zip(positions, normals, strict=True):
            column, row = (int(np.floor(p @ axis / cell + grid / 2 - 0.5)) for axis in (right, up))
            most = sides.RADIUS * spacing * np.sqrt(1 - (n @ towards) ** 2)
            for place in ((row + i, column + j) for i in (0, 1) for j in (0, 1)):
                nearer = in_the_middle(p, n, *place[::-1])
                depth = p @ towards + (nearer if nearer < most else 0)
                buffer[place] = max(buffer.get(place, -np.inf), depth)
        for i, (p, n) in enumerate(zip(positions, normals, strict=True)):
            lifted = p + np.sign(n @ towards) * spacing * n
            place = tuple(int(np.floor(lifted @ axis / cell + grid / 2)) for axis in (up, right))
            depth = lifted @ towards + in_the_middle(lifted, n, *place[::-1])
            out[i, d] = np.clip(1 - (buffer.get(place, -np.inf) - depth) / spacing, 0, 1)
    return out


def test_it_is_the_plain_loop_over_cells_but_for_rounding_at_their_borders():
    rng = np.random.default_rng(0)
    positions = rng.uniform(-0.6, 0.6, (60, 3))
    normals = rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    expected = loop(positions, normals, 0.15)
    assert np.mean(np.abs(seen(positions, normals, 0.15) - expected) > 1e-4) < 2e-3
    assert 0.2 < np.mean(expected) < 0.8


def test_padding_neither_hides_nor_is_in_the_way():
    rng = np.random.default_rng(0)
    positions = rng.uniform(-0.6, 0.6, (60, 3))
    mask = np.arange(60) < 40
    one, other = (seen(np.where(mask[:, None], positions, x), [0, 0.6, 0.8], 0.15, mask) for x in (positions, 0.0))
    np.testing.assert_array_equal(one[:40], other[:40])
    assert one[:40].min() < 0.5


def test_directions_outside_a_ball_see_the_side_turned_to_them_and_nothing_within():
    positions, normals, spacing = shape("sphere", 900)
    within = 0.3 * positions[::9]
    found = seen(np.concatenate([positions, within]), np.concatenate([normals, normals[::9]]), spacing)
    cosine = normals @ DIRECTIONS.T
    assert np.mean(found[: len(positions)][cosine > 0.3] < 0.99) < 5e-3
    assert found[: len(positions)][cosine > 0].mean() > 0.85  # of what is seen from the side a cell holds too few
    assert found[: len(positions)][cosine < -0.3].max() < 0.01
    assert found[len(positions) :].max() == 0


def test_a_plane_of_random_points_never_hides_itself_at_whatever_angle():
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    positions = np.stack([*rng.uniform(-0.7, 0.7, (2, 800)), np.zeros(800)], axis=1) @ turn
    cosine = turn[2] @ DIRECTIONS.T
    found = seen(positions, turn[2], 0.05)
    assert found[:, np.abs(cosine) > 0.13].min() > 0.99


def test_the_grid_covers_the_box_with_few_sizes_and_never_more_than_1024_cells():
    for count in 2 ** np.arange(25):
        grid = choose_grid(int(count))
        assert sides.COARSEST <= grid <= sides.FINEST
        assert grid % 16 == 0
        for spacing in np.geomspace(1e-7, 3.0, 20):
            cell = float(choose_cell(jnp.float32(spacing), jnp.asarray(int(count))))
            assert cell * grid >= sides.BOX * (1 - 1e-6)
            assert cell >= sides.CELL * spacing * (1 - 1e-6)
    assert choose_grid(16384) == 512
    assert choose_grid(2**24) == sides.FINEST
