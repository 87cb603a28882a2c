"""The scene that both sides of the benchmark render, under the twin's names.

NumPy alone: neither side's memory may hold the other's framework.

Surface points of spheres and boxes as in the twin's own timings (how many voxels are occupied decides what empty space
is worth), orbiting cameras, and images of random numbers: no mode's time depends on their values.
"""

import numpy as np

SPHERE, BOX = 0.7, 0.55  # radius and half side, in the box [-1, 1]^3
DISTANCE, FOCAL = 3.2, 2.4  # of the cameras; 1 / tan of half the field of view
BATCHES = {"tiny": 2, "small": 2, "abo": 1}  # objects of a batch, one view of each
NUM_POINTS = 1024


def arrays(batch: int, size: int, num_points: int = NUM_POINTS, seed: int = 0) -> dict[str, np.ndarray]:
    """ "in/*" of a batch: spheres and boxes by turns, images (batch, channels, size, size)."""
    rng = np.random.default_rng(seed)
    sphere = rng.normal(size=(batch, num_points, 3))
    sphere /= np.linalg.norm(sphere, axis=-1, keepdims=True)
    box = sphere / np.abs(sphere).max(axis=-1, keepdims=True)
    is_sphere = np.arange(batch)[:, None, None] % 2 == 0
    found = {
        "pos": np.where(is_sphere, SPHERE * sphere, BOX * box),
        "mat": rng.random((batch, num_points, 5)),
        "c2w": np.stack([pose(*rng.uniform((0, -0.36), (2 * np.pi, 0.84))) for _ in range(batch)]),
        "focal": np.full(batch, FOCAL),
        "target": rng.random((batch, 3, size, size)),
        "cond": rng.random((batch, 3, size, size)),
        "mask": rng.random((batch, 1, size, size)) < 0.5,
    }
    return {f"in/{name}": np.asarray(array, np.float32) for name, array in found.items()}


def pose(azimuth: float, elevation: float) -> np.ndarray:
    """Camera-to-world matrix (3, 4) that looks at the origin, y up, angles in radians."""
    backward = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    return np.stack([right, np.cross(backward, right), backward, DISTANCE * backward], axis=-1)
