"""What one sensor saw: which points nothing hides from its place, and their normals, turned to it."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

NEIGHBOURS, MOST = 16, 64  # of a point, for its normal
THICK = 0.1  # extent of most neighbourhoods across their planes, over that along them, from which on there is noise
CELL = 2.0  # spacings: pixel of a sensor
SAMPLE = 2048  # points at which the spacing is measured


def facing(
    positions: Float[np.ndarray, "points 3"],
    among: Float[np.ndarray, "all 3"],
    place: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "points 3"]:
    """Unit normals of the planes through the nearest of all points, least squares, on the side of the place.

    They are the more points the thicker these lie about their planes, so that noise does not tilt them.
    """
    tree, count = cKDTree(among), min(NEIGHBOURS, len(among))
    while True:
        near = among[tree.query(positions, list(range(1, count + 1)), workers=-1)[1]]
        offset = near - near.mean(axis=1, keepdims=True)
        squared, axes = np.linalg.eigh(np.swapaxes(offset, 1, 2) @ offset)
        thick = np.median(squared[:, 0]) > THICK**2 * np.median(squared[:, 2])
        if not thick or 2 * count > min(MOST, len(among)):
            break
        count *= 2
    normal = axes[..., 0]
    towards = np.einsum("ni,ni->n", normal, place - positions)
    return np.where(towards[:, None] < 0, -normal, normal)


def seen_from(
    positions: Float[np.ndarray, "points 3"], place: Float[np.ndarray, "3"], spacing: float | int, behind: float | int
) -> Bool[np.ndarray, " points"]:
    """True for points that no other hides from the place: the first in each pixel, and up to so many spacings behind.

    The sensor looks at the middle of the points; its pixels are CELL spacings wide there.
    """
    way = positions.mean(axis=0) - place
    distance = float(np.linalg.norm(way))
    if not distance > 0 or not spacing > 0:
        return np.zeros(len(positions), bool)
    forward = way / distance
    right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    x, y, depth = np.stack([right, np.cross(right, forward), forward]) @ (positions - place).T
    before = np.flatnonzero(depth > spacing)
    pixels = np.floor(np.stack([x, y])[:, before] / depth[before] * (distance / (CELL * spacing)))
    _, rows = np.unique(pixels, axis=1, return_inverse=True)
    first = np.full(len(before), np.inf)
    np.minimum.at(first, rows.ravel(), depth[before])
    seen = np.zeros(len(positions), bool)
    seen[before] = depth[before] < first[rows.ravel()] + behind * spacing
    return seen


def spacing_of(positions: Float[np.ndarray, "points 3"]) -> float:
    """Median side of the square that a point stands for, at a sample of the points; 0 of fewer than two."""
    if len(positions) < 2:
        return 0.0
    count = min(NEIGHBOURS, len(positions))
    sample = positions[:: -(-len(positions) // SAMPLE)]
    radius = cKDTree(positions).query(sample, [count], workers=-1)[0]
    return float(np.median(radius)) * float(np.sqrt(np.pi / count))
