"""Which way is up in a file of points, and where the sensor stood that saw them.

glTF is y up and laser scans (.las) are z up by definition.  Of other files y or z is chosen, whichever has the larger
(base + level) / 2 + unlike - crowd:

base     it stands on a broad base: the larger convex hull of the points within BASE of either end of the axis, over
         that of all points seen along the axis
level    it has level surfaces: the share of the points whose normal is nearly that of the axis
unlike   it ends differently above: how far the points, upside down, lie from the points, over UNLIKE, at most 1
crowd    it does not end in a panel: the larger share of the points within BASE of either end

Of 78 real objects 72 are found upright as they are and 71 turned to z up (docs/lab/readers.md); for the others there is
`--up`.

PCD headers and PLY camera elements name the place of a sensor, to which normals point; a camera's axes say which way is
up.  The place 0 0 0 that writers of PCD put there for want of a better one is believed if nothing hides the points from
it, another place if it sees most of them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from spnr_jax.formats.row_files import element_pieces, read_header
from spnr_jax.surfels.normals import estimate_normals, find_visible, measure_spacing

ROTATIONS = {  # axis of the file that points up -> rotation (rows) that makes it y
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}
BY_FORMAT = {".glb": "y", ".gltf": "y", ".las": "z", ".laz": "z"}
BASE, UNLIKE = 0.02, 0.03  # of the largest extent
LEVEL = 0.99  # least cosine between the normal of a level surface and the axis
MARGIN = 0.02  # by which z must stand better: what stands equally is y up
MOST_STANDING = 2048  # points that tell how an object stands
AHEAD = 0.5  # least cosine between the z axis of a depth camera and the way to what it sees
MOST = 0.7  # share of the points that must be seen from a place that a file names; of few points of a ball 0.61 are
OPEN = 0.9  # share of the points that is seen from where they were scanned; of a whole object it is a half
BEHIND = 5.0  # spacings behind the first of a pixel that count as seen: noise, and surfaces seen at an angle
FARTHEST = 1e30  # units, beyond which no sensor and no point lies: galaxies are 1e21 metres wide
PLACE, UP = ("view_px", "view_py", "view_pz"), ("y_axisx", "y_axisy", "y_axisz")  # of VCGLIB's element `camera`


def find_up(positions: np.ndarray, kind: str, *, of_splats: bool = False) -> tuple[str, str]:
    """(up axis, how it was found) of points (n, 3) from a file of a kind; splats of a .ply have y down."""
    if kind in BY_FORMAT:
        return BY_FORMAT[kind], f"by the format {kind}"
    positions = positions[:: -(-len(positions) // MOST_STANDING)]
    normals = estimate_normals(positions, cKDTree(positions))
    scores = {axis: standing(positions, normals, "xyz".index(axis)) for axis in "yz"}
    up = "z" if scores["z"] > scores["y"] + MARGIN else "y"
    reason = f"y stands {scores['y']:.2f}, z {scores['z']:.2f}"
    return ("-y", f"{reason}; splats have y down") if of_splats and up == "y" else (up, reason)


def holds_splats(path: Path, kind: str) -> bool:
    """Whether it is a .ply of Gaussian splats: their tools write axes right, down, forward."""
    if kind != ".ply":
        return False
    with path.open("rb") as file:
        elements = read_header(file, kind).elements
    return any(name in ("rot_0", "packed_rotation") for _, _, properties in elements for name, *_ in properties)


def standing(positions: np.ndarray, normals: np.ndarray, axis: int) -> float:
    """How much points (n, 3) with unit normals look like an object that stands along an axis."""
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
    """Area of the convex hull of points (n, 2), 0 where there is none."""
    try:
        return ConvexHull(points).volume if len(points) > 2 else 0.0
    except QhullError:  # all on one line
        return 0.0


class Sensor(NamedTuple):
    """The place (3,) of a sensor in the file's frame, and the axis that is up for its camera, where it is known."""

    place: np.ndarray
    up: str | None = None


def sensor_of(path: Path, kind: str, positions: np.ndarray, report: Callable[[str], None]) -> Sensor | None:
    """The sensor of a file of these points (n, 3) or faces; ValueError for a header that cannot be read."""
    if kind == ".ply":
        return _camera_of(path)
    if kind != ".pcd":
        return None
    with path.open("rb") as file:
        header = read_header(file, kind)
    if header.sensor is None or max(map(abs, header.sensor)) > FARTHEST:
        return None
    place = np.array(header.sensor)
    if header.organised or _from_there(positions, place, OPEN):
        # a depth image is in its camera's axes, which are y down looking along z or y up looking against it
        way = np.median(positions - place, axis=0)
        ahead = way[2] / max(float(np.linalg.norm(way)), np.finfo(np.float64).tiny)
        return Sensor(place, None if abs(ahead) < AHEAD else "-y" if ahead > 0 else "y")
    if place.any():
        if _from_there(positions, place, MOST, within=True):
            return Sensor(place)
        report(f"the place of the sensor left out: from {' '.join(f'{x:g}' for x in place)} few points are seen")
    return None


def _camera_of(path: Path) -> Sensor | None:
    """The camera that a PLY file begins with."""
    with path.open("rb") as file:
        header = read_header(file, ".ply")
        if [name for name, _, _ in header.elements][:1] != ["camera"]:
            return None
        _, columns, _ = next(element_pieces(file, header, "camera"))
    place, above = (np.array([columns.get(name, [np.nan])[0] for name in names], float) for names in (PLACE, UP))
    if not (np.abs(place) < FARTHEST).all():
        return None
    if not (np.isfinite(above).all() and above.any()):
        return Sensor(place)
    return Sensor(place, max(ROTATIONS, key=lambda axis: float(np.array(ROTATIONS[axis][1]) @ above)))


def _from_there(positions: np.ndarray, place: np.ndarray, share: float, within: bool = False) -> bool:
    """Whether that share of the points is seen from a place; `within` if one inside of their bounding box counts."""
    if np.all((place > positions.min(axis=0)) & (place < positions.max(axis=0))):
        return within
    return bool(find_visible(positions, place, measure_spacing(positions), BEHIND).mean() > share)
