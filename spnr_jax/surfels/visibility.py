"""Visibility of points from fixed directions, by orthographic depth buffers of the points themselves.

From each of 64 directions the points are drawn into a grid whose cells are CELL spacings wide, every point into the
four cells around it, at the depth that its plane has in the middle of the cell.  A point is seen where, lifted off the
surface by a spacing, it lies before what the grid holds, both where its plane meets the middle of its cell.  So no
plane hides itself at whatever angle, and one pass over the points gives the side that a surface shows, ambient
occlusion, and the share of any light that arrives.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

NUM_DIRECTIONS = 64
CELL = 1.5  # spacings
STEEPEST = 8.0  # slope of a plane against the direction, at most
REACH = 1.6  # spacings that a disc reaches: in a cell beyond that it counts at its point's own depth
SOFT = 1.0  # spacings behind the depth buffer over which a point passes from seen to hidden
COARSEST, FINEST = 256, 1024  # cells along the box at least and at most
BOX = 2.2  # side of the square that every direction draws: the box's diagonal is 2


def spiral(count: int) -> Float[np.ndarray, "count 3"]:
    """Unit directions spread evenly over the sphere (a Fibonacci spiral)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1).astype(np.float32)


def tangents(normals: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Two unit vectors at right angles to each unit normal and to each other (Duff et al. 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x**2 * a, sign * b, -sign * x], axis=-1)
    second = np.stack([b, sign + y**2 * a, -y], axis=-1)
    return first.astype(np.float32), second.astype(np.float32)


DIRECTIONS = spiral(NUM_DIRECTIONS)


def grid_of(count: int) -> int:
    """Cells along the depth buffers of so many points: their width follows the spacing where that covers the box."""
    return int(min(max(16 * -(-(4 * count**0.5) // 16), COARSEST), FINEST))


def cell_of(spacing: Float[Array, ""], grid: int) -> Float[Array, ""]:
    """Width of a cell, from the median spacing."""
    return jnp.maximum(CELL * spacing, BOX / grid)


def seen_from(
    positions: Float[Array, "3 points"],
    normals: Float[Array, "3 points"],
    spacing: Float[Array, " points"],
    mask: Bool[Array, " points"],
    cell: Float[Array, ""],
    *,
    grid: int,
) -> Float[Array, "64 points"]:
    """How much each of DIRECTIONS sees of each point: 1 in front, 0 from two spacings behind the depth buffer on.

    A constant to gradients: a depth buffer jumps where one point passes before another.  The sign of a normal does not
    matter.
    """
    positions, normals, spacing, cell = jax.lax.stop_gradient((positions, normals, spacing, cell))
    x, y, z = positions

    def along(axis, vectors):
        return vectors[0] * axis[0] + vectors[1] * axis[1] + vectors[2] * axis[2]

    def number_of(column, row):
        return jnp.clip(row, 0, grid - 1) * grid + jnp.clip(column, 0, grid - 1)

    def beside(column, row, right, up, slopes):
        """How much nearer a plane through (right, up), in cells, is in the middle of a cell."""
        return cell * ((column + 0.5 - right) * slopes[0] + (row + 0.5 - up) * slopes[1])

    def look(axes):
        towards, right, up = axes
        facing = along(towards, normals)
        steep = [-along(axis, normals) * jnp.sign(facing) / jnp.maximum(jnp.abs(facing), 1e-3) for axis in (right, up)]
        slope = jnp.sqrt(steep[0] ** 2 + steep[1] ** 2)
        steep = [x * jnp.minimum(1, STEEPEST / jnp.maximum(slope, 1e-3)) for x in steep]
        across, high = (along(axis, (x, y, z)) / cell + grid / 2 for axis in (right, up))
        column, row = (jnp.floor(v - 0.5).astype(jnp.int32) for v in (across, high))
        depth = along(towards, (x, y, z))
        most = REACH * spacing * jnp.sqrt(jnp.clip(1 - facing**2, 0, 1))
        nearest = jnp.full(grid * grid, -2 * BOX, depth.dtype)
        for j, i in ((0, 0), (0, 1), (1, 0), (1, 1)):
            nearer = beside(column + i, row + j, across, high, steep)
            there = depth + jnp.where(nearer < most, nearer, 0)
            index = jnp.where(mask, number_of(column + i, row + j), grid * grid)
            nearest = nearest.at[index].max(there, mode="drop")
        lift = jnp.sign(facing) * spacing
        lifted = [p + lift * n for p, n in zip((x, y, z), normals, strict=True)]
        across, high = (along(axis, lifted) / cell + grid / 2 for axis in (right, up))
        column, row = (jnp.floor(v).astype(jnp.int32) for v in (across, high))
        there = along(towards, lifted) + beside(column, row, across, high, steep)
        behind = (nearest[number_of(column, row)] - there) / jnp.maximum(spacing, cell / CELL)
        return jnp.clip(1 - behind / SOFT, 0, 1)

    axes = (jnp.asarray(axis, positions.dtype) for axis in (DIRECTIONS, *tangents(DIRECTIONS)))
    return jax.lax.map(look, tuple(axes))
