"""Gaussian splats on an object's surface, fitted to pictures of it; pure functions.

Harmonics: real spherical harmonics as in splat viewers, degrees 0 to 3, with the Condon-Shortley phase, in the order of
Kerbl et al. 2023 and of KHR_gaussian_splatting: by degree, then by order from -degree to degree.

Positions: the pixels of all views are unprojected with their depth.  The nearest surfel gives each its normal, turned
to the viewer.  A pixel far from all surfels is dropped (its depth lies between two surfaces).  Pixels in the same cube
whose normals have the same dominant axis and sign become one splat at their mean, so a thin sheet has splats on both
sides.  The cubes are as small as the requested number of splats allows, but not smaller than the pixels.

Colours: spherical harmonics by weighted least squares over the views that see each splat.  A view sees a splat that
faces it and whose centre lies at the picture's depth.  It contradicts a splat that lies in front of that depth, or
where the picture is empty.  Splats that many views contradict stick out of the object and are dropped.  The weight of a
view is the cosine of its angle to the normal.  A ridge penalty on the higher degrees gives a constant colour where few
views see the splat.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from spnr_jax.errors import UserError
from spnr_jax.kernels.cameras import camera_rays
from spnr_jax.kernels.records import AnyArray, Camera, Gaussians, Surfels

C0 = 0.28209479177387814  # sqrt(1 / 4 pi)
C1 = 0.4886025119029199  # sqrt(3 / 4 pi)
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
HIGHEST = 3  # degree


def count_coefficients(degree: int) -> int:
    """Number of harmonics up to a degree."""
    return (degree + 1) ** 2


def degree_of(count: int) -> int:
    """The degree that has this number of coefficients; ValueError if there is none."""
    for degree in range(HIGHEST + 1):
        if count_coefficients(degree) == count:
            return degree
    raise UserError(f"spherical harmonics have 1, 4, 9 or 16 coefficients, got {count}")


def evaluate_harmonics(directions: Float[AnyArray, "*batch 3"], degree: int) -> Float[AnyArray, "*batch coefficients"]:
    """All harmonics up to a degree, 0 to 3, of unit vectors; NumPy in, NumPy out."""
    x, y, z = (directions[..., i] for i in range(3))
    xx, yy, zz = x * x, y * y, z * z
    values = [C0 + 0 * x]
    if degree > 0:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree > 1:
        a, b, c = C2
        values += [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, c * (xx - yy)]
    if degree > 2:
        a, b, c, d, e = C3
        values += [-a * y * (3 * xx - yy), b * x * y * z, -c * y * (4 * zz - xx - yy)]
        values += [d * z * (2 * zz - 3 * xx - 3 * yy), -c * x * (4 * zz - xx - yy)]
        values += [e * z * (xx - yy), -a * x * (xx - 3 * yy)]
    return np.stack(values, axis=-1) if isinstance(directions, np.ndarray) else jnp.stack(values, axis=-1)


def half_turn_signs(degree: int) -> Float[np.ndarray, " coefficients"]:
    """Signs of the coefficients after half a turn of the colour around the x axis: (x, y, z) -> (x, -y, -z)."""
    direction = np.array([0.36, 0.48, 0.8])
    return np.sign(evaluate_harmonics(direction * [1, -1, -1], degree) * evaluate_harmonics(direction, degree))


STRIDE = 2  # every second pixel of each axis is unprojected
WITHIN, OFF_PLANE = 1.2, 0.5  # spacings: largest distance of a pixel to its surfel, and to the surfel's plane
GRAZING = 0.1  # cosine between ray and normal below which a pixel's depth is unreliable
FINEST = 1.25  # least side of a cube, in pixels of the pictures
WIDTH, THICKNESS, OPACITY = 0.57, 0.03, 0.98  # of a splat: standard deviations in sides of a cube; opacity
INSET = 0.5  # pixels that splats lie below the surface: at outlines, many are seen edge-on, and all extend outward
FEWEST = 6  # splats: one for each axis and sign that a normal may be nearest to
TRIES, ENOUGH = 6, 0.85  # cube sizes that are tried; share of the requested number that suffices


class View(NamedTuple):
    """A picture on white, sRGB, with opacity and distance along the ray to the surface, NaN where none is."""

    camera: Camera
    image: Float[np.ndarray, "height width 3"]
    opacity: Float[np.ndarray, "height width"]
    depth: Float[np.ndarray, "height width"]


class SurfacePoints(NamedTuple):
    """Unprojected pixels: positions, and normals that face the viewer."""

    position: Float[np.ndarray, "pixels 3"]
    normal: Float[np.ndarray, "pixels 3"]


def collect_surface(views: Sequence[View], surfels: Surfels) -> SurfacePoints:
    """The surface points that the views show; ValueError if they show none."""
    found, rays = [], []
    for i, view in enumerate(views):
        row, column = i % STRIDE, i // STRIDE % STRIDE  # each view uses other pixels
        of = camera_rays(view.camera)
        depth = view.depth[row::STRIDE, column::STRIDE]
        hit = np.isfinite(depth)
        direction = np.asarray(of.directions)[row::STRIDE, column::STRIDE][hit]
        origin = np.asarray(of.origins)[row::STRIDE, column::STRIDE][hit]
        found.append((origin + depth[hit][:, None] * direction).astype(np.float32))
        rays.append(direction)
    position, direction = np.concatenate(found), np.concatenate(rays)
    live = np.asarray(surfels.mask)
    centre, normal, spacing = (np.asarray(x)[live] for x in (surfels.position, surfels.normal, surfels.spacing))
    distance, nearest = cKDTree(centre).query(position)
    offset = position - centre[nearest]
    normal, spacing = normal[nearest], spacing[nearest]
    facing = -np.einsum("ni,ni->n", direction, normal)
    above = np.abs(np.einsum("ni,ni->n", offset, normal))
    kept = (distance < WITHIN * spacing) & (above < OFF_PLANE * spacing) & (np.abs(facing) > GRAZING)
    if not kept.any():
        raise UserError("the network's pictures show no surface to put splats on")
    return SurfacePoints(position[kept], (normal * np.sign(facing)[:, None])[kept])


def place_splats(surface: SurfacePoints, *, most: int, pixel: float) -> tuple[Gaussians, float]:
    """Grey splats, `most` or fewer, and the side of the cubes; `pixel` is the width of a pixel on the surface."""
    if most < FEWEST:
        raise UserError(f"splats: most={most}, expected {FEWEST} or more")
    side = max(FINEST * pixel, 1e-9)
    low = surface.position.min(axis=0)
    number, group = _group_pixels(surface, low, side)
    for _ in range(TRIES):
        if number <= most and (number >= ENOUGH * most or side <= FINEST * pixel):
            break
        side = max(side * np.sqrt(number / (0.5 * (1 + ENOUGH) * most)), FINEST * pixel)
        number, group = _group_pixels(surface, low, side)
    while number > most:
        side *= 1.1
        number, group = _group_pixels(surface, low, side)
    count = np.bincount(group, minlength=number)[:, None]
    position, normal = (
        np.stack([np.bincount(group, x[:, i], number) for i in range(3)], axis=-1) / count for x in surface
    )
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    scale = np.broadcast_to(np.array([WIDTH, WIDTH, THICKNESS], np.float32) * side, (number, 3))
    placed = Gaussians(
        position=(position - INSET * pixel * normal).astype(np.float32),
        rotation=rotate_to(normal).astype(np.float32),
        scale=np.array(scale),
        opacity=np.full(number, OPACITY, np.float32),
        harmonics=np.zeros((number, 1, 3), np.float32),
    )
    return placed, float(side)


def _group_pixels(surface: SurfacePoints, low: np.ndarray, side: float) -> tuple[int, np.ndarray]:
    """Number of splats for cubes of this side, and the splat to which each pixel belongs."""
    cube = ((surface.position - low) / side).astype(np.int64)
    axis = np.abs(surface.normal).argmax(axis=1)
    face = 2 * axis + (np.take_along_axis(surface.normal, axis[:, None], axis=1)[:, 0] > 0)
    key = ((cube[:, 0] << 40 | cube[:, 1] << 20 | cube[:, 2]) << 3) | face
    names, group = np.unique(key, return_inverse=True)
    return len(names), group.ravel()


def rotation_matrices(quaternion: Float[np.ndarray, "splats 4"]) -> Float[np.ndarray, "splats 3 3"]:
    """Rotation matrices of quaternions w x y z."""
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def rotate_to(normal: Float[np.ndarray, "splats 3"]) -> Float[np.ndarray, "splats 4"]:
    """Quaternions w x y z that rotate the third axis to a normal; some include half a turn around the first axis."""
    below = normal[:, 2:] < 0
    x, y, z = np.split(normal * np.where(below, -1, 1), 3, axis=-1)
    w, nothing = 1 + z, np.zeros_like(z)
    upright = np.concatenate([w, -y, x, nothing], axis=-1)
    turned = np.concatenate([y, w, nothing, -x], axis=-1)  # the same rotation after that half turn
    quaternion = np.where(below, turned, upright)
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)


BEHIND = 2.0  # sides of a cube that a splat may lie behind a picture's depth
SOLID = 0.6  # opacity above which a pixel has a reliable colour
LEAST_FACING = 0.05  # weight of a splat that is seen edge-on
RIDGE = 0.4  # of the higher degrees; its unit is one view
BEFORE = 2.5  # sides of a cube in front of a picture's depth beyond which the view contradicts a splat
EMPTY = 0.5  # opacity below which a picture is empty
TOLERATED_SHARE = 0.12  # contradicting views that are tolerated: this share of the views that see the splat,
TOLERATED = 0.5  # plus this number


def color_splats(gaussians: Gaussians, views: Sequence[View], *, side: float, degree: int) -> Gaussians:
    """The splats with colours fitted to the views, up to a degree 0 to 3; splats that no view sees are dropped."""
    position = np.asarray(gaussians.position)
    normal = rotation_matrices(np.asarray(gaussians.rotation))[:, :, 2]
    count = count_coefficients(degree)
    matrix = np.zeros((len(position), count, count), np.float32)
    right = np.zeros((len(position), count, 3), np.float32)
    seeing, contradicting = np.zeros((2, len(position)), np.int32)
    for view in views:
        towards = position - np.asarray(view.camera.cam_to_world)[:, 3]
        distance = np.linalg.norm(towards, axis=1)
        towards /= distance[:, None]
        row, column, inside = _pixels(position, view.camera)
        opacity, depth = view.opacity[row, column], view.depth[row, column]
        with np.errstate(invalid="ignore"):
            near = inside & (distance < depth + BEHIND * side)
            # depth is blurred at its jumps: the least around each pixel
            least = minimum_filter(np.where(np.isnan(view.depth), np.inf, view.depth), 3)
            before = near & (distance < least[row, column] - BEFORE * side)
        contradicting += before | (inside & (opacity < EMPTY))
        cosine = -np.einsum("ni,ni->n", towards, normal)  # a thin sheet has splats on both sides
        visible = np.flatnonzero(near & ~before & (opacity > SOLID) & (cosine > 0))
        facing = cosine[visible]
        weight = np.maximum(facing, LEAST_FACING)[:, None].astype(np.float32)
        opacity = opacity[visible, None]
        observed = (view.image[row[visible], column[visible]] - (1 - opacity)) / opacity
        harmonics = np.asarray(evaluate_harmonics(towards[visible].astype(np.float32), degree))
        matrix[visible] += (weight * harmonics)[:, :, None] * harmonics[:, None]
        right[visible] += (weight * harmonics)[:, :, None] * (observed - 0.5)[:, None]
        seeing[visible] += 1
    ridge = np.diag([1e-4] + [RIDGE / (4 * np.pi)] * (count - 1)).astype(np.float32)
    kept = (seeing > 0) & (contradicting <= TOLERATED_SHARE * seeing + TOLERATED)
    if not kept.any():
        raise UserError("the pictures agree on no surface; give more views")
    harmonics = np.linalg.solve(matrix[kept] + ridge, right[kept])
    columns = {name: np.asarray(x)[kept] for name, x in vars(gaussians).items()}
    return Gaussians(**columns | {"harmonics": harmonics.astype(np.float32)})


def _pixels(position: Float[np.ndarray, "splats 3"], camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row and column of the pixel that each position projects to, and whether it lies in the image."""
    pose, k = np.asarray(camera.cam_to_world), np.asarray(camera.intrinsics)
    local = (position - pose[:, 3]) @ pose[:, :3]
    ahead = -local[:, 2] > 1e-6
    away = np.where(ahead, -local[:, 2], 1)
    column = np.floor(k[0, 0] * local[:, 0] / away + k[0, 2])
    row = np.floor(-k[1, 1] * local[:, 1] / away + k[1, 2])
    inside = ahead & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    return tuple(np.where(inside, x, 0).astype(np.int32) for x in (row, column)) + (inside,)
