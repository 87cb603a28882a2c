"""Cameras: poses, pixel grids, rays and the box that the object lies in.

Conventions: OpenGL axes (x right, y up, the camera looks along -z), `cam_to_world` maps camera to world coordinates,
intrinsics are in pixels, row 0 is the top of the image and pixel (row, column) has its centre at (column + 0.5,
row + 0.5).  Ray directions have unit length.  Everything broadcasts over leading batch axes.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from spnr_jax.errors import UserError
from spnr_jax.kernels.numerics import length, normalize, safe_divide
from spnr_jax.kernels.records import AnyArray, Camera, Rays

# A direction component below this moves a ray by less than a float32 spacing across 10^4 boxes, so it counts as 0; the
# square of its inverse, which the gradient contains, stays far from overflow.
PARALLEL = 1e-12
ORTHONORMAL = 1e-2  # |R^T R - I| from which a matrix is no rotation


def look_at(
    eye: Float[Array, "*batch 3"], target: Float[Array, "*#batch 3"], up: Float[Array, "*#batch 3"]
) -> Float[Array, "*batch 3 4"]:
    """Camera-to-world pose at `eye` that looks at `target`; `up` must not be parallel to the line of sight."""
    backward = normalize(eye - target)
    right = normalize(jnp.cross(jnp.broadcast_to(up, backward.shape), backward))
    return jnp.stack([right, jnp.cross(backward, right), backward, jnp.broadcast_to(eye, backward.shape)], axis=-1)


def pinhole(
    cam_to_world: Float[Array, "*batch 3 4"], field_of_view: float | Float[AnyArray, "*#batch"], height: int, width: int
) -> Camera:
    """Camera with a horizontal field of view in radians, square pixels and the principal point in the middle.

    ValueError for a field of view beyond 0 to pi, as of degrees.
    """
    for angle in () if isinstance(field_of_view, jax.core.Tracer) else np.ravel(field_of_view):
        if not 0 <= angle < np.pi:
            raise UserError(f"pinhole: field_of_view={angle:g} is not from 0 to pi; expected radians")
    kind, batch = jnp.result_type(cam_to_world, jnp.float32), cam_to_world.shape[:-2]
    focal = jnp.broadcast_to(0.5 * width / jnp.tan(0.5 * field_of_view), batch).astype(kind)
    middle = jnp.array([[0, 0, 0.5 * width], [0, 0, 0.5 * height], [0, 0, 1]], kind)
    intrinsics = jnp.broadcast_to(middle, (*batch, 3, 3)).at[..., (0, 1), (0, 1)].set(focal[..., None])
    return Camera(cam_to_world=cam_to_world, intrinsics=intrinsics, height=height, width=width)


def resize(camera: Camera, height: int, width: int) -> Camera:
    """The same view with another number of pixels."""
    scale = jnp.array([[width / camera.width], [height / camera.height], [1.0]], jnp.float32)
    scale = jnp.broadcast_to(scale, (*camera.intrinsics.shape[:-1], 1))
    return dataclasses.replace(camera, intrinsics=camera.intrinsics * scale, height=height, width=width)


def camera_rays(camera: Camera) -> Rays:
    """Rays through all pixel centres, (*batch, height, width, 3)."""
    columns, rows = (jnp.arange(n, dtype=jnp.float32) + 0.5 for n in (camera.width, camera.height))
    fx, fy, cx, cy = (camera.intrinsics[..., i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    ones = [1] * (fx.ndim - 2)
    x, y = (columns.reshape(*ones, 1, -1) - cx) / fx, -(rows.reshape(*ones, -1, 1) - cy) / fy
    x, y = jnp.broadcast_arrays(x, y)
    local = jnp.stack([x, y, -jnp.ones_like(x)], axis=-1)
    rotation, eye = camera.cam_to_world[..., :3], camera.cam_to_world[..., None, None, :, 3]
    directions = normalize(jnp.einsum("...ij,...hwj->...hwi", rotation, local, precision="highest"))
    return Rays(origins=jnp.broadcast_to(eye, directions.shape), directions=directions)


def compute_ray_slopes(
    intrinsics: Float[AnyArray, "3 3"], column: Float[Array, "*places"], row: Float[Array, "*others"]
) -> tuple[Float[Array, "*places"], Float[Array, "*others"]]:
    """How far rays through places of a picture, in pixels, go right and up for each unit ahead; not batched."""
    return (column - intrinsics[0, 2]) / intrinsics[0, 0], -(row - intrinsics[1, 2]) / intrinsics[1, 1]


def view_rays(camera: Camera) -> Rays:
    """Rays of all views of an object in one axis, (objects, views * height * width, 3)."""
    return jax.tree.map(lambda x: x.reshape(x.shape[0], -1, 3), camera_rays(camera))


def project(
    camera: Camera, positions: Float[Array, "*batch points 3"]
) -> tuple[Float[Array, "*batch points 2"], Float[Array, "*batch points"]]:
    """Pixel coordinates (column, row) and distance from the eye, the inverse of `camera_rays`.

    A point at or behind the plane of the eye has no pixel: its coordinates are NaN-free but outside every image (-inf).
    """
    offset = positions - camera.cam_to_world[..., None, :, 3]
    local = jnp.einsum("...ji,...nj->...ni", camera.cam_to_world[..., :3], offset, precision="highest")
    in_front = -local[..., 2] > 0
    plane = safe_divide(local[..., :2], jnp.broadcast_to(-local[..., 2:], local[..., :2].shape))
    focal = jnp.stack([camera.intrinsics[..., None, 0, 0], -camera.intrinsics[..., None, 1, 1]], axis=-1)
    pixels = plane * focal + camera.intrinsics[..., None, :2, 2]
    return jnp.where(in_front[..., None], pixels, -jnp.inf), length(offset)


def intersect_box(
    origins: Float[Array, "*batch 3"], directions: Float[Array, "*batch 3"], lo: float = -1.0, hi: float = 1.0
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """Distances to entry (0 from inside) and exit of the cube [lo, hi]^3, and whether it is hit; a miss has 0, 0."""
    parallel = jnp.abs(directions) < PARALLEL
    inverse = 1 / jnp.where(parallel, 1.0, directions)
    a, b = (lo - origins) * inverse, (hi - origins) * inverse
    inside = (origins >= lo) & (origins <= hi)
    entry = jnp.where(parallel, jnp.where(inside, -jnp.inf, jnp.inf), jnp.minimum(a, b))
    leave = jnp.where(parallel, jnp.where(inside, jnp.inf, -jnp.inf), jnp.maximum(a, b))
    near, far = jnp.maximum(jnp.max(entry, axis=-1), 0.0), jnp.min(leave, axis=-1)
    hit = (far > near) & jnp.isfinite(far)
    return jnp.where(hit, near, 0.0), jnp.where(hit, far, 0.0), hit


def orbit(
    azimuth: float | Float[AnyArray, "*#batch"],
    elevation: float | Float[AnyArray, "*#batch"],
    distance: float | Float[AnyArray, "*#batch"],
    centre: Float[AnyArray, "*#batch 3"],
) -> Float[Array, "*#batch 3 4"]:
    """Pose that looks at `centre` from a distance; radians: azimuth around y from +z, elevation above the xz plane.

    Poses are continuous over the poles; beyond them the object stands on its head.
    """
    azimuth, elevation, distance, _ = jnp.broadcast_arrays(azimuth, elevation, distance, centre[..., 0])
    horizontal, east, south = jnp.cos(elevation), jnp.sin(azimuth), jnp.cos(azimuth)
    direction = jnp.stack([horizontal * east, jnp.sin(elevation), horizontal * south], axis=-1)
    # up where y is along the view
    beside = -jnp.sign(jnp.sin(elevation))[..., None] * jnp.stack([east, jnp.zeros_like(east), south], axis=-1)
    upright = jnp.sign(horizontal)[..., None] * jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), direction.shape)
    up = jnp.where(jnp.abs(horizontal)[..., None] > 1e-6, upright, beside)
    centre = jnp.broadcast_to(centre, direction.shape)
    return look_at(centre + distance[..., None] * direction, centre, up)


def is_rotation(matrices: Float[np.ndarray, "*batch 3 3"]) -> bool:
    """Whether all matrices are rotations, to a hundredth; on the host."""
    wrong = np.abs(np.swapaxes(matrices, -1, -2) @ matrices - np.eye(3)).max(initial=0)
    return bool(wrong < ORTHONORMAL and np.linalg.det(matrices).min(initial=1) > 0)


def move_into_box(camera: Camera, centre: Float[AnyArray, "3"], scale: Float[AnyArray, ""]) -> Camera:
    """The camera (any axes of views) in the coordinates of the normalised box."""
    rotation, eye = camera.cam_to_world[..., :3], camera.cam_to_world[..., 3]
    eye = (eye - jnp.broadcast_to(centre, eye.shape)) * scale
    return dataclasses.replace(camera, cam_to_world=jnp.concatenate([rotation, eye[..., None]], axis=-1))
