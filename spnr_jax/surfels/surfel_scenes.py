"""A cloud as the renderer takes it: its surfels in the box, with the way from the cloud's units to there."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.devices.runtime import QUICKEST
from spnr_jax.devices.traces import Kept
from spnr_jax.kernels import cloud_arrays
from spnr_jax.kernels.numerics import clamp, length
from spnr_jax.kernels.records import AnyArray, PointCloud, Surfels, SurfelScene
from spnr_jax.surfels.geometry import estimate_surfels, median
from spnr_jax.surfels.neighbors import order_in_space
from spnr_jax.surfels.rules import RULES, Rules
from spnr_jax.surfels.small_systems import largest, smallest


def encode(params: Any, cloud: PointCloud, neighbors: Int[AnyArray, "points 20"]) -> SurfelScene:
    """The surfels of a cloud (unbatched, any units, y up); pure: jit, vmap over equally padded clouds, grad, float64.

    `neighbors` are `spnr_jax.neighbors(cloud)`.  Positions, normals and colors must be finite, those of padding too.
    The network's `params` are not needed by surfels; they stand here for networks that encode.  All clouds have one
    structure, whether or not they have normals.  Gradients flow through the box as well: a shift of all points moves
    the scene's centre.  What is a constant to them is said in `geometry.py`.
    """
    del params
    inside, centre, scale = move_into_box(cloud)
    return _make_scene(inside, neighbors, centre, scale, RULES)


def move_into_box(cloud: PointCloud) -> tuple[PointCloud, Float[Array, "3"], Float[Array, ""]]:
    """The cloud in the box [-1, 1]^3, and the centre and scale of the way there."""
    positions = jnp.asarray(cloud.positions)
    centre, scale = fit_box(positions, jnp.asarray(cloud.mask))
    inside = clamp((positions - centre[None]) * scale, -1, 1)
    return dataclasses.replace(cloud, positions=inside), centre, scale


def fit_box(
    positions: Float[AnyArray, "points 3"], mask: Bool[AnyArray, " points"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Centre and scale: (positions - centre) * scale has its bounding box around 0, with half diagonal 1.

    The scale of points without extent is 1.  Masked points do not count.
    """
    some = jnp.any(mask)
    low = smallest(jnp.where(mask[:, None], positions, jnp.inf))
    high = largest(jnp.where(mask[:, None], positions, -jnp.inf))
    low, high = jnp.where(some, low, 0), jnp.where(some, high, 0)
    diagonal = length(high - low)
    scale = jnp.where(diagonal > 0, 2 / jnp.where(diagonal > 0, diagonal, 1), 1)
    return low / 2 + high / 2, scale


def encode_in_box(cloud: PointCloud) -> SurfelScene:
    """Scene of a cloud in the box (unbatched), of centre 0 and scale 1; on the host, compiled once for a bucket.

    Its surfels are those of the real points in an order in which close ones follow each other, padded.
    """
    real = cloud_arrays.strip(cloud)
    real = jax.tree.map(np.float32, real).replace(mask=real.mask)
    order, near = order_in_space(real.positions)
    size = cloud_arrays.bucket(len(order))
    neighbors = np.pad(near, [(0, size - len(order)), (0, 0)], constant_values=-1)
    return _encode(cloud_arrays.pad(jax.tree.map(lambda x: x[order], real), size), neighbors)


def _make_scene(
    cloud: PointCloud, neighbors: Int[AnyArray, "points 20"], centre: Array, scale: Array, rules: Rules
) -> SurfelScene:
    surfels = estimate_surfels(cloud, jnp.asarray(neighbors), rules)
    spacing = median(jnp.asarray(surfels.spacing), jnp.asarray(surfels.mask))
    return SurfelScene(surfels=surfels, spacing=spacing, centre=centre, scale=scale)


@partial(Kept, returns=(SurfelScene, Surfels), options=QUICKEST)
def _encode(cloud: PointCloud, neighbors: Int[Array, "points 20"]) -> SurfelScene:
    return _make_scene(cloud, neighbors, jnp.zeros(3), jnp.ones(()), RULES)
