"""Points to volume and back: scatter by voxel, trilinear lookup.

A scatter is a sum: each point adds 1 / (points in its voxel) of its features to the voxel's mean (`spread`).

A volume covers the box [-1, 1]^3 with D voxels along each axis and is indexed (z, y, x, features); voxel i of an axis
covers [-1 + 2 i / D, -1 + 2 (i + 1) / D].  Positions are (x, y, z).  In grid coordinates, (position + 1) * D / 2, voxel
centres lie at i + 0.5.  Leading batch axes pair a volume with its positions.
"""

import itertools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.kernels.numerics import blend_rows, clamp, computed_once, gather_rows, scatter_rows

NEIGHBOURS = tuple((z, y, x) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1))


def locate(
    positions: Float[Array, "*batch 3"], resolution: int
) -> tuple[Int[Array, "*batch 3"], Float[Array, "*batch 3"]]:
    """Voxel (x, y, z) of each position, clamped to the grid, and the offset from its centre in voxels.

    A position on the far face of the box belongs to the last voxel.
    """
    cell = voxel_of(positions, resolution)
    return cell, (positions + 1) * (0.5 * resolution) - cell - 0.5


def voxel_of(positions: Float[Array, "*batch"], resolution: int) -> Int[Array, "*batch"]:
    """Number of the voxel along an axis, clamped to the grid, of each position along it in [-1, 1]."""
    cell = jnp.floor((positions + 1) * (0.5 * resolution))
    return jnp.clip(cell, 0, resolution - 1).astype(jnp.int32)


def row_of(cell: Int[Array, "*batch 3"], valid: Bool[Array, "*batch"], resolution: int) -> Int[Array, "*batch"]:
    """Row of each voxel in the flattened volume; what is not valid goes to the spare row resolution ** 3."""
    return jnp.where(valid, row_at(cell[..., 0], cell[..., 1], cell[..., 2], resolution), resolution**3)


def row_at(x: Int[Array, "*batch"], y: Int[Array, "*batch"], z: Int[Array, "*batch"], resolution: int):
    """Row of the voxel at x, y, z in the flattened volume, of their shape."""
    return (z * resolution + y) * resolution + x


def voxel_rows(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"], resolution: int
) -> tuple[Int[Array, " points"], Bool[Array, " points"]]:
    """Row of each point in the flattened volume, and whether it counts: not if masked or outside the box."""
    valid = mask & jnp.all(jnp.abs(positions) <= 1, axis=-1)
    return row_of(locate(positions, resolution)[0], valid, resolution), valid


def share_voxels(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"], resolution: int
) -> tuple[Int[Array, " points"], Float[Array, " points"]]:
    """Row of each point in the flattened volume, and 1 / (points in its voxel); 0 if masked or outside the box."""
    rows, valid = voxel_rows(positions, mask, resolution)
    ones = valid.astype(positions.dtype)
    count = gather_rows(scatter_rows(rows, ones[:, None], resolution**3 + 1), rows)[:, 0]
    return rows, ones / jnp.maximum(count, 1)


def occupied(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"], resolution: int
) -> Bool[Array, "d d d"]:
    """Whether each voxel holds a point; masked points and points outside the box do not count."""
    rows, _ = voxel_rows(positions, mask, resolution)
    return jnp.zeros(resolution**3 + 1, bool).at[rows].set(True)[:-1].reshape(*[resolution] * 3)


def spread(
    positions: Float[Array, "points 3"],
    features: Float[Array, "points features"],
    mask: Bool[Array, " points"],
    resolution: int,
) -> tuple[Int[Array, " points"], Float[Array, "points features+1"]]:
    """Rows of the flattened volume, and what each point adds there to the means of features and to occupancy."""
    rows, share = share_voxels(positions, mask, resolution)
    return rows, jnp.concatenate([features, jnp.ones_like(features[..., :1])], axis=-1) * share[:, None]


