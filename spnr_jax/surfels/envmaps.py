"""Environment maps as arrays: directions of their texels, solid angles, other sizes.

A map is (height, 2 * height, 3), linear radiance, latitude-longitude: row 0 is straight up (+y), column c of w looks
along the azimuth phi = 2 pi (c + 0.5) / w, where the direction is (sin phi, 0, -cos phi) on the horizon.
"""

import numpy as np
from jaxtyping import Float


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


def resampled(envmap: Float[np.ndarray, "h w 3"], height: int) -> Float[np.ndarray, "height width 3"]:
    """A map of another size: means over its texels' solid angles, of a map refined first where it is too coarse."""
    fine = envmap
    for axis, size in ((0, height), (1, 2 * height)):
        repeats = int(np.lcm(fine.shape[axis], size) // fine.shape[axis])
        fine = np.repeat(fine, repeats, axis=axis) if repeats < 16 else _stretched(fine, axis, 16 * size)
    area = np.repeat(_row_areas(fine.shape[0])[:, None], fine.shape[1], axis=1)[..., None]
    shape = (height, fine.shape[0] // height, 2 * height, fine.shape[1] // (2 * height))
    total, weight = ((x.reshape(*shape, -1)).sum(axis=(1, 3)) for x in (fine * area, area))
    return (total / weight).astype(np.float32)


def _stretched(values: np.ndarray, axis: int, size: int) -> np.ndarray:
    """Nearest texels at `size` places."""
    return np.take(values, (np.arange(size) + 0.5) * values.shape[axis] // size, axis=axis, mode="clip")


def _row_areas(height: int) -> np.ndarray:
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return (edges[:-1] - edges[1:]).astype(np.float32)
