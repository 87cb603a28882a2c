"""The density of an encoded object on a grid; it is 0 far from every point, as in rendering."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.config import RayNetworkConfig, RenderOptions
from spnr_jax.errors import UserError
from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.kernels import occupancy, voxels
from spnr_jax.kernels.numerics import normalize
from spnr_jax.kernels.records import Rays, Volume
from spnr_jax.method.inference import network
from spnr_jax.method.model import Model
from spnr_jax.tools.grids import Grid, over_box


def sample_density(model: Model, volume: Volume, placed: PlacedCloud, resolution: int) -> Grid:
    """The density per unit of the file in the box of an object, with `resolution` places along each side."""
    if not isinstance(model.config, RayNetworkConfig):
        raise UserError("--density needs a network with a density volume; this run's has none")

    def density(places: Float[np.ndarray, "places 3"]) -> Array:
        values = _density_at(model.variables, volume.scene, places, config=model.config, reach=volume.reach)
        return volume.scale * values

    return over_box(density, volume, placed, resolution)


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
