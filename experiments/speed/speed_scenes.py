"""Scenes of made-up objects, which the commands that measure speed draw: no time depends on what they show.

Surface points of spheres and boxes (how many voxels are occupied decides what empty space is worth), orbiting cameras,
images and crops of random numbers.
"""

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.config import TrainConfig
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Crops, PointCloud
from spnr_jax.surfels import features
from spnr_jax.training import gbuffers

SPHERE, BOX = 0.7, 0.55  # radius and half side, in the box [-1, 1]^3
DISTANCE, FOCAL = 3.2, 2.4  # of the cameras; 1 / tan of half the field of view
FIELD_OF_VIEW = 2 * float(np.arctan(1 / FOCAL))
CLOSE = 2.2  # distance at which the sphere nearly fills the picture


def arrays(batch: int, size: int, num_points: int, seed: int = 0) -> dict[str, np.ndarray]:
    """A batch by the names of the PyTorch twin: spheres and boxes by turns, images (batch, channels, size, size)."""
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
    return {name: np.asarray(array, np.float32) for name, array in found.items()}


def pose(azimuth: float, elevation: float) -> np.ndarray:
    """Camera-to-world matrix (3, 4) that looks at the origin, y up, angles in radians."""
    backward = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    return np.stack([right, np.cross(backward, right), backward, DISTANCE * backward], axis=-1)


def sphere(count: int, seed: int = 0) -> PointCloud:
    """So many points of a sphere with random materials and its normals."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return PointCloud(
        positions=SPHERE * normals,
        base_color=rng.random((count, 3), np.float32),
        roughness=rng.random(count, np.float32),
        metallic=rng.random(count, np.float32),
        normals=normals,
        mask=np.ones(count, bool),
    )


def orbiting(size: int, azimuth: float = 0.5) -> Camera:
    """A camera around the origin whose pictures have this size."""
    pose = cameras.orbit(azimuth, elevation=0.35, distance=CLOSE, centre=jnp.zeros(3))
    return cameras.pinhole(pose, FIELD_OF_VIEW, size, size)


def random_crops(config: TrainConfig, doublings: int, seed: int = 0) -> Crops:
    """A batch as `gbuffers.make_batch` makes it, of random numbers."""
    rng = np.random.default_rng(seed)
    count = config.batch_objects
    size, margin = (-(-config.crop * n[doublings] // gbuffers.SIZES[0]) for n in (gbuffers.SIZES, gbuffers.MARGINS))
    inner = size - 2 * margin
    large = inner << doublings
    crops = Crops(
        seen=rng.random((count, size, size, features.NUM_FEATURES), np.float32),
        maps=rng.random((count, inner, inner, features.NUM_MAPS), np.float32),
        ambient=rng.random((count, 9, 3), np.float32),
        target=rng.integers(0, 256, (count, large, large, 4), np.uint8),
        doublings=doublings,
        margin=margin,
    )
    return jax.device_put(crops)
