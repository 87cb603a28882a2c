"""Colours of splats from pictures: spherical harmonics by weighted least squares over the views that see each splat.

A view sees a splat that faces it and whose centre lies at its picture's depth there, and is against one that lies
before that depth or where the picture is empty: those that more than a few views are against stick out of the object,
and are left out.  The weight of a view is the cosine under which it sees the splat; harmonics of higher degree are held
back (ridge), so few views give a plain colour.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import minimum_filter

from spnr_jax.errors import UserError
from spnr_jax.gaussians.harmonics import basis, coefficients
from spnr_jax.gaussians.placing import View, rotations
from spnr_jax.kernels.records import Camera, Gaussians

BEHIND = 2.0  # sides of a cube that a splat may lie behind a picture's depth
SOLID = 0.6  # opacity from which a pixel has a colour of its own
LEAST_FACING = 0.05  # weight of a splat that is seen from its edge
RIDGE = 0.4  # in views
BEFORE = 2.5  # sides of a cube before a picture's depth from which a view is against a splat
EMPTY = 0.5  # opacity below which a picture is empty
FEW, ALWAYS = 0.12, 0.5  # views against a splat that do not count: share of those that see it, and number


def color(gaussians: Gaussians, views: Sequence[View], *, side: float, degree: int) -> Gaussians:
    """The splats in the colours of the views, of a degree 0 to 3; without those that no view sees."""
    position = np.asarray(gaussians.position)
    normal = rotations(np.asarray(gaussians.rotation))[:, :, 2]
    count = coefficients(degree)
    matrix = np.zeros((len(position), count, count), np.float32)
    right = np.zeros((len(position), count, 3), np.float32)
    seen, against = np.zeros((2, len(position)), np.int32)
    for view in views:
        towards = position - np.asarray(view.camera.cam_to_world)[:, 3]
        distance = np.linalg.norm(towards, axis=1)
        towards /= distance[:, None]
        row, column, inside = _pixels(position, view.camera)
        opacity, depth = view.opacity[row, column], view.depth[row, column]
        with np.errstate(invalid="ignore"):
            near = inside & (distance < depth + BEHIND * side)
            before = near & (distance < nearest_around(view.depth)[row, column] - BEFORE * side)
        against += before | (inside & (opacity < EMPTY))
        cosine = -np.einsum("ni,ni->n", towards, normal)  # a thin sheet has splats on either side
        visible = np.flatnonzero(near & ~before & (opacity > SOLID) & (cosine > 0))
        facing = cosine[visible]
        weight = np.maximum(facing, LEAST_FACING)[:, None].astype(np.float32)
        opacity = opacity[visible, None]
        seen_color = (view.image[row[visible], column[visible]] - (1 - opacity)) / opacity
        harmonics = np.asarray(basis(towards[visible].astype(np.float32), degree))
        matrix[visible] += (weight * harmonics)[:, :, None] * harmonics[:, None]
        right[visible] += (weight * harmonics)[:, :, None] * (seen_color - 0.5)[:, None]
        seen[visible] += 1
    held = np.diag([1e-4] + [RIDGE / (4 * np.pi)] * (count - 1)).astype(np.float32)
    shown = (seen > 0) & (against <= FEW * seen + ALWAYS)
    if not shown.any():
        raise UserError("the pictures agree on no surface; give more views")
    harmonics = np.linalg.solve(matrix[shown] + held, right[shown])
    kept = {name: np.asarray(x)[shown] for name, x in vars(gaussians).items()}
    return Gaussians(**kept | {"harmonics": harmonics.astype(np.float32)})


def nearest_around(depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """The least depth of a pixel and those around it, infinite where none has one: depth is blurred where it jumps."""
    return minimum_filter(np.where(np.isnan(depth), np.inf, depth), 3)


def _pixels(position: Float[np.ndarray, "splats 3"], camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row and column of the pixel that each place lies in, and whether it lies in one."""
    pose, k = np.asarray(camera.cam_to_world), np.asarray(camera.intrinsics)
    local = (position - pose[:, 3]) @ pose[:, :3]
    ahead = -local[:, 2] > 1e-6
    away = np.where(ahead, -local[:, 2], 1)
    column = np.floor(k[0, 0] * local[:, 0] / away + k[0, 2])
    row = np.floor(-k[1, 1] * local[:, 1] / away + k[1, 2])
    inside = ahead & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    return tuple(np.where(inside, x, 0).astype(np.int32) for x in (row, column)) + (inside,)
