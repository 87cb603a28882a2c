"""A ball of Gaussian splats whose colour follows the place and the view, and cameras around it."""

import jax.numpy as jnp
import numpy as np

from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Gaussians
from spnr_jax.method.model import FIELD_OF_VIEW
from spnr_jax.surfels import gaussians
from spnr_jax.surfels.gaussians import C0, count_coefficients


def ball(count: int = 400, degree: int = 1, radius: float = 0.8, seed: int = 0) -> Gaussians:
    """Splats evenly on a sphere, red to the right, green above, a little lighter from one side."""
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    height = 1 - (2 * np.arange(count) + 1) / count
    around = np.sqrt(1 - height**2)
    normal = np.stack([around * np.cos(turn), height, around * np.sin(turn)], axis=-1)
    width = 1.2 * radius / np.sqrt(count)
    harmonics = np.zeros((count, count_coefficients(degree), 3), np.float32)
    harmonics[:, 0] = 0.3 * normal / C0
    harmonics[:, 1:] = 0.1 * np.random.default_rng(seed).normal(size=harmonics[:, 1:].shape)
    return Gaussians(
        position=(radius * normal).astype(np.float32),
        rotation=gaussians.rotate_to(normal).astype(np.float32),
        scale=np.broadcast_to(np.float32([width, 0.7 * width, 0.1 * width]), (count, 3)).copy(),
        opacity=np.linspace(0.5, 0.95, count, dtype=np.float32),
        harmonics=harmonics,
    )


def camera(azimuth: float = 30.0, elevation: float = 20.0, size: int = 48, distance: float = 3.0) -> Camera:
    """A square camera as `Model.camera` places it."""
    angles = np.float32(np.deg2rad(azimuth)), np.float32(np.deg2rad(elevation))
    pose = cameras.orbit(jnp.asarray(angles[0]), jnp.asarray(angles[1]), jnp.float32(distance), jnp.zeros(3))
    return cameras.pinhole(pose, float(FIELD_OF_VIEW), size, size)
