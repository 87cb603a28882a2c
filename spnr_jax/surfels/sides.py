"""Which side of a surface is outside: visibility from fixed directions, votes of these and of opposite walls.

For each of 64 directions, the points are drawn into an orthographic depth buffer whose cells are CELL spacings wide:
each point into the four cells around it, at the depth of its plane at the cell's centre.  A point is visible if, lifted
off the surface by one spacing, it lies in front of the buffer.  Both depths are taken at the cell's centre, so a plane
does not hide itself at any angle.  Visibility also gives ambient occlusion and the share of light that arrives.

Votes are pure functions of a block of points, the last axis.  A *lean* is a signed vote: positive if the normal points
outward.  Votes flip a normal or keep it, and have no gradient.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from spnr_jax.kernels.numerics import clamp, dot, total
from spnr_jax.surfels.layers import Hood, Layer, Rules, along, weigh_height, weigh_near

# --- visibility -------------------------------------------------------------------------------------------------------


NUM_DIRECTIONS = 64
CELL = 1.5  # width of a cell, in spacings
STEEPEST = 8.0  # largest slope of a plane relative to the direction
REACH = 1.6  # radius of a disc, in spacings: in cells beyond it, a point counts at its own depth
SOFT = 1.0  # spacings behind the depth buffer over which visibility falls to 0
COARSEST, FINEST = 256, 1024  # least and largest number of cells along a side
BOX = 2.2  # side of the square that each buffer covers: the box's diagonal is 2


def spiral(count: int) -> Float[np.ndarray, "count 3"]:
    """Unit directions spread evenly over the sphere (a Fibonacci spiral)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1).astype(np.float32)


def tangents(normals: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Two unit vectors orthogonal to each unit normal and to each other (Duff et al. 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x**2 * a, sign * b, -sign * x], axis=-1)
    second = np.stack([b, sign + y**2 * a, -y], axis=-1)
    return first.astype(np.float32), second.astype(np.float32)


DIRECTIONS = spiral(NUM_DIRECTIONS)


