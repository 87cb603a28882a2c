"""A Linen network as functions of fixed sizes, over dicts of arrays.

volume      scene: the arrays of the network's own, centre (3), scale ()
picture     image (h, w, 3) sRGB on white, image_lr; depth, acc
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax.serialization import from_state_dict, to_state_dict
from jaxtyping import Array, Bool, Float

from spnr_jax.config import Quality
from spnr_jax.kernels.records import Camera, PointCloud, Volume
from spnr_jax.method import inference
from spnr_jax.method.model import Model
from spnr_jax.tools.surfel_export import camera_shapes, cloud_shapes

Arrays = dict[str, Any]


def export_encode(model: Model, *, num_points: int) -> tuple[Callable[..., Arrays], tuple[Arrays, ...]]:
    """The function `cloud -> volume`, and what it takes."""

    def encode(cloud: Arrays) -> Arrays:
        scene, centre, scale = _encode(model, cloud)
        return {"scene": to_state_dict(scene), "centre": centre, "scale": scale}

    return encode, (cloud_shapes(num_points),)


def export_render(
    model: Model, *, num_points: int, size: int, quality: Quality, reach: int, plan: object
) -> tuple[Callable[..., Arrays], tuple[Arrays, ...]]:
    """The function `(volume, camera) -> picture`, and what it takes."""
    del num_points, plan
    scene, centre, scale = jax.eval_shape(partial(_encode, model), cloud_shapes(num_points=2))

    def render(volume: Arrays, camera: Arrays) -> Arrays:
        encoded = Volume(**volume | {"scene": from_state_dict(scene, volume["scene"])}, reach=reach)
        drawn = model.render(encoded, Camera(**camera, height=size, width=size), quality)
        return {name: values for name, values in to_state_dict(drawn).items() if values is not None}

    return render, ({"scene": to_state_dict(scene), "centre": centre, "scale": scale}, camera_shapes())


def box_around(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Centre and scale of `cloud_arrays.normalization` for the points that are not masked.

    In float32, so the scale may differ in its last bits from that of `Model.encode`, which is computed in float64.
    """
    low = jnp.min(jnp.where(mask[:, None], positions, jnp.inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], positions, -jnp.inf), axis=0)
    diagonal = jnp.sqrt(jnp.sum((high - low) ** 2))
    return (low + high) / 2, jnp.where(diagonal > 0, 2 / jnp.where(diagonal > 0, diagonal, 1), 1)


def _encode(model: Model, cloud: Arrays) -> tuple[Any, Array, Array]:
    """Scene, centre and scale that `Model.encode` keeps of a padded cloud, as a pure function."""
    centre, scale = box_around(cloud["positions"], cloud["mask"])
    inside = jnp.clip((cloud["positions"] - centre[None]) * scale, -1, 1)
    one_object = jax.tree.map(lambda x: x[None], PointCloud(**cloud | {"positions": inside}))
    scene = inference.encode(model.variables, one_object, config=model.config)
    return jax.tree.map(lambda x: x[0], scene), centre, scale
