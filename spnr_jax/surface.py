"""The surface near a place, from the few points around it: where it lies, how it is turned, what it is made of.

    estimate    once per object: a plane through the neighbours of each point, and the points nearest to every cell of a
                grid whose cells grow with the distance between points
    describe    at each sample: the planes and materials of its cell's points, blended by their distance

A normal has no sign of its own: it is turned towards the viewer, which is where a visible surface faces.  Lengths are
in units of the points' own spacing, so that dense and sparse clouds look alike.  All of it is geometry, not learnt, and
has no gradient by the points.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.numerics import length
from spnr_jax.types import PointCloud, Surface, SurfaceSample
from spnr_jax.voxels import NEIGHBOURS, locate, row_of

PLANE_POINTS = 10  # of a plane, the point itself among them
SPACING_POINTS = 4  # nearest others whose root mean square distance is a point's spacing
BLOCK = 1024  # points whose neighbours are searched at once
LEAST_SPACING = 1e-4  # in units of the box, for points that coincide
CELLS = 1.0  # along an axis of the grid, per square root of the number of points; 0.75 lost 0.1 dB
MOST_CELLS = 96
NEAR, FAR = 1e-6, 10.0  # spacings, the smallest and the largest distance to a point that is told


def grid_resolution(num_points: int) -> int:
    """Cells along each axis of the grid for so many points; a surface's points lie in the order of its square."""
    return min(max(round(CELLS * num_points**0.5), 1), MOST_CELLS)


def neighbours(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"], count: int
) -> tuple[Int[Array, "points count"], Float[Array, "points count"]]:
    """The nearest real points of each point, itself first, and their squared distances; inf where there is none."""
    num_points = len(positions)
    block = min(BLOCK, num_points)
    padded = jnp.pad(positions, ((0, -num_points % block), (0, 0)))

    def nearest(places):
        squared = sum((places[:, None, i] - positions[None, :, i]) ** 2 for i in range(3))
        closeness, index = jax.lax.top_k(-jnp.where(mask, squared, jnp.inf), min(count, num_points))
        return index, -closeness

    index, squared = jax.lax.map(nearest, padded.reshape(-1, block, 3))
    index, squared = (x.reshape(-1, x.shape[-1])[:num_points] for x in (index, squared))
    return index, squared


def planes(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"]
) -> tuple[Float[Array, "points 3"], Float[Array, " points"]]:
    """Unit normal, of either sign, of the plane through the neighbours of each point, and the point's spacing.

    The normal is the direction in which the neighbours spread least (Hoppe et al. 1992).
    """
    index, squared = neighbours(positions, mask, PLANE_POINTS)
    found = jnp.isfinite(squared)
    weight = (found / jnp.maximum(jnp.sum(found, axis=1, keepdims=True), 1))[..., None]
    around = positions[index]
    spread = around - jnp.sum(weight * around, axis=1, keepdims=True)
    covariance = jnp.einsum("pki,pkj->pij", weight * spread, spread, precision="highest")
    scale = jnp.maximum(jnp.trace(covariance, axis1=1, axis2=2), LEAST_SPACING**2)
    normals = jnp.linalg.eigh(covariance / scale[:, None, None])[1][..., 0]
    others = slice(1, 1 + SPACING_POINTS)
    few = jnp.maximum(jnp.sum(found[:, others], axis=1), 1)
    spacing = jnp.sqrt(jnp.sum(jnp.where(found, squared, 0)[:, others], axis=1) / few)
    return normals, jnp.maximum(spacing, LEAST_SPACING)


