"""The pixels of a batch that a training step renders (a lattice or a square at a random place), and their error."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.config import TrainConfig
from spnr_jax.kernels import losses
from spnr_jax.kernels.records import Batch, Camera, Key


def choose_pixels(key: Key, batch: Batch, config: TrainConfig) -> tuple[Key, Batch]:
    """The key of what else a step draws, and the batch with the pixels that it renders."""
    if config.pixel_stride > 1:
        key, lattice_key = jax.random.split(key)
        batch = lattice(lattice_key, batch, config.pixel_stride)
    if config.crop:
        key, crop_key = jax.random.split(key)
        batch = crop_square(crop_key, batch, config.crop)
    return key, batch


def lattice(key: Key, batch: Batch, stride: int) -> Batch:
    """The batch with every `stride`-th row and column of its views, from a random first one on: images still."""
    first = jax.random.randint(key, (2,), 0, stride)

    def thinned(x):
        for axis, start in zip((2, 3), first, strict=True):
            x = x.reshape(*x.shape[:axis], x.shape[axis] // stride, stride, *x.shape[axis + 1 :])
            x = jax.lax.dynamic_index_in_dim(x, start, axis + 1, keepdims=False)
        return x

    # pixel i of the lattice has its centre at first + stride * i + 0.5 of the view
    shift = 0.5 - (first[::-1] + 0.5) / stride
    zoom = jnp.diag(jnp.array([1 / stride, 1 / stride, 1.0])).at[:2, 2].set(shift)
    intrinsics = jnp.einsum("ij,...jk->...ik", zoom, batch.camera.intrinsics, precision="highest")
    return _some_pixels(batch, thinned, intrinsics)


def crop_square(key: Key, batch: Batch, size: int) -> Batch:
    """The batch with a square of `size` pixels of each view, at one random place for all: images still."""
    height, width = batch.image.shape[2:4]
    first = jax.random.randint(key, (2,), 0, jnp.array([height, width]) - size + 1)

    def cut(x):
        for axis, start in zip((2, 3), first, strict=True):
            x = jax.lax.dynamic_slice_in_dim(x, start, size, axis)
        return x

    return _some_pixels(batch, cut, jnp.asarray(batch.camera.intrinsics).at[..., :2, 2].add(-first[::-1]))


def _some_pixels(batch: Batch, some: Callable[[Array], Array], intrinsics: Array) -> Batch:
    """The batch with some of the pixels of its images, which cameras of these intrinsics see."""
    images = (batch.image, batch.alpha, batch.condition, batch.condition_mask)
    image, alpha, condition, mask = (some(jnp.asarray(x)) for x in images)
    camera = Camera(
        cam_to_world=batch.camera.cam_to_world, intrinsics=intrinsics, height=image.shape[2], width=image.shape[3]
    )
    return Batch(cloud=batch.cloud, camera=camera, image=image, alpha=alpha, condition=condition, condition_mask=mask)


def pixel_error(config: TrainConfig, image: Array, reference: Array, seen: Array | None = None) -> Float[Array, ""]:
    """Mean error of all pixels, or of those that are `seen` (0 if there are none)."""
    if seen is None:
        return {"l1": losses.l1, "mse": losses.mse}[config.loss.pixel](image, reference)
    error = {"l1": jnp.abs, "mse": jnp.square}[config.loss.pixel](image - reference)
    return jnp.sum(jnp.where(seen[..., None], error, 0)) / jnp.maximum(3 * jnp.sum(seen), 1)


def reconstruction_loss(
    config: TrainConfig,
    image: Float[Array, "*batch"],
    image_lr: Float[Array, "*batch_lr"],
    reference: Array,
    seen: Array | None = None,
) -> Float[Array, ""]:
    """Weighted errors of the image, and of a smaller volume rendering against the reference averaged to its size."""
    error = pixel_error(config, image, reference, seen)
    if config.model.upsamples:
        low = losses.area_downsample(reference, image_lr.shape[-2])
        error = error + config.loss.low_resolution_weight * pixel_error(config, image_lr, low)
    error = config.loss.l1_weight * error
    return error + config.loss.mse_weight * losses.mse(image, reference) if config.loss.mse_weight else error
