"""The trivial renderers that every table shows: what a picture scores without a network.

    white      an empty picture
    splat      every point a disc of `radius` that faces the camera (parallel to the image plane)
    nearest    every point a ball of `radius`; where a ray first meets their union, the nearest point gives the colour

Both others take the base colour as the colour (no light), linear -> sRGB, on white, without antialiasing.  `radius` is
in world units; `spacing` is the scale to choose it by.  The arithmetic is dense, every ray against every point, a
block of rays at a time.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.cameras import camera_rays
from spnr_jax.kernels.imaging import linear_to_srgb
from spnr_jax.kernels.records import Camera, PointCloud

BLOCK = 2**19  # pairs of a ray (or point) and a point in memory at once, per view: 6 MB


def white(camera: Camera) -> Float[Array, "*batch height width 3"]:
    """The white image."""
    return jnp.ones((*camera.cam_to_world.shape[:-2], camera.height, camera.width, 3))


def splat(
    cloud: PointCloud, camera: Camera, radius: Float[Array, ""] | float
) -> tuple[Float[Array, "height width 3"], Float[Array, "height width"]]:
    """sRGB image and opacity (0 or 1) of discs around the points; the disc nearest in camera depth wins."""
    forward = -camera.cam_to_world[:, 2]
    offset = (cloud.positions - camera.cam_to_world[None, :, 3]).T
    depth = jnp.einsum("in,i->n", offset, forward, precision="highest")
    present = cloud.mask & (depth > 0)

    def order(direction):  # the ray crosses the plane of a disc at `distance`
        distance = depth / jnp.dot(direction, forward, precision="highest")
        beside = distance[None] * direction[:, None] - offset
        return jnp.where(present & (jnp.sum(beside**2, axis=0) <= radius**2), depth, jnp.inf)

    return _shade_first(cloud, camera, order)


def nearest(
    cloud: PointCloud, camera: Camera, radius: Float[Array, ""] | float
) -> tuple[Float[Array, "height width 3"], Float[Array, "height width"]]:
    """sRGB image and opacity (0 or 1) of the union of balls around the points, coloured by the nearest point.

    The ball that a ray enters first belongs to the nearest point of the intersection: the ball of a nearer point would
    have been entered before.  For an eye inside balls the intersection is the eye itself.
    """
    offset = (cloud.positions - camera.cam_to_world[None, :, 3]).T
    to_surface = jnp.sqrt(jnp.sum(offset**2, axis=0)) - radius

    def order(direction):
        along = jnp.einsum("in,i->n", offset, direction, precision="highest")
        beside = along[None] * direction[:, None] - offset
        half_chord_squared = radius**2 - jnp.sum(beside**2, axis=0)
        hit = cloud.mask & (half_chord_squared >= 0) & (along > 0)
        entry = jnp.where(hit, along - jnp.sqrt(jnp.maximum(half_chord_squared, 0)), jnp.inf)
        return jnp.where(cloud.mask & (to_surface <= 0), to_surface, entry)

    return _shade_first(cloud, camera, order)


def spacing(cloud: PointCloud) -> Float[Array, ""]:
    """Median distance of a real point to its nearest other, in world units; 0 for fewer than two points."""
    positions = cloud.positions.T
    number = jnp.arange(cloud.mask.shape[0])

    def to_nearest(point):
        index, position = point
        squared = jnp.sum((positions - position[:, None]) ** 2, axis=0)
        return jnp.min(jnp.where(cloud.mask & (number != index), squared, jnp.inf))

    squared = _map_blocks(to_nearest, (number, cloud.positions), cloud.mask.shape[0])
    ordered = jnp.sort(jnp.where(cloud.mask, jnp.sqrt(squared), jnp.inf))
    count = jnp.sum(cloud.mask)
    middle = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
    return jnp.where(count > 1, middle, 0.0)


def _shade_first(cloud, camera, order):
    """Image and opacity where each ray shows the point that `order`(direction) puts first; infinity is a miss."""
    directions = camera_rays(camera).directions.reshape(-1, 3)

    def first(direction):
        ranks = order(direction)
        index = jnp.argmin(ranks)
        return index, jnp.isfinite(ranks[index])

    index, hit = _map_blocks(first, directions, cloud.mask.shape[0])
    color = jnp.where(hit[:, None], linear_to_srgb(cloud.base_color)[index], 1.0)
    size = camera.height, camera.width
    return color.reshape(*size, 3), hit.astype(color.dtype).reshape(size)


def _map_blocks(function, inputs, num_points):
    """`function` of every row of `inputs`, so many rows at once that BLOCK pairs of row and point are in memory."""
    return jax.lax.map(function, inputs, batch_size=max(1, BLOCK // num_points))
