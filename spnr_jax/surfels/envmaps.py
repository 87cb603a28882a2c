"""Environment maps as arrays: directions of their texels, solid angles, other sizes.

A map is (height, 2 * height, 3), linear radiance, latitude-longitude: row 0 is straight up (+y), column c of w looks
along the azimuth phi = 2 pi (c + 0.5) / w, where the direction is (sin phi, 0, -cos phi) on the horizon.
"""

import numpy as np
from jaxtyping import Float

from spnr_jax.kernels.numerics import namespace
from spnr_jax.kernels.records import AnyArray


def directions(height: int) -> Float[np.ndarray, "height width 3"]:
    """Unit directions through the middles of a map's texels."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = np.pi * (np.arange(2 * height) + 0.5) / height
    across = np.sin(theta)[:, None]
    up = np.broadcast_to(np.cos(theta)[:, None], (height, 2 * height))
    return np.stack([across * np.sin(phi), up, -across * np.cos(phi)], axis=-1)


def solid_angles(height: int) -> Float[np.ndarray, "height width"]:
    """Of the texels of a map, in steradian."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    rows = (edges[:-1] - edges[1:]) * np.pi / height
    return np.repeat(rows[:, None], 2 * height, axis=1).astype(np.float32)


def resampled(envmap: Float[AnyArray, "h w 3"], height: int) -> Float[AnyArray, "height width 3"]:
    """A map of another size: each texel is the mean over its solid angle of those that it overlaps; energy is kept."""
    rows = _shares(
        -np.cos(np.pi * np.arange(envmap.shape[0] + 1) / envmap.shape[0]),
        -np.cos(np.pi * np.arange(height + 1) / height),
    )
    columns = _shares(np.linspace(0, 1, envmap.shape[1] + 1), np.linspace(0, 1, 2 * height + 1))
    xp = namespace(envmap)
    narrow = xp.tensordot(rows, envmap, axes=(1, 0))
    return xp.tensordot(narrow, columns, axes=(1, 1)).swapaxes(1, 2)


def _shares(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Share of each old interval in each new one (new, old), from rising edges."""
    overlap = np.minimum(old[1:], new[1:, None]) - np.maximum(old[:-1], new[:-1, None])
    return (np.maximum(overlap, 0) / (new[1:] - new[:-1])[:, None]).astype(np.float32)
