"""The surface near a place, from the few points around it: where it lies, how it is turned, what it is made of.

    estimate    once per object: the shape of each point's neighbourhood, and the points nearest to every cell of a grid
                whose cells grow with the distance between points
    describe    at each sample: the planes and materials of its cell's points, blended by their distance, and where the
                ray through the sample meets those planes

A normal has no sign of its own: it is turned towards the viewer, which is where a visible surface faces.  Lengths are
in units of the points' own spacing, so that dense and sparse clouds look alike.  All of it is geometry, not learnt, and
has no gradient by the points.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.config import MOST_CELLS
from spnr_jax.kernels.numerics import length
from spnr_jax.kernels.records import PointCloud, Surface, SurfaceSample
from spnr_jax.kernels.voxels import NEIGHBOURS, locate, row_of

PLANE_POINTS = 10  # of a plane, the point itself among them
SPACING_POINTS = 4  # nearest others whose root mean square distance is a point's spacing
ROW_BITS, DISTANCE_BITS = (MOST_CELLS**3).bit_length(), 31  # of a cell's number, of a float32 that is not negative
BLOCK = 1024  # points whose neighbours are searched at once
LEAST_SPACING = 1e-4  # in units of the box, for points that coincide
NEAR, FAR = 1e-6, 10.0  # spacings, the smallest and the largest distance that is told
LEAST_FACING = 0.05  # cosine of the angle between ray and normal below which a plane counts as seen from its edge
LEAST_RATIO = 1e-3  # of two extents


class Neighbourhoods(NamedTuple):
    """What the neighbours of each point say of the surface there; `Surface` says what the numbers mean."""

    normals: Float[Array, "points 3"]
    inward: Float[Array, "points 3"]
    ratios: Float[Array, "points 2"]
    spacing: Float[Array, " points"]


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


def neighbourhoods(positions: Float[Array, "points 3"], mask: Bool[Array, " points"]) -> Neighbourhoods:
    """The shape of each point's neighbourhood.

    Its normal, of either sign, is the direction in which the neighbours spread least (Hoppe et al. 1992); at a rim the
    way to their middle leads inwards.
    """
    index, squared = neighbours(positions, mask, PLANE_POINTS)
    found = jnp.isfinite(squared)
    weight = (found / jnp.maximum(jnp.sum(found, axis=1, keepdims=True), 1))[..., None]
    around = positions[index]
    middle = jnp.sum(weight * around, axis=1)
    spread = around - middle[:, None]
    covariance = jnp.einsum("pki,pkj->pij", weight * spread, spread, precision="highest")
    scale = jnp.maximum(jnp.trace(covariance, axis1=1, axis2=2), LEAST_SPACING**2)
    variances, axes = jnp.linalg.eigh(covariance / scale[:, None, None])
    extents = jnp.sqrt(jnp.maximum(variances, 0) + LEAST_RATIO**2)
    others = slice(1, 1 + SPACING_POINTS)
    few = jnp.maximum(jnp.sum(found[:, others], axis=1), 1)
    spacing = jnp.sqrt(jnp.sum(jnp.where(found, squared, 0)[:, others], axis=1) / few)
    spacing = jnp.maximum(spacing, LEAST_SPACING)
    return Neighbourhoods(
        normals=axes[..., 0],
        inward=(middle - positions) / spacing[:, None],
        ratios=extents[:, :2] / extents[:, 1:],
        spacing=spacing,
    )


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
    rows, point = in_order(rows, away, point, num_points)
    place = jnp.arange(len(rows), dtype=jnp.int32)
    first = jnp.full(resolution**3 + 1, len(rows), jnp.int32).at[rows].min(place, indices_are_sorted=True)
    table = jnp.full((resolution**3 + 1, count), num_points, jnp.int32)
    table = table.at[rows, place - first[rows]].set(point, mode="drop", unique_indices=True)
    return table[:-1].reshape(*[resolution] * 3, count)


def in_order(
    rows: Int[Array, " entries"], away: Float[Array, " entries"], point: Int[Array, " entries"], num_points: int
) -> tuple[Int[Array, " entries"], Int[Array, " entries"]]:
    """Rows of cells and points, sorted by row, in it by distance, and at equal distance by point.

    All three make one number of 64 bits, which takes a CPU a ninth of the time of sorting three arrays.  Of more than
    8192 points the last bits of the distance are left out.
    """
    point_bits = max(num_points - 1, 1).bit_length()
    too_many = max(DISTANCE_BITS + point_bits - (64 - ROW_BITS), 0)
    with jax.enable_x64(True):
        distance = jax.lax.bitcast_convert_type(away.astype(jnp.float32), jnp.uint32)  # rises with what is not negative
        row, distance, number = (x.astype(jnp.uint64) for x in (rows, distance, point))
        key = row << (64 - ROW_BITS) | (distance >> too_many) << point_bits | number
        key = jax.lax.sort(key)
        return (key >> (64 - ROW_BITS)).astype(jnp.int32), (key & (2**point_bits - 1)).astype(jnp.int32)


def estimate(cloud: PointCloud, count: int, resolution: int) -> Surface:
    """The surface around the points of each cloud (objects, points, ...), `count` points at each cell of the grid."""

    def one(cloud: PointCloud) -> Surface:
        positions, mask = jnp.asarray(cloud.positions), jnp.asarray(cloud.mask)
        around = neighbourhoods(positions, mask)
        materials = (cloud.base_color, cloud.roughness, cloud.metallic)
        numbers = (positions, around.normals, *materials, around.inward, around.ratios, around.spacing)
        rows = jnp.concatenate([x.reshape(len(mask), -1) for x in numbers], axis=1)
        rows = jnp.where(mask[:, None], rows, 0)
        nearest = nearest_by_cell(positions, mask, resolution, count)
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
    *numbers, spacing = _of_nearest(surface, positions, objects)
    position, normal, (red, green, blue, roughness, metallic) = numbers[:3], numbers[3:6], numbers[6:11]
    inward, (flatness, narrowness) = numbers[11:14], numbers[14:]
    exists = spacing > 0
    scale = jnp.where(exists, 1 / jnp.where(exists, spacing, 1), 0)
    offset = [(positions[None, :, i] - position[i]) * scale for i in range(3)]
    squared = jnp.where(exists, _dot(offset, offset), jnp.inf)
    share, closest = _weights(squared, exists)
    view = [directions[None, :, i] for i in range(3)]
    along = _dot(normal, view)
    sign = jnp.where(along < 0, 1, -1)  # turns the normal to the viewer
    height = sign * _dot(normal, offset)
    turned = sign * share
    # where the ray meets each point's plane, and how far from the point
    ahead = jnp.clip(height / jnp.maximum(jnp.abs(along), LEAST_FACING), -FAR, FAR)
    passed = [o + ahead * d for o, d in zip(offset, view, strict=True)]
    missed = jnp.where(exists, jnp.minimum(_dot(passed, passed), FAR**2), FAR**2)
    met, least = _weights(missed, exists)

    def blend(*parts):
        return jnp.stack([jnp.sum(share * x, axis=0) for x in parts], axis=-1)

    return SurfaceSample(
        exists=exists[0],
        height=jnp.sum(share * height, axis=0),
        beside=length(blend(*offset)),
        nearest=jnp.sqrt(jnp.clip(closest[0], NEAR**2, FAR**2)),
        ahead=jnp.sum(met * ahead, axis=0),
        miss=jnp.sqrt(jnp.maximum(least[0], NEAR**2)),
        outside=-jnp.sum(share * _dot(inward, offset), axis=0),
        flatness=blend(flatness)[:, 0],
        narrowness=blend(narrowness)[:, 0],
        spacing=blend(spacing)[:, 0],
        normal=jnp.stack([jnp.sum(turned * n, axis=0) for n in normal], axis=-1),
        base_color=blend(red, green, blue),
        roughness=blend(roughness)[:, 0],
        metallic=blend(metallic)[:, 0],
    )


def _of_nearest(
    surface: Surface, positions: Float[Array, "samples 3"], objects: Int[Array, " samples"]
) -> list[Float[Array, "count samples"]]:
    """Each number of the points nearest to each sample; those of one kind lie side by side, as a CPU works on them."""
    num_points, resolution, count = surface.points.shape[1], surface.nearest.shape[1], surface.nearest.shape[-1]
    cell, _ = locate(positions, resolution)
    rows = row_of(cell, jnp.ones(len(cell), bool), resolution) + objects * resolution**3
    index = (surface.nearest.reshape(-1, count)[rows] + (objects * num_points)[:, None]).T
    return [column[index] for column in surface.points.reshape(-1, surface.points.shape[-1]).T]


def _weights(
    squared: Float[Array, "count samples"], exists: Bool[Array, "count samples"]
) -> tuple[Float[Array, "count samples"], Float[Array, "1 samples"]]:
    """Weights exp(-d^2 / 2) of the points that exist, of sum 1, and the least of the squared distances."""
    least = jnp.min(squared, axis=0, keepdims=True)
    weights = jnp.where(exists, jnp.exp(-0.5 * (squared - jnp.where(jnp.isfinite(least), least, 0))), 0)
    return weights / jnp.maximum(jnp.sum(weights, axis=0, keepdims=True), 1), least


def _dot(a, b):
    """Sum of the products of three numbers each."""
    return sum(x * y for x, y in zip(a, b, strict=True))