def scatter_mean(
    positions: Float[Array, "*batch points 3"],
    features: Float[Array, "*batch points features"],
    mask: Bool[Array, "*batch points"],
    resolution: int,
) -> tuple[Float[Array, "*batch d d d features"], Float[Array, "*batch d d d"]]:
    """Mean of the point features in each voxel (0 where there is none), and 1 where a voxel holds a point.

    Masked points and points outside the box are dropped.
    """
    if positions.ndim > 2:
        return jax.vmap(lambda p, f, m: scatter_mean(p, f, m, resolution))(positions, features, mask)
    rows, values = spread(positions, features, mask, resolution)
    summed = scatter_rows(rows, values, resolution**3 + 1)[:-1].reshape(*[resolution] * 3, -1)
    return summed[..., :-1], summed[..., -1]


def scatter_conv(
    rows: Int[Array, " points"],
    values: Float[Array, "points features"],
    kernel: Float[Array, "3 3 3 features out"],
    resolution: int,
) -> Float[Array, "d d d out"]:
    """3^3 convolution (zero padding) of the volume that `values` sum to, computed from the occupied voxels alone.

    The same map as convolving the scattered volume: each point adds its 27 products to the neighbours of its voxel.
    With 1024 points 3 % of a 32^3 grid is occupied.
    """
    products = jnp.einsum("pf,tfo->pto", values, kernel.reshape(27, *kernel.shape[3:]), precision="highest")
    # the output at voxel v reads voxel v + n through the tap of n: a point feeds the neighbours at minus n
    steps = -jnp.array([NEIGHBOURS], jnp.int32)
    cell = jnp.stack([rows // resolution**2, rows // resolution % resolution, rows % resolution], axis=-1)
    cell = cell[:, None] + steps
    valid = (rows < resolution**3)[:, None] & jnp.all((cell >= 0) & (cell < resolution), axis=-1)
    target = row_of(cell[..., ::-1], valid, resolution)
    volume = scatter_rows(target.reshape(-1), products.reshape(-1, products.shape[-1]), resolution**3 + 1)
    return volume[:-1].reshape(*[resolution] * 3, -1)


def trilinear(
    volume: Float[Array, "*objects d d d features"],
    positions: Float[Array, "*batch 3"],
    objects: Int[Array, "*batch"] | None = None,
) -> Float[Array, "*batch features"]:
    """Features between the eight nearest voxel centres; zero outside [-1, 1]^3.

    The first axes of the positions are the objects of the volume, unless `objects` gives each position's.  Within half
    a voxel of the border the lookup takes the outermost centres.
    """
    if volume.ndim > 4 and objects is None:
        return jax.vmap(trilinear)(volume, positions)
    resolution = volume.shape[-2]
    lowest, weights, steps = corners(positions, resolution)
    if objects is not None:
        lowest = lowest + objects.reshape(-1) * resolution**3
    out = blend_rows(volume.reshape(-1, volume.shape[-1]), lowest, computed_once(weights), steps)
    return out.reshape(*positions.shape[:-1], volume.shape[-1])


def corners(
    positions: Float[Array, "*batch 3"], resolution: int
) -> tuple[Int[Array, " n"], Float[Array, "n 8"], tuple[int, ...]]:
    """First row of the eight nearest voxel centres in the flattened volume, their weights, and the steps between them.

    Positions are flattened; weights sum to 1, and are 0 outside the box.
    """
    inside = jnp.all(jnp.abs(positions) <= 1, axis=-1)
    grid = clamp((positions + 1) * (0.5 * resolution) - 0.5, 0, resolution - 1)
    cell = jnp.clip(jnp.floor(grid), 0, max(resolution - 2, 0))
    upper = grid - jax.lax.stop_gradient(cell)
    # rows as a matrix product, for the reason that `computed_once` gives; exact in float32 up to 256^3 voxels
    strides = jnp.array([[1.0], [resolution], [resolution**2]])
    lowest = jnp.matmul(cell.reshape(-1, 3), strides, precision="highest").astype(jnp.int32)[:, 0]
    places = list(itertools.product((0, 1), repeat=3))
    x, y, z = (jnp.stack([1 - upper[..., axis], upper[..., axis]]) for axis in range(3))
    weights = jnp.stack([jnp.where(inside, x[i] * y[j] * z[k], 0) for i, j, k in places], axis=-1)
    next_voxel = min(resolution - 1, 1)  # a volume of one voxel has no next one
    steps = tuple(next_voxel * (i + resolution * (j + resolution * k)) for i, j, k in places)
    return lowest, weights.reshape(-1, 8), steps
