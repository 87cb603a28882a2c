"""What the surfel network is timed on: points of a sphere before a camera, and crops of random numbers."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed import bench_scene
from spnr_jax.config import TrainConfig
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Crops, PointCloud
from spnr_jax.surfels import features
from spnr_jax.training import gbuffers

FIELD_OF_VIEW = 2 * float(np.arctan(1 / bench_scene.FOCAL))
CLOSE = 2.2  # distance at which the sphere nearly fills the picture


def sphere(count: int, seed: int = 0) -> PointCloud:
    """So many points of a sphere with random materials and its normals."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return PointCloud(
        positions=bench_scene.SPHERE * normals,
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
