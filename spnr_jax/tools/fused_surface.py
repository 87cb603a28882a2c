"""How solid the places in the box are, by what a network's pictures of the object show (as Curless and Levoy 1996).

A picture is for a place being outside by how far it lies before the picture's depth, between -1 and 1 in units of BAND
steps of the grid, and by 1 where the picture is empty there.  The depth is the least around a pixel, else outlines
would be cut off by the pixels that they cross.  What several pictures agree on counts: the AGREE-th largest of these.
The mean, as for depth cameras, would let the far side of a thin wall fill what lies before it.  What no picture sees is
solid, so the surface is closed.

A grid lies over the box of an object, along the axes of its file.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.gaussians.coloring import nearest_around
from spnr_jax.gaussians.placing import View
from spnr_jax.kernels.records import AnyArray, Camera, Volume

GRID = 192  # places along each side of the box
AGREE = 4  # pictures; with 3 solid objects are a little sharper, and thin parts are missing
BAND = 3.5  # steps of the grid before and behind the surface


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Values (x, y, z) float32; [i, j, k] lies at origin + lowest + spacing * (i, j, k) in the file's x y z.

    Places are split into an origin (3,) and a rest, so that float32 can hold what is added to it.
    """

    values: np.ndarray
    lowest: np.ndarray
    spacing: float
    origin: np.ndarray


def over_box(
    value: Callable[[Float[np.ndarray, "places 3"]], Float[AnyArray, " places"]],
    volume: Volume,
    placed: PlacedCloud,
    resolution: int,
) -> Grid:
    """The values of a function of places in the box, `resolution` along each side; it gets a plane at a time."""
    steps = np.linspace(-1, 1, resolution, dtype=np.float32)
    plane = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    rotation, scale = placed.rotation.astype(np.float32), float(volume.scale)
    values = np.empty((resolution,) * 3, np.float32)
    for i, x in enumerate(steps):
        places = np.concatenate([np.full_like(plane[:, :1], x), plane], axis=-1) @ rotation.T
        values[i] = np.asarray(value(places)).reshape(resolution, resolution)
    return Grid(
        values=values,
        lowest=placed.rotation.T @ np.asarray(volume.centre, np.float64) - 1 / scale,
        spacing=2 / (resolution - 1) / scale,
        origin=placed.origin,
    )


def solidity(views: Sequence[View], volume: Volume, placed: PlacedCloud, resolution: int = GRID) -> Grid:
    """0 outside, 1 inside, 1/2 on the surface, with `resolution` places along each side of the box."""
    cameras = jax.tree.map(lambda *x: jnp.stack(x), *(view.camera for view in views))
    depth = jnp.stack([nearest_around(view.depth).astype(np.float32) for view in views])
    band = jnp.float32(BAND * 2 / (resolution - 1))
    return over_box(partial(_solid, cameras, depth, band), volume, placed, resolution)


@jax.jit
def _solid(
    cameras: Camera, depth: Float[Array, "views h w"], band: Float[Array, ""], places: Float[Array, "places 3"]
) -> Float[Array, " places"]:
    """Of places in the box, as cameras (views) with depth see them, infinite where they see nothing."""
    height, width = depth.shape[1:]

    def outvoted(largest: Float[Array, "agree places"], view: tuple) -> tuple[Array, None]:
        pose, k, there = view
        towards = places - pose[None, :, 3]
        local = jnp.matmul(towards, pose[:, :3], precision="highest")
        column = jnp.floor(k[0, 2] - k[0, 0] * local[:, 0] / local[:, 2]).astype(jnp.int32)
        row = jnp.floor(k[1, 2] + k[1, 1] * local[:, 1] / local[:, 2]).astype(jnp.int32)
        shown = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        seen = jnp.where(shown, there.ravel()[jnp.where(shown, row * width + column, 0)], jnp.inf)
        vote = jnp.clip((seen - jnp.linalg.norm(towards, axis=-1)) / band, -1, 1)
        next_larger = jnp.concatenate([largest[1:], jnp.ones_like(largest[:1])])
        return jnp.maximum(largest, jnp.minimum(vote[None], next_larger)), None

    most = jnp.full((AGREE, len(places)), -1, jnp.float32)
    most, _ = jax.lax.scan(outvoted, most, (cameras.cam_to_world, cameras.intrinsics, depth))
    return (1 - most[0]) / 2