def grid_of(count: int) -> int:
    """Cells along a side of the depth buffers for so many points: CELL spacings wide, if that covers the box."""
    return int(min(max(16 * -(-(4 * count**0.5) // 16), COARSEST), FINEST))


def cell_of(spacing: Float[Array, ""], grid: int) -> Float[Array, ""]:
    """Width of a cell, from the median spacing."""
    return jnp.maximum(CELL * spacing, BOX / grid)


def see_directions(
    positions: Float[Array, "3 points"],
    normals: Float[Array, "3 points"],
    spacing: Float[Array, " points"],
    mask: Bool[Array, " points"],
    cell: Float[Array, ""],
    *,
    grid: int,
) -> Float[Array, "64 points"]:
    """Visibility of each point from each of DIRECTIONS: 1 in front, 0 from two spacings behind the depth buffer on.

    Constant for gradients, because a depth buffer jumps where one point passes in front of another.  The sign of a
    normal does not matter.
    """
    positions, normals, spacing, cell = jax.lax.stop_gradient((positions, normals, spacing, cell))

    def number_of(column, row):
        return jnp.clip(row, 0, grid - 1) * grid + jnp.clip(column, 0, grid - 1)

    def beside(column, row, right, up, slopes):
        """How much nearer a plane through (right, up), in cells, is at the centre of a cell."""
        return cell * ((column + 0.5 - right) * slopes[0] + (row + 0.5 - up) * slopes[1])

    def look(axes):
        towards, right, up = axes
        facing = dot(towards, normals)
        steep = [-dot(axis, normals) * jnp.sign(facing) / jnp.maximum(jnp.abs(facing), 1e-3) for axis in (right, up)]
        slope = jnp.sqrt(steep[0] ** 2 + steep[1] ** 2)
        steep = [x * jnp.minimum(1, STEEPEST / jnp.maximum(slope, 1e-3)) for x in steep]
        across, high = (dot(axis, positions) / cell + grid / 2 for axis in (right, up))
        column, row = (jnp.floor(v - 0.5).astype(jnp.int32) for v in (across, high))
        depth = dot(towards, positions)
        most = REACH * spacing * jnp.sqrt(jnp.clip(1 - facing**2, 0, 1))
        nearest = jnp.full(grid * grid, -2 * BOX, depth.dtype)
        for j, i in ((0, 0), (0, 1), (1, 0), (1, 1)):
            nearer = beside(column + i, row + j, across, high, steep)
            there = depth + jnp.where(nearer < most, nearer, 0)
            index = jnp.where(mask, number_of(column + i, row + j), grid * grid)
            nearest = nearest.at[index].max(there, mode="drop")
        lifted = positions + (jnp.sign(facing) * spacing)[None] * normals
        across, high = (dot(axis, lifted) / cell + grid / 2 for axis in (right, up))
        column, row = (jnp.floor(v).astype(jnp.int32) for v in (across, high))
        there = dot(towards, lifted) + beside(column, row, across, high, steep)
        behind = (nearest[number_of(column, row)] - there) / jnp.maximum(spacing, cell / CELL)
        return jnp.clip(1 - behind / SOFT, 0, 1)

    axes = (jnp.asarray(axis, positions.dtype) for axis in (DIRECTIONS, *tangents(DIRECTIONS)))
    return jax.lax.map(look, tuple(axes))


# --- votes ------------------------------------------------------------------------------------------------------------


def count_facing(
    normal: Float[Array, "3 points"], seen: Float[Array, "64 points"]
) -> tuple[Float[Array, " points"], Float[Array, " points"]]:
    """Visibility summed over directions in front of each point, weighted by the cosine with its normal; and behind."""

    def add(sums: tuple[Array, Array], one: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        counted = one[1] * dot(one[0], normal)
        return (sums[0] + jnp.maximum(counted, 0), sums[1] - jnp.minimum(counted, 0)), None

    zeros = jnp.zeros_like(normal[0])
    return jax.lax.scan(add, (zeros, zeros), (jnp.asarray(DIRECTIONS, normal.dtype), seen))[0]


def share_votes(
    hood: Hood,
    layer: Layer,
    spacing: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    leans: Float[Array, "k block"],
    rules: Rules,
) -> Float[Array, " block"]:
    """Mean lean of each point and its neighbors on the same layer; opposite normals count with the opposite sign."""
    cosine = along(normals, layer.normal)
    weight = weigh_near(hood, spacing, rules) * weigh_height(layer) * cosine**2
    return total(weight * jnp.sign(cosine) * leans) / jnp.maximum(total(weight), 1e-6)


def vote_of_walls(
    hood: Hood,
    layer: Layer,
    spacing: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    given: Bool[Array, " block"],
    rules: Rules,
) -> Float[Array, " block"]:
    """A lean from a parallel layer too close to be visible in between: the sides of a wall face away from each other.

    A layer just below another, as under a sticker, is taken for a wall's inner side; given normals tell them apart.
    """
    cosine = along(normals, layer.normal)
    other = jnp.where(given[None], -cosine, jnp.abs(cosine)) > rules.parallel
    wall = weigh_near(hood, spacing, rules) * other * (jnp.abs(layer.height) < rules.wall)
    thin = given & (layer.scale <= rules.scales[0])
    scale = jnp.where(thin, rules.sheet_scale, layer.scale)
    outward = layer.height / scale[None]
    above, below = total(wall * (outward > rules.apart)), total(wall * (outward < -rules.apart))
    return rules.wall_vote * (below - above) / (above + below + rules.evidence)


def turn_outward(
    normal: Float[Array, "3 block"],
    towards: Float[Array, " block"],
    given: Bool[Array, " block"],
    rules: Rules,
) -> tuple[Float[Array, "3 block"], Float[Array, " block"]]:
    """Normals that point outward, and `sided`: near 1 where the votes decide which side that is, 0 where they do not.

    Given normals are oriented; they are flipped only where the votes are clear.
    """
    begin, end = rules.sure_side
    sided = clamp((jnp.abs(towards) - begin) / (end - begin), 0, 1 - rules.leak)
    wrong = towards < jnp.where(given, -rules.turn, 0)
    return jnp.where(wrong[None], -normal, normal), jax.lax.stop_gradient(sided)
