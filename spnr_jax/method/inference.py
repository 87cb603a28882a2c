"""The functions of a method whose network is a Linen module (`methods.network`), and its loss.

    encode, render               batches of objects, in the box; pure
    loss                         loss of a training batch; pure
    encode_object, render_each   one object, compiled: for the handle (model.py), scores and the viewer

The module has `encode(cloud, train)`, `render(scene, camera)` and `__call__(cloud, camera, key, train)`.
Values sown into the collection "losses" are added to the loss.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.config import NetworkConfig, TrainConfig
from spnr_jax.devices.runtime import QUICK
from spnr_jax.errors import UserError, check_kind
from spnr_jax.kernels import cameras, cloud_arrays, losses
from spnr_jax.kernels.metrics import psnr
from spnr_jax.kernels.records import Batch, Camera, Key, Light, PointCloud, Rendering, Volume
from spnr_jax.methods import Outcome, network


def init(key: Key, config: NetworkConfig) -> dict:
    """Fresh variables of a config's network."""
    return dict(network(config).init(key, *example_inputs(config)))


def example_inputs(config: NetworkConfig) -> tuple[PointCloud, Camera]:
    """The smallest valid inputs of the generator, to initialise its parameters."""
    points, size = jnp.zeros((1, 2, 3)), config.image_resolution
    scalars = jnp.zeros((1, 2))
    cloud = PointCloud(
        positions=points, base_color=points, roughness=scalars, metallic=scalars, mask=jnp.ones((1, 2), bool)
    )
    pose = jnp.concatenate([jnp.eye(3), jnp.array([[0.0], [0.0], [3.0]])], axis=1)
    return cloud, Camera(cam_to_world=pose[None, None], intrinsics=jnp.eye(3)[None, None], height=size, width=size)


def encode(variables: dict, cloud: PointCloud, *, config: NetworkConfig) -> Any:
    """Encoded scenes of a batch of clouds; all arrays have a leading axis of objects."""
    return network(config).bind(variables).encode(cloud)


def render(variables: dict, scene: Any, camera: Camera, *, config: NetworkConfig) -> Rendering:
    """Views of encoded scenes; without jitter, each sample lies in the middle of its stratum."""
    return network(config).bind(variables).render(scene, camera)


# --- training ---------------------------------------------------------------------------------------------------------


def loss(
    variables: dict, batch: Batch, key: Key | None = None, *, config: TrainConfig
) -> tuple[Float[Array, ""], Outcome]:
    """(loss, outcome): errors of the rendered pixels, plus the losses that the network sows."""
    rendering, updated = network(config.model).apply(
        variables, batch.cloud, batch.camera, key, train=True, mutable=["batch_stats", "losses"]
    )
    terms = {name: value for name, (value,) in updated.get("losses", {}).items()}
    if config.loss.opacity_weight or config.loss.opacity_l1_weight:
        opacity = losses.area_downsample(jnp.asarray(batch.alpha)[..., None], rendering.acc.shape[-1])[..., 0]
        terms["opacity"] = opacity_loss(config, rendering.acc, opacity)
    reference = jnp.asarray(batch.image)
    value = reconstruction_loss(config, rendering.image, rendering.image_lr, reference)
    metrics = {"psnr": jnp.mean(psnr(rendering.image, reference)), "l1": losses.l1(rendering.image, reference)}
    return sum(terms.values(), value), Outcome(metrics | terms, updated.get("batch_stats", {}), rendering.image, batch)


def opacity_loss(
    config: TrainConfig, opacity: Float[Array, "*batch"], reference: Float[Array, "*batch"]
) -> Float[Array, ""]:
    """Weighted squared error and L1 of the opacity."""
    squared = config.loss.opacity_weight * losses.mse(opacity, reference)
    return squared + config.loss.opacity_l1_weight * losses.l1(opacity, reference)


def reconstruction_loss(
    config: TrainConfig,
    image: Float[Array, "*batch"],
    image_lr: Float[Array, "*batch_lr"] | None,
    reference: Array,
) -> Float[Array, ""]:
    """Weighted errors of the image, and L1 of the low-resolution rendering against the downsampled reference."""
    error = losses.l1(image, reference)
    if config.model.upsamples:
        assert image_lr is not None, "a network that upsamples returns image_lr"
        low = losses.area_downsample(reference, image_lr.shape[-2])
        error = error + config.loss.low_resolution_weight * losses.l1(image_lr, low)
    error = config.loss.l1_weight * error
    if config.loss.mse_weight:
        error = error + config.loss.mse_weight * losses.mse(image, reference)
    return error


# --- pictures ---------------------------------------------------------------------------------------------------------


def encode_object(
    variables: dict, cloud: PointCloud, centre: np.ndarray, scale: np.floating, *, config: NetworkConfig
) -> Volume:
    """Volume of a cloud in the box (unbatched); compiled once per padded size."""
    cloud = dataclasses.replace(cloud, normals=None, materials_known=None)
    cloud = cloud_arrays.pad(cloud, cloud_arrays.bucket(len(np.asarray(cloud.positions))))
    scene = _encode(variables, cloud, config=config)
    return Volume(scene=scene, centre=jnp.asarray(centre), scale=jnp.asarray(scale))


def render_each(
    variables: dict,
    volume: Volume,
    views: Sequence[Camera],
    lights: Sequence[Light | None],
    *,
    config: NetworkConfig,
    quality: str = "trained",
) -> Iterator[Rendering]:
    """Views one after the other.  UserError for a light, or for odd sizes if the network doubles the resolution."""
    check_kind(volume, Volume, "render: expected a volume of this network's Model.encode")
    del quality  # these networks have one
    for view, light in zip(views, lights, strict=True):
        if light is not None:
            raise UserError("this network knows the light of its training alone; give no light")
        if config.upsamples and (view.height % 2 or view.width % 2):
            raise UserError(f"this network doubles its pictures: {view.width} x {view.height} pixels must be even")
        yield _render(variables, volume.scene, volume.centre, volume.scale, view, config=config)


# Compiled as a whole: outside of jit, each operation would be compiled alone, 30 ms each at the first call.


# this option halves the compilation time of the U-Net and does not slow it down; rendering would take twice as long
@partial(jax.jit, static_argnames="config", compiler_options=QUICK)
def _encode(variables: dict, cloud: PointCloud, *, config: NetworkConfig) -> Any:
    """The encoding of a cloud in the box (unbatched)."""
    scene = encode(variables, jax.tree.map(lambda x: x[None], cloud), config=config)
    return jax.tree.map(lambda x: x[0], scene)


@partial(jax.jit, static_argnames="config")
def _render(
    variables: dict,
    scene: Any,
    centre: Float[Array, "3"],
    scale: Float[Array, ""],
    camera: Camera,
    *,
    config: NetworkConfig,
) -> Rendering:
    """One view; depth in the cloud's units."""
    scene, inside = jax.tree.map(lambda x: x[None], (scene, cameras.move_into_box(camera, centre, scale)))
    rendering = render(variables, scene, jax.tree.map(lambda x: x[None], inside), config=config)
    rendering = dataclasses.replace(rendering, depth=rendering.depth / scale)
    return jax.tree.map(lambda x: x[0, 0], rendering)
