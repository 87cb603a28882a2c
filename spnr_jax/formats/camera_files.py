"""Camera files in the convention of NeRF and nerfstudio (transforms.json).

Each entry of `frames` has a `transform_matrix`: camera to world, OpenGL axes (x right, y up, looking along -z).
Intrinsics belong to a frame or to the whole file: `w` and `h` in pixels, `fl_x` or `camera_angle_x`, and optionally
`fl_y`, `cx` and `cy`.  With `camera_angle_x` alone, as in the original NeRF's files, pictures are square.  Cameras are
pinholes: lens distortion is ignored.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spnr_jax.config import MOST_PIXELS
from spnr_jax.errors import UserError
from spnr_jax.kernels.cameras import is_rotation
from spnr_jax.kernels.records import Camera

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "FULL_OPENCV", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
PIXELS = {"w", "h", "fl_x", "fl_y", "cx", "cy"}  # entries in pixels
SIZE = 512  # width and height if a file has none of these
EXPECTED = "expected the transforms.json of NeRF or nerfstudio: frames with transform_matrix, w, h and fl_x"


def read_cameras(
    path: str | Path,
    *,
    rotation: np.ndarray | None = None,
    origin: np.ndarray | None = None,
    size: int = SIZE,
    report: Callable[[str], None] = lambda line: None,
) -> list[Camera]:
    """The cameras of a file, in its frame or, if given, in the frame of rotation @ (position - origin).

    `size`: width and height in pixels if the file has neither `w` nor `h`.  `report` gets a line if lens distortion is
    ignored.  ValueError, one line that names the file, if it has no valid cameras.
    """
    return cameras_of(read_document(path, report), rotation, origin, size)


def read_document(path: str | Path, report: Callable[[str], None] = lambda line: None) -> Mapping[str, Any]:
    """The checked content of a camera file, for `cameras_of`; report and errors as of `read_cameras`."""
    try:
        document = json.loads(Path(path).read_bytes())
        cameras_of(document)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from None
    except (UserError, KeyError) as error:
        missing = "no entry " if isinstance(error, KeyError) else ""
        raise UserError(f"{path}: {missing}{error}; {EXPECTED}") from None
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise UserError(f"{path}: no valid JSON, or something else where a number should be; {EXPECTED}") from None
    if any(frame.get(name) for frame in (document, *document["frames"]) for name in DISTORTION):
        report("lens distortion is left out: pinhole cameras are drawn")
    return document


def cameras_of(
    document: Mapping[str, Any], rotation: np.ndarray | None = None, origin: np.ndarray | None = None, size: int = SIZE
) -> list[Camera]:
    """The cameras of a file's content, float32; KeyError for a missing entry, Type- or ValueError for a wrong one."""
    turn, place = np.eye(3) if rotation is None else rotation, np.zeros(3) if origin is None else origin
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise UserError("no frames")
    entries = ({**document, **frame} for frame in frames)
    square = {"w": size, "h": size}
    sized = (square | of if "camera_angle_x" in of and not PIXELS & of.keys() else of for of in entries)
    return [_camera(of, number, turn, place) for number, of in enumerate(sized)]


@np.errstate(all="ignore")  # overflow in float32 gives infinity, which is refused
def _camera(entries: Mapping[str, Any], number: int, rotation: np.ndarray, origin: np.ndarray) -> Camera:
    """One camera; in float64 until the origin is subtracted."""
    model, fisheye = str(entries.get("camera_model") or "PINHOLE"), entries.get("is_fisheye")
    if fisheye or model.upper() not in PINHOLES:
        found = "a fisheye" if fisheye else f"camera_model {model}"
        raise UserError(f"{found}, where pinhole cameras are drawn")
    width, height = (int(entries[name]) for name in "wh")
    if not 1 <= min(width, height) <= max(width, height) <= MOST_PIXELS:
        raise UserError(f"{width} x {height} pixels in frame {number}, where 1 to {MOST_PIXELS} are drawn")
    if "fl_x" not in entries and "camera_angle_x" in entries:
        across = 0.5 * width / np.tan(0.5 * float(entries["camera_angle_x"]))
    else:
        across = float(entries["fl_x"])
    down, cx, cy = (float(entries.get(*x)) for x in (("fl_y", across), ("cx", width / 2), ("cy", height / 2)))
    intrinsics = np.array([[across, 0, cx], [0, down, cy], [0, 0, 1]], np.float32)
    matrix = np.asarray(entries["transform_matrix"], np.float64)
    finite = np.isfinite(matrix.astype(np.float32)).all() and np.isfinite(intrinsics).all()
    if matrix.shape not in ((4, 4), (3, 4)) or not finite:
        raise UserError(f"a camera holds NaN or infinity, or is no 4 x 4 matrix (frame {number})")
    if not min(intrinsics[0, 0], intrinsics[1, 1]) > 0:
        raise UserError(f"focal lengths {across:g} and {down:g} in frame {number}, expected positive ones")
    turn = matrix[:3, :3]
    if not is_rotation(turn):
        raise UserError(f"the rotation of frame {number} is not orthonormal")
    pose = np.concatenate([rotation @ turn, (rotation @ (matrix[:3, 3] - origin))[:, None]], axis=1)
    return Camera(cam_to_world=pose.astype(np.float32), intrinsics=intrinsics, height=height, width=width)


def describe_cameras(cameras: Sequence[Camera], names: Sequence[str], rotation: np.ndarray, origin: np.ndarray) -> dict:
    """The content of a camera file: `read_cameras` with this rotation and origin gives these cameras back."""
    intrinsics = [_intrinsics(camera) for camera in cameras]
    common = {name: x for name, x in intrinsics[0].items() if all(other[name] == x for other in intrinsics)}
    frames = []
    for name, camera, numbers in zip(names, cameras, intrinsics, strict=True):
        pose = np.eye(4)
        pose[:3] = rotation.T @ np.asarray(camera.cam_to_world, np.float64)
        pose[:3, 3] += origin
        own = {key: x for key, x in numbers.items() if key not in common}
        frames.append({"file_path": name, "transform_matrix": pose.tolist()} | own)
    return {"camera_model": "OPENCV", **common, "frames": frames}


def _intrinsics(camera: Camera) -> dict[str, int | float]:
    (fl_x, _, cx), (_, fl_y, cy), _ = np.asarray(camera.intrinsics, np.float64).tolist()
    return {"w": camera.width, "h": camera.height, "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}
