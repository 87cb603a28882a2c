"""Which side of a surface is outside: visibility from fixed directions, votes of these and of thin walls.

For each of 64 directions, the points are drawn into an orthographic depth buffer whose cells are CELL spacings wide:
each point into the four cells around it, at the depth of its plane at the cell's centre.  A point is lifted off the
surface by its spacing h; with the depth of the lifted point, measured towards the viewer, its visibility is
clip(1 - (buffer - depth) / h, 0, 1).  Both depths are taken at the cell's centre, so a plane does not hide itself at
any angle.  Visibility also gives ambient occlusion and the share of light that arrives.

Votes are pure functions of a block of points, the last axis.  A vote is positive if the normal points outward.  Votes
flip a normal or keep it, and have no gradient.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.kernels.numerics import array_namespace, clamp, dot, sum_first, tangent_frame
from spnr_jax.surfels.constants import CONSTANTS
from spnr_jax.surfels.layers import Layer, Neighborhood, project_on, weigh_distance, weigh_height
from spnr_jax.surfels.splatting import RADIUS

# --- visibility -------------------------------------------------------------------------------------------------------


NUM_DIRECTIONS = 64
CELL = 1.5  # width of a cell, in spacings
STEEPEST = 8.0  # largest slope of a plane relative to the direction
COARSEST, FINEST = 256, 1024  # least and largest number of cells along a side
BOX = 2.2  # side of the square that each buffer covers: the box's diagonal is 2


def spiral(count: int) -> Float[np.ndarray, "count 3"]:
    """Unit directions spread evenly over the sphere (a Fibonacci spiral)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1).astype(np.float32)


DIRECTIONS = spiral(NUM_DIRECTIONS)


def choose_grid(count: int | Int[Array, ""]) -> Any:
    """Cells along a side of the depth buffers for so many points.

    4 sqrt(count) cells of CELL spacings cover the box if the surface has an area of 0.13 (4 pi: the sphere around it).
    """
    xp = array_namespace(count)
    return xp.clip(16 * xp.ceil(xp.sqrt(count) / 4), COARSEST, FINEST).astype(int)


def choose_cell(spacing: Float[Array, ""], count: Int[Array, ""]) -> Float[Array, ""]:
    """Width of a cell, from the median spacing and the number of points, padding not counted."""
    return jnp.maximum(CELL * spacing, BOX / choose_grid(count).astype(spacing.dtype))