def nearest_by_cell(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"], resolution: int, count: int
) -> Int[Array, "g g g count"]:
    """The points nearest to the centre of each cell, the nearest first, of those in it and in the 26 cells around it.

    Number `points` stands for no point.  Each point is entered at all cells that it may be near to; sorted by cell and
    distance, the first entries of a cell are its nearest.
    """
    num_points = len(positions)
    cell, offset = locate(positions, resolution)
    steps = jnp.array([NEIGHBOURS], jnp.int32)
    target = cell[:, None] + steps
    counts = mask & jnp.all(jnp.abs(positions) <= 1, axis=-1)
    counts = counts[:, None] & jnp.all((target >= 0) & (target < resolution), axis=-1)
    rows = row_of(target, counts, resolution).reshape(-1)
    away = jnp.sum((offset[:, None] - steps.astype(offset.dtype)) ** 2, axis=-1).reshape(-1)
    point = jnp.broadcast_to(jnp.arange(num_points, dtype=jnp.int32)[:, None], target.shape[:2]).reshape(-1)
    rows, _, point = jax.lax.sort((rows, away, point), num_keys=2)
    place = jnp.arange(len(rows), dtype=jnp.int32)
    first = jnp.full(resolution**3 + 1, len(rows), jnp.int32).at[rows].min(place, indices_are_sorted=True)
    table = jnp.full((resolution**3 + 1, count), num_points, jnp.int32)
    table = table.at[rows, place - first[rows]].set(point, mode="drop", unique_indices=True)
    return table[:-1].reshape(*[resolution] * 3, count)


def estimate(cloud: PointCloud, count: int) -> Surface:
    """The surface around the points of each cloud (objects, points, ...), `count` points at each cell."""

    def one(cloud: PointCloud) -> Surface:
        positions, mask = jnp.asarray(cloud.positions), jnp.asarray(cloud.mask)
        normals, spacing = planes(positions, mask)
        numbers = (positions, normals, cloud.base_color, cloud.roughness, cloud.metallic, spacing)
        rows = jnp.concatenate([x.reshape(len(spacing), -1) for x in numbers], axis=1)
        rows = jnp.where(mask[:, None], rows, 0)
        nearest = nearest_by_cell(positions, mask, grid_resolution(len(spacing)), count)
        return Surface(points=jnp.pad(rows, ((0, 1), (0, 0))), nearest=nearest)

    return jax.lax.stop_gradient(jax.vmap(one)(jax.tree.map(jnp.asarray, cloud)))


def describe(
    surface: Surface,
    positions: Float[Array, "samples 3"],
    directions: Float[Array, "samples 3"],
    objects: Int[Array, " samples"],
) -> SurfaceSample:
    """What the points near each sample say of the surface there, seen along unit directions.

    `objects` says to which of the surface's objects each sample belongs.  A point weighs exp(-d^2 / 2), d its distance
    in its own spacings.
    """
    num_points, resolution, count = surface.points.shape[1], surface.nearest.shape[1], surface.nearest.shape[-1]
    cell, _ = locate(positions, resolution)
    rows = row_of(cell, jnp.ones(len(cell), bool), resolution) + objects * resolution**3
    index = (surface.nearest.reshape(-1, count)[rows] + (objects * num_points)[:, None]).T
    # numbers of one kind lie side by side, (count, samples): a CPU works on eight samples at a time
    columns = surface.points.reshape(-1, surface.points.shape[-1]).T
    *numbers, spacing = (column[index] for column in columns)
    position, normal, (red, green, blue, roughness, metallic) = numbers[:3], numbers[3:6], numbers[6:]
    exists = spacing > 0
    scale = jnp.where(exists, 1 / jnp.where(exists, spacing, 1), 0)
    offset = [(positions[None, :, i] - position[i]) * scale for i in range(3)]
    squared = jnp.where(exists, sum(o**2 for o in offset), jnp.inf)
    closest = jnp.min(squared, axis=0, keepdims=True)
    share = jnp.where(exists, jnp.exp(-0.5 * (squared - jnp.where(jnp.isfinite(closest), closest, 0))), 0)
    share = share / jnp.maximum(jnp.sum(share, axis=0, keepdims=True), 1)
    turned = jnp.where(sum(n * directions[None, :, i] for i, n in enumerate(normal)) < 0, share, -share)

    def blend(*parts):
        return jnp.stack([jnp.sum(share * x, axis=0) for x in parts], axis=-1)

    return SurfaceSample(
        exists=exists[0],
        height=jnp.sum(turned * sum(n * o for n, o in zip(normal, offset, strict=True)), axis=0),
        beside=length(blend(*offset)),
        nearest=jnp.sqrt(jnp.clip(closest[0], NEAR**2, FAR**2)),
        spacing=blend(spacing)[:, 0],
        normal=jnp.stack([jnp.sum(turned * n, axis=0) for n in normal], axis=-1),
        base_color=blend(red, green, blue),
        roughness=blend(roughness)[:, 0],
        metallic=blend(metallic)[:, 0],
    )
