"""Depth for other programs: where the surface is, without the share of the background in a pixel's mean.

A rendering's depth is the mean distance of all the light of a ray, and what passes by counts with the far side of the
box.  At silhouettes this lies behind the object.  Here what passes is taken out again, and pixels that let most of the
light pass have no depth.
"""

import dataclasses
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Rendering, Volume
from spnr_jax.method.model import DISTANCE

HIT = 0.5  # opacity from which a pixel has a depth
FARTHEST = DISTANCE + np.sqrt(3)  # of the box from a camera of `Model.camera`, in units of the box
DEEPEST = 2**16 - 1  # of 16 bits; 0 is nothing


def surface_depth(rendering: Rendering, camera: Camera, volume: Volume) -> np.ndarray:
    """Distance (h, w) float32 along the ray to what is hit, in the cloud's units; NaN where nothing is."""
    depth, acc = np.asarray(rendering.depth, np.float64), np.asarray(rendering.acc, np.float64)
    far = np.asarray(_far(camera, volume.centre, volume.scale, size=depth.shape), np.float64)
    hit = (depth - (1 - acc) * far) / np.maximum(acc, HIT)
    return np.where(acc >= HIT, hit, np.nan).astype(np.float32)


def step_16bit(volume: Volume) -> float:
    """Depth of one step of a 16-bit picture, the same for all views of `Model.camera`."""
    return float(FARTHEST) / float(volume.scale) / DEEPEST


def in_16bit(depth: np.ndarray, step: float) -> np.ndarray:
    """The depth (h, w) in steps, uint16; 0 where it is NaN."""
    steps = np.round(np.where(np.isnan(depth), 0, depth) / step)
    return np.clip(steps, 0, DEEPEST).astype(np.uint16)


@partial(jax.jit, static_argnames="size")
def _far(
    camera: Camera, centre: Float[Array, "3"], scale: Float[Array, ""], *, size: tuple[int, int]
) -> Float[Array, "h w"]:
    """Distance at which each ray leaves the box."""
    eye = ((camera.cam_to_world[:, 3] - centre) * scale)[:, None]
    pose = jax.numpy.concatenate([camera.cam_to_world[:, :3], eye], axis=1)
    rays = cameras.camera_rays(cameras.resize(dataclasses.replace(camera, cam_to_world=pose), *size))
    return cameras.intersect_box(rays.origins, rays.directions)[1] / scale
