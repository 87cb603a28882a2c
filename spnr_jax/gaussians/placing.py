"""Where splats lie: on the surface that pictures of the object show, one in each small cube that holds some of it.

Pixels of all views are carried back to their depth, and the nearest surfel says what each lies on: a pixel far from it
is no surface (a depth between two of them), its normal is turned to the viewer.  Pixels that share a cube and face the
same way, by the largest component of the normal, become a splat at their mean, so a thin sheet has one on each side.
The cubes are as small as the wanted number of splats allows, and no smaller than the pixels.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError
from spnr_jax.kernels.cameras import camera_rays
from spnr_jax.kernels.records import Camera, Gaussians, Surfels

STRIDE = 2  # of the pixels that are carried back
WITHIN, OFF_PLANE = 1.2, 0.5  # spacings of a surfel from which and above whose plane a pixel belongs to it
GRAZING = 0.1  # cosine between ray and normal below which a pixel's depth says little
FINEST = 1.25  # pixels of the pictures that a cube is wide at least
WIDTH, THICKNESS, OPACITY = 0.57, 0.03, 0.98  # of a splat: standard deviations in cubes, opacity
INSET = 0.5  # pixels that a splat lies below the surface: at outlines many are seen from their edge, and all reach out
TRIES, ENOUGH = 6, 0.85  # sizes of cubes that are tried, share of the wanted number that is good


class View(NamedTuple):
    """A picture on white, sRGB, with opacity and distance along the ray to the surface, NaN where none is."""

    camera: Camera
    image: Float[np.ndarray, "height width 3"]
    opacity: Float[np.ndarray, "height width"]
    depth: Float[np.ndarray, "height width"]


class Seen(NamedTuple):
    """Pixels carried back: places, and normals towards the viewer."""

    position: Float[np.ndarray, "pixels 3"]
    normal: Float[np.ndarray, "pixels 3"]


def seen_surface(views: Sequence[View], surfels: Surfels, stride: int = STRIDE) -> Seen:
    """The places of the surface that the views show; ValueError if they show none."""
    found, rays = [], []
    for i, view in enumerate(views):
        row, column = i % stride, i // stride % stride  # another share of the pixels in each view
        of = camera_rays(view.camera)
        depth = view.depth[row::stride, column::stride]
        hit = np.isfinite(depth)
        direction = np.asarray(of.directions)[row::stride, column::stride][hit]
        origin = np.asarray(of.origins)[row::stride, column::stride][hit]
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
    return Seen(position[kept], (normal * np.sign(facing)[:, None])[kept])


def place(seen: Seen, *, most: int, pixel: float) -> tuple[Gaussians, float]:
    """Grey splats, at most so many, and the side of the cubes; `pixel` is the width of a pixel on the surface."""
    side = max(FINEST * pixel, 1e-9)
    low = seen.position.min(axis=0)
    for _ in range(TRIES):
        number, group = _groups(seen, low, side)
        if number <= most and (number >= ENOUGH * most or side <= FINEST * pixel):
            break
        side = max(side * np.sqrt(number / (0.5 * (1 + ENOUGH) * most)), FINEST * pixel)
    while number > most:
        side *= 1.1
        number, group = _groups(seen, low, side)
    count = np.bincount(group, minlength=number)[:, None]
    position, normal = (
        np.stack([np.bincount(group, x[:, i], number) for i in range(3)], axis=-1) / count for x in seen
    )
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    scale = np.broadcast_to(np.array([WIDTH, WIDTH, THICKNESS], np.float32) * side, (number, 3))
    placed = Gaussians(
        position=(position - INSET * pixel * normal).astype(np.float32),
        rotation=turn_to(normal).astype(np.float32),
        scale=np.array(scale),
        opacity=np.full(number, OPACITY, np.float32),
        harmonics=np.zeros((number, 1, 3), np.float32),
    )
    return placed, float(side)


def _groups(seen: Seen, low: np.ndarray, side: float) -> tuple[int, np.ndarray]:
    """How many splats cubes of this side make, and which one each pixel belongs to."""
    cube = ((seen.position - low) / side).astype(np.int64)
    axis = np.abs(seen.normal).argmax(axis=1)
    face = 2 * axis + (np.take_along_axis(seen.normal, axis[:, None], axis=1)[:, 0] > 0)
    key = ((cube[:, 0] << 40 | cube[:, 1] << 20 | cube[:, 2]) << 3) | face
    names, group = np.unique(key, return_inverse=True)
    return len(names), group.ravel()


def rotations(quaternion: Float[np.ndarray, "splats 4"]) -> Float[np.ndarray, "splats 3 3"]:
    """Rotation matrices of unit quaternions w x y z."""
    w, x, y, z = np.asarray(quaternion).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def turn_to(normal: Float[np.ndarray, "splats 3"]) -> Float[np.ndarray, "splats 4"]:
    """Quaternions w x y z that turn the third axis to a normal, some after half a turn around the first axis."""
    below = normal[:, 2:] < 0
    x, y, z = np.split(normal * np.where(below, -1, 1), 3, axis=-1)
    w, nothing = 1 + z, np.zeros_like(z)
    upright = np.concatenate([w, -y, x, nothing], axis=-1)
    turned = np.concatenate([y, w, nothing, -x], axis=-1)  # the same rotation behind that half turn
    quaternion = np.where(below, turned, upright)
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
