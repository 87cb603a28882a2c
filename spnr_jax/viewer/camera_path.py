"""A recorded camera path: keyframes, and the smooth motion through them.

Rotations follow SciPy's rotation spline, targets and distances monotone cubics, and the camera keeps its target in
front of it: between two opposite sides of the object the path goes around it, not through it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from spnr_jax.errors import UserError

SAME = 1e-4  # radians between two keyframes below which the spline would divide by nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Keyframe:
    """A camera in the box: rotation (3, 3) with columns right, up, backward; it looks at `distance` ahead."""

    position: np.ndarray
    rotation: np.ndarray
    distance: float


def poses(keyframes: tuple[Keyframe, ...], frames: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """(position (3,), rotation (3, 3)) at `frames` even times from the first keyframe to the last.

    ValueError for fewer than two keyframes or frames.
    """
    if len(keyframes) < 2 or frames < 2:
        raise UserError(f"a path needs at least 2 keyframes and 2 frames, got {len(keyframes)} and {frames}")
    times, at = np.arange(len(keyframes)), np.linspace(0, len(keyframes) - 1, frames)
    targets = np.stack([frame.position - frame.distance * frame.rotation[:, 2] for frame in keyframes])
    distances = PchipInterpolator(times, [frame.distance for frame in keyframes])(at)
    rotations = _rotations(times, Rotation.from_matrix(np.stack([frame.rotation for frame in keyframes])), at)
    positions = PchipInterpolator(times, targets)(at) + distances[:, None] * rotations[:, :, 2]
    return list(zip(positions, rotations, strict=True))


def _rotations(times: np.ndarray, rotations: Rotation, at: np.ndarray) -> np.ndarray:
    """Rotation matrices (frames, 3, 3); a camera that does not turn keeps its rotation."""
    if ((rotations[:-1].inv() * rotations[1:]).magnitude() < SAME).all():
        return np.broadcast_to(rotations[0].as_matrix(), (len(at), 3, 3))
    return RotationSpline(times, rotations)(at).as_matrix()
