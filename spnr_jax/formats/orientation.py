"""The up axis of a point file, and the position of the sensor that scanned it.

glTF is y up and laser scans (.las) are z up by definition.  For other files, y or z is chosen by the larger
(base + level) / 2 + unlike - crowd:

base     a broad base: area of the convex hull of the points within BASE of an end of the axis (the larger one), over
         that of all points, projected along the axis
level    level surfaces: share of the points whose normal is nearly parallel to the axis
unlike   different ends: mean distance of the points, turned upside down, from the points, over UNLIKE, at most 1
crowd    no panel at an end: share of the points within BASE of either end (the larger one)

72 of 78 real objects are found upright as they are, and 71 turned to z up (docs/lab/readers.md); `--up` overrides it.

PCD headers and PLY camera elements may give the position of a sensor; normals are turned towards it, and a camera's
axes give the up axis.  Writers put 0 0 0 if it is unknown: this is used only if nearly all points are visible from it,
another position if most are.
"""

from collections.abc import Callable
from io import BufferedIOBase
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from spnr_jax.formats.row_files import Header, element_pieces, read_header
from spnr_jax.surfels.normals import estimate_normals, find_visible, measure_spacing

ROTATIONS = {  # up axis of the file -> rotation (rows) that maps it to y
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}
BY_FORMAT = {".glb": "y", ".gltf": "y", ".las": "z", ".laz": "z"}
BASE, UNLIKE = 0.02, 0.03  # of the largest extent
LEVEL = 0.99  # cosine of a level surface's normal to the axis
MARGIN = 0.02  # by which z must score higher than y
MOST_STANDING = 2048  # points from which the up axis is estimated
AHEAD = 0.5  # cosine between a depth camera's z axis and the direction to its points
MOST = 0.7  # share of the points that must be visible from a file's sensor position (0.61 for a sparse ball)
OPEN = 0.9  # share of the points that is visible from their scanner; half of a whole object is
BEHIND = 5.0  # spacings behind the first point of a pixel that count as visible: noise, grazing angles
FARTHEST = 1e30  # units: largest plausible coordinate (galaxies are 1e21 metres wide)
PLACE, UP = ("view_px", "view_py", "view_pz"), ("y_axisx", "y_axisy", "y_axisz")  # of VCGLIB's element `camera`


def find_up(positions: np.ndarray, kind: str, *, of_splats: bool = False) -> tuple[str, str]:
    """(up axis, reason) for points (n, 3) from a file of a kind; splats of a .ply have y down."""
    if kind in BY_FORMAT:
        return BY_FORMAT[kind], f"by the format {kind}"
    positions = positions[:: -(-len(positions) // MOST_STANDING)]
    normals = estimate_normals(positions, cKDTree(positions))
    scores = {axis: standing(positions, normals, "xyz".index(axis)) for axis in "yz"}
    up = "z" if scores["z"] > scores["y"] + MARGIN else "y"
    reason = f"y stands {scores['y']:.2f}, z {scores['z']:.2f}"
    return ("-y", f"{reason}; splats have y down") if of_splats and up == "y" else (up, reason)


def holds_splats(path: Path, kind: str) -> bool:
    """Whether it is a .ply of Gaussian splats, whose axes are right, down, forward."""
    if kind != ".ply":
        return False
    with path.open("rb") as file:
        elements = read_header(file, kind).elements
    return any(name in ("rot_0", "packed_rotation") for _, _, properties in elements for name, *_ in properties)


def standing(positions: np.ndarray, normals: np.ndarray, axis: int) -> float:
    """The score of an axis as the up axis of points (n, 3) with unit normals."""
    height, seen, extent = positions[:, axis], np.delete(positions, axis, axis=1), np.ptp(positions, axis=0).max()
    whole = _area(seen)
    if not whole > 0:
        return 0.0
    ends = [np.abs(height - end) < BASE * extent for end in (height.min(), height.max())]
    base, crowd = max(_area(seen[end]) for end in ends) / whole, max(np.mean(end) for end in ends)
    level = np.mean(np.abs(normals[:, axis]) > LEVEL)
    turned = positions.copy()
    turned[:, axis] = height.min() + height.max() - height
    unlike = np.minimum(cKDTree(positions).query(turned)[0] / (UNLIKE * extent), 1).mean()
    return float((base + level) / 2 + unlike - crowd)


def _area(points: np.ndarray) -> float:
    """Area of the convex hull of points (n, 2); 0 if they lie on a line."""
    try:
        return ConvexHull(points).volume if len(points) > 2 else 0.0
    except QhullError:  # all on one line
        return 0.0


class Sensor(NamedTuple):
    """Position (3,) of a sensor in the file's frame, and the up axis of its camera, if known."""

    place: np.ndarray
    up: str | None = None


def sensor_of(path: Path, kind: str, positions: np.ndarray, report: Callable[[str], None]) -> Sensor | None:
    """The sensor of a file with these points (n, 3); ValueError for a header that cannot be read."""
    if kind not in (".ply", ".pcd"):
        return None
    with path.open("rb") as file:
        header = read_header(file, kind)
        place, up = (header.sensor, None) if kind == ".pcd" else _camera(file, header)
    if place is None or not (np.abs(place) < FARTHEST).all():
        return None
    place = np.array(place)
    if header.organised or _from_there(positions, place, OPEN):
        # a depth image is in its camera's axes: y down, looking along z; or y up, looking along -z
        way = np.median(positions - place, axis=0)
        ahead = way[2] / max(float(np.linalg.norm(way)), np.finfo(np.float64).tiny)
        return Sensor(place, up or (None if abs(ahead) < AHEAD else "-y" if ahead > 0 else "y"))
    if place.any():
        if _from_there(positions, place, MOST, within=True):
            return Sensor(place, up)
        report(f"the place of the sensor left out: from {' '.join(f'{x:g}' for x in place)} few points are seen")
    return None


def _camera(file: BufferedIOBase, header: Header) -> tuple[np.ndarray | None, str | None]:
    """The place and up axis of the camera in the first element of a PLY file, None where unknown."""
    if [name for name, _, _ in header.elements][:1] != ["camera"]:
        return None, None
    _, columns, _ = next(element_pieces(file, header, "camera"))
    place, above = (np.array([columns.get(name, [np.nan])[0] for name in names], float) for names in (PLACE, UP))
    known = np.isfinite(above).all() and above.any()
    return place, max(ROTATIONS, key=lambda axis: float(np.array(ROTATIONS[axis][1]) @ above)) if known else None


def _from_there(positions: np.ndarray, place: np.ndarray, share: float, within: bool = False) -> bool:
    """Whether that share of the points is visible from a position; `within`: the answer inside their bounding box."""
    if np.all((place > positions.min(axis=0)) & (place < positions.max(axis=0))):
        return within
    return bool(find_visible(positions, place, measure_spacing(cKDTree(positions)), BEHIND).mean() > share)
