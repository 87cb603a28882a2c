"""Values on a grid over the box of an object, along the axes of its file, and where that grid lies in the file."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.kernels.records import AnyArray, Volume


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
