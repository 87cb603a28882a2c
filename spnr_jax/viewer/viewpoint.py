"""Where a browser looks from, and how its canvas is cut into panes that all show the same view.

The browser lives in the network's box, (position - centre) * scale of the cloud: whatever the cloud's units, its camera
is a few units away.  `field_of_view` is vertical, in radians.  The canvas is `panes` columns of equal width; every pane
has the view's camera with its own aspect ratio, so a place in one pane is the same place in all of them.  The network
draws squares, one program for each size: the square that covers a pane is rendered, and what stands out is cut away.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from spnr_jax.kernels.records import Camera, Volume

FARTHEST = 1e3  # boxes; beyond, float32 rays miss (README, "Numerical domain")
MOST_PIXELS = 2**16  # along a side of a browser's canvas
NARROWEST = 1e-3  # radians
WIDEST = np.deg2rad(150)
OPENCV = np.diag([1.0, -1.0, -1.0])  # the browser's cameras look along +z with y down, ours along -z with y up


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A camera in the box: rotation columns are right, up and backward; the canvas is in pixels."""

    position: np.ndarray
    rotation: np.ndarray
    field_of_view: float
    width: int
    height: int


def numbers(values: Any, *shape: int) -> np.ndarray | None:
    """What a browser sent as finite numbers of a shape, None if it is something else."""
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.shape == shape and np.isfinite(array).all() else None


def from_browser(wxyz: Any, position: Any, field_of_view: Any, width: Any, height: Any) -> View | None:
    """The view of a browser's message of any values; None if nothing can be drawn from it (NaN, no pixels, far)."""
    turn, place, canvas = numbers(wxyz, 4), numbers(position, 3), numbers([field_of_view, width, height], 3)
    if turn is None or place is None or canvas is None:
        return None
    drawable = (
        np.linalg.norm(turn) > 1e-6
        and (np.abs(place) < FARTHEST).all()
        and NARROWEST <= canvas[0] <= WIDEST
        and (canvas[1:] >= 2).all()
        and (canvas[1:] <= MOST_PIXELS).all()
    )
    if not drawable:
        return None
    rotation = Rotation.from_quat(turn, scalar_first=True).as_matrix() @ OPENCV
    pixels, lines = (int(count) for count in canvas[1:])
    return View(position=place, rotation=rotation, field_of_view=float(canvas[0]), width=pixels, height=lines)


def to_browser(rotation: np.ndarray) -> np.ndarray:
    """The quaternion (w, x, y, z) that a browser calls a rotation (3, 3) with columns right, up, backward."""
    return Rotation.from_matrix(rotation @ OPENCV).as_quat(scalar_first=True)


def pane_size(view: View, panes: int, longest: int) -> tuple[int, int]:
    """(width, height) of a pane in pixels, on a canvas whose longer side is drawn with at most `longest`."""
    shrink = min(1.0, longest / max(view.width, view.height))
    return max(round(view.width * shrink / panes), 1), max(round(view.height * shrink), 1)


def pane_camera(view: View, volume: Volume, width: int, height: int) -> Camera:
    """Camera of a pane of so many pixels, in the cloud's units."""
    focal = 0.5 * height / np.tan(view.field_of_view / 2)
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    position = view.position / float(volume.scale) + np.asarray(volume.centre, np.float64)
    pose = np.concatenate([view.rotation, position[:, None]], axis=1).astype(np.float32)
    return Camera(cam_to_world=pose, intrinsics=intrinsics, height=height, width=width)


def project(camera: Camera, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(pixels (points, 2) as column and row, depth (points,)) of positions (points, 3); NaN pixels behind the camera.

    As `cameras.project`, in NumPy: points are on the screen before anything is compiled.
    """
    pose, intrinsics = np.asarray(camera.cam_to_world, np.float64), np.asarray(camera.intrinsics, np.float64)
    x, y, z = ((positions - pose[:, 3]) @ pose[:, :3]).T
    depth = np.where(z < 0, -z, np.nan)
    pixels = np.stack([x / depth, -y / depth], axis=-1) * intrinsics[0, 0] + intrinsics[:2, 2]
    return pixels, -z


def square_camera(view: View, volume: Volume, width: int, height: int, size: int) -> Camera:
    """Camera of `size` x `size` pixels that sees all of a pane of width x height, and the same middle."""
    covering = 2 * np.arctan(np.tan(view.field_of_view / 2) * max(width / height, 1.0))
    return pane_camera(dataclasses.replace(view, field_of_view=float(covering)), volume, size, size)


def cut(square: np.ndarray, width: int, height: int) -> np.ndarray:
    """The middle of a square picture, uint8 (size, size, 3), as a pane of width x height."""
    size, longest = len(square), max(width, height)
    across, down = size * width / longest / 2, size * height / longest / 2
    middle = (size / 2 - across, size / 2 - down, size / 2 + across, size / 2 + down)
    return np.asarray(Image.fromarray(square).resize((width, height), Image.Resampling.BICUBIC, box=middle))


def in_pane(x: float, y: float, middle: float, panes: int) -> tuple[float, float]:
    """A place on the canvas as shares of one pane, that in which the place with x = `middle` lies; all are shares."""
    pane = int(np.clip(np.floor(middle * panes), 0, panes - 1))
    return x * panes - pane, y