def compute_visibility(
    positions: Float[Array, "3 points"],
    normals: Float[Array, "3 points"],
    spacing: Float[Array, " points"],
    mask: Bool[Array, " points"],
    cell: Float[Array, ""],
    *,
    grid: int,
) -> Float[Array, "64 points"]:
    """Visibility of each point from each of DIRECTIONS, by the formula at the top of this file.

    Constant for gradients, because a depth buffer jumps where one point passes in front of another.  The sign of a
    normal does not matter.
    """
    positions, normals, spacing, cell = jax.lax.stop_gradient((positions, normals, spacing, cell))

    def look(axes):
        towards, right, up = axes
        cosine = dot(towards, normals)
        slopes = [-dot(axis, normals) * jnp.sign(cosine) / jnp.maximum(jnp.abs(cosine), 1e-3) for axis in (right, up)]
        steepness = jnp.sqrt(slopes[0] ** 2 + slopes[1] ** 2)
        slopes = [x * jnp.minimum(1, STEEPEST / jnp.maximum(steepness, 1e-3)) for x in slopes]

        def locate(points):
            """Place of points in the picture, in cells from its middle, and their depth towards the viewer."""
            return (dot(right, points) / cell, dot(up, points) / cell), dot(towards, points)

        def depth_at(cells, place, depth):
            """Depth of the points' planes at the centres of cells."""
            steps = (c.astype(depth.dtype) + 0.5 - x for c, x in zip(cells, place, strict=True))
            return depth + cell * sum(step * slope for step, slope in zip(steps, slopes, strict=True))

        def number(cells):
            column, row = (jnp.clip(c + grid // 2, 0, grid - 1) for c in cells)
            return row * grid + column

        place, depth = locate(positions)
        first = [jnp.floor(x - 0.5).astype(jnp.int32) for x in place]
        nearest_edge = depth + RADIUS * spacing * jnp.sqrt(jnp.clip(1 - cosine**2, 0, 1))
        buffer = jnp.full(grid * grid, -2 * BOX, depth.dtype)  # behind everything
        for j, i in ((0, 0), (0, 1), (1, 0), (1, 1)):
            cells = [first[0] + i, first[1] + j]
            there = depth_at(cells, place, depth)
            there = jnp.where(there < nearest_edge, there, depth)  # the plane says nothing beyond the disc's edge
            buffer = buffer.at[jnp.where(mask, number(cells), grid * grid)].max(there, mode="drop")
        place, depth = locate(positions + (jnp.sign(cosine) * spacing)[None] * normals)
        cells = [jnp.floor(x).astype(jnp.int32) for x in place]
        behind = (buffer[number(cells)] - depth_at(cells, place, depth)) / jnp.maximum(spacing, cell / CELL)
        return jnp.clip(1 - behind, 0, 1)

    right, up, towards = jnp.moveaxis(tangent_frame(jnp.asarray(DIRECTIONS.T, positions.dtype)), 2, 1)
    return jax.lax.map(look, (towards, right, up))


# --- votes ------------------------------------------------------------------------------------------------------------


def sum_visibility(
    normal: Float[Array, "3 points"], visibility: Float[Array, "64 points"]
) -> tuple[Float[Array, " points"], Float[Array, " points"]]:
    """Visibility summed over directions in front of each point, weighted by the cosine with its normal; and behind."""

    def add(sums: tuple[Array, Array], one: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        counted = one[1] * dot(one[0], normal)
        return (sums[0] + jnp.maximum(counted, 0), sums[1] - jnp.minimum(counted, 0)), None

    zeros = jnp.zeros_like(normal[0])
    return jax.lax.scan(add, (zeros, zeros), (jnp.asarray(DIRECTIONS, normal.dtype), visibility))[0]


def average_votes(
    hood: Neighborhood,
    layer: Layer,
    spacing: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    votes: Float[Array, "k block"],
) -> Float[Array, " block"]:
    """Mean vote of each point and its neighbors on the same layer; opposite normals count with the opposite sign."""
    cosine = project_on(normals, layer.normal)
    weight = weigh_distance(hood, spacing) * weigh_height(layer) * cosine**2
    return sum_first(weight * jnp.sign(cosine) * votes) / jnp.maximum(sum_first(weight), 1e-6)


def vote_by_thin_walls(
    hood: Neighborhood,
    layer: Layer,
    spacing: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    oriented: Bool[Array, " block"],
) -> Float[Array, " block"]:
    """The vote of a parallel layer just behind: the two sides of a thin wall face away from each other.

    A layer just below another, as under a sticker, is taken for a thin wall's inner side; given normals tell them
    apart.
    """
    cosine = project_on(normals, layer.normal)
    other = jnp.where(oriented[None], -cosine, jnp.abs(cosine)) > CONSTANTS.parallel_cosine
    wall = jnp.where(other & (jnp.abs(layer.height) < CONSTANTS.thin_wall_height), weigh_distance(hood, spacing), 0)
    thin = oriented & (layer.thickness <= CONSTANTS.thickness_bounds[0])
    thickness = jnp.where(thin, CONSTANTS.split_thickness, layer.thickness)
    outward = layer.height / thickness[None]
    above, below = (
        sum_first(jnp.where(outward > CONSTANTS.other_layer, wall, 0)),
        sum_first(jnp.where(outward < -CONSTANTS.other_layer, wall, 0)),
    )
    return CONSTANTS.thin_wall_weight * (below - above) / (above + below + CONSTANTS.vote_ridge)


def orient_normals(
    normal: Float[Array, "3 block"],
    vote: Float[Array, " block"],
    oriented: Bool[Array, " block"],
) -> tuple[Float[Array, "3 block"], Float[Array, " block"]]:
    """Normals that point outward, and `one_sided`: near 1 where the votes decide which side that is, else 0.

    Given normals are oriented; they are flipped only where the votes are clear.
    """
    begin, end = CONSTANTS.orientation_ramp
    one_sided = clamp((jnp.abs(vote) - begin) / (end - begin), 0, 1 - CONSTANTS.back_weight)
    wrong = vote < jnp.where(oriented, -CONSTANTS.flip_vote, 0.0)
    return jnp.where(wrong[None], -normal, normal), jax.lax.stop_gradient(one_sided)
