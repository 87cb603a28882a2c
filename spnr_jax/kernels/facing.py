"""Normals of points that one sensor saw: of the plane of the neighbours, turned to where the sensor stood."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

NEIGHBOURS = 16


def facing(
    positions: Float[np.ndarray, "points 3"],
    among: Float[np.ndarray, "all 3"],
    place: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "points 3"]:
    """Unit normals of the planes through the nearest of all points, least squares, on the side of the place."""
    count = min(NEIGHBOURS, len(among))
    near = among[cKDTree(among).query(positions, list(range(1, count + 1)), workers=-1)[1]]
    offset = near - near.mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.swapaxes(offset, 1, 2) @ offset)[1][..., 0]
    towards = np.einsum("ni,ni->n", normal, place - positions)
    return np.where(towards[:, None] < 0, -normal, normal)
