"""The density of an encoded object on a grid along the axes of its file, and where that grid lies in the file.

grid[i, j, k] is the density, per unit of the file, at lowest + spacing * (i, j, k) in the file's x y z.  Density is 0
far from every point, as in rendering.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.errors import UserError
from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.kernels import occupancy, voxels
from spnr_jax.kernels.numerics import normalize
from spnr_jax.kernels.records import Rays
from spnr_jax.method.inference import network
from spnr_jax.method.model import Model, Volume
from spnr_jax.model_config import RayNetworkConfig, RenderOptions


@dataclass(frozen=True, kw_only=True)
class DensityGrid:
    """Density (x, y, z) float32 of an object; `lowest` (3,) float64 is the place of [0, 0, 0] relative to `origin`."""

    density: np.ndarray
    lowest: np.ndarray
    spacing: float
    voxel: float  # side of a voxel of the network
    origin: np.ndarray  # (3,) float64 of the file: places are split so that float32 can hold what is added to it


def sample_density(model: Model, volume: Volume, placed: PlacedCloud, resolution: int) -> DensityGrid:
    """The density in the box of an object, with `resolution` places along each side."""
    if not isinstance(model.config, RayNetworkConfig):
        raise UserError("--mesh and --density need a network with a density volume; this run's has none")
    scale = float(volume.scale)
    steps = np.linspace(-1, 1, resolution, dtype=np.float32)
    plane = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    rotation = placed.rotation.astype(np.float32)
    density = np.empty((resolution,) * 3, np.float32)
    for i, x in enumerate(steps):
        places = np.concatenate([np.full_like(plane[:, :1], x), plane], axis=-1) @ rotation.T
        values = _density_at(model.variables, volume.scene, places, config=model.config, reach=volume.reach)
        density[i] = scale * np.asarray(values).reshape(resolution, resolution)
    lowest = placed.rotation.T @ np.asarray(volume.centre, np.float64) - 1 / scale
    return DensityGrid(
        density=density,
        lowest=lowest,
        spacing=2 / (resolution - 1) / scale,
        voxel=2 / model.config.encoder.volume_resolution / scale,
        origin=placed.origin,
    )


@partial(jax.jit, static_argnames=("config", "reach"))
def _density_at(
    variables: dict, scene: Any, places: Float[Array, "n 3"], *, config: RayNetworkConfig, reach: int
) -> Array:
    """Density (n,) per unit of the box at places in the box, as seen on the way to its centre.

    That way matters to a network that turns normals to the viewer: an object is solid behind what is seen from outside.
    """
    scene = jax.tree.map(lambda x: x[None], scene)
    rays = Rays(origins=places, directions=-normalize(places))
    module = network(config).bind(variables)
    field, _ = module.along(scene, rays, jnp.zeros(len(places), jnp.int32), RenderOptions(refine=False))
    density = field(jnp.zeros((len(places), 1))).density[:, 0]
    near_points = occupancy.dilate(scene.occupied[0], reach)
    cell, _ = voxels.locate(places, len(near_points))
    return jnp.where(near_points[cell[:, 2], cell[:, 1], cell[:, 0]], density, 0.0)
