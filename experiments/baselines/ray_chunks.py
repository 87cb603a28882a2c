"""Baselines whose rays know nothing of each other: pictures, some rays at a time, and training on some pixels."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.config import LossConfig
from spnr_jax.errors import require
from spnr_jax.kernels.records import Batch, Camera, Key, Rendering

SQUARES = LossConfig(l1_weight=0.0, mse_weight=1.0, adversarial_weight=0.0)


def render(module: Any, scene: Any, camera: Camera, rays: Any, chunk: int) -> Rendering:
    """Views of encoded objects by a bound module's `render_rays`, `chunk` of the rays (objects, rays, ...) at once."""
    network, variables = module.unbind()
    num_rays = jax.tree.leaves(rays)[0].shape[1]
    chunk = min(chunk, num_rays)

    def chunked(x):
        padded = jnp.pad(x, ((0, 0), (0, -num_rays % chunk), *[(0, 0)] * (x.ndim - 2)), mode="edge")
        return jnp.moveaxis(padded.reshape(x.shape[0], -1, chunk, *x.shape[2:]), 1, 0)

    outputs = jax.lax.map(lambda rays: network.bind(variables).render_rays(scene, rays), jax.tree.map(chunked, rays))
    flat = jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1, *x.shape[3:])[:, :num_rays], outputs)
    return as_images(camera, *flat)


def as_images(
    camera: Camera,
    rgb: Float[Array, "objects rays 3"],
    depth: Float[Array, "objects rays"],
    acc: Float[Array, "objects rays"],
) -> Rendering:
    """Views from the rays of `cameras.view_rays`, by a method that renders every pixel of the image."""
    shape = (*camera.cam_to_world.shape[:-2], camera.height, camera.width)
    return Rendering(image=rgb.reshape(*shape, 3), depth=depth.reshape(shape), acc=acc.reshape(shape))


def check_stride(config: Any) -> None:
    """ValueError for a pixel_stride that does not divide the pictures."""
    require(
        config.image_resolution % config.pixel_stride == 0,
        f"pixel_stride {config.pixel_stride} does not divide image_resolution {config.image_resolution}; use 1",
    )


def choose_pixels(key: Key | None, batch: Batch, stride: int) -> tuple[Key | None, Batch]:
    """A new key, and a `lattice` of the batch; both are unchanged without a key or with stride 1."""
    if key is None or stride == 1:
        return key, batch
    key, lattice_key = jax.random.split(key)
    return key, lattice(lattice_key, batch, stride)


def lattice(key: Key, batch: Batch, stride: int) -> Batch:
    """The batch with every `stride`-th row and column of its views, from a random offset: still an image."""
    first = jax.random.randint(key, (2,), 0, stride)

    def thin(x):
        for axis, start in zip((2, 3), first, strict=True):
            x = x.reshape(*x.shape[:axis], x.shape[axis] // stride, stride, *x.shape[axis + 1 :])
            x = jax.lax.dynamic_index_in_dim(x, start, axis + 1, keepdims=False)
        return x

    # the centre of the lattice's pixel i is at first + stride * i + 0.5 of the view
    shift = 0.5 - (first[::-1] + 0.5) / stride
    zoom = jnp.diag(jnp.array([1 / stride, 1 / stride, 1.0])).at[:2, 2].set(shift)
    intrinsics = jnp.einsum("ij,...jk->...ik", zoom, batch.camera.intrinsics, precision="highest")
    images = (batch.image, batch.alpha, batch.condition, batch.condition_mask)
    image, alpha, condition, mask = (thin(jnp.asarray(x)) for x in images)
    pose, (height, width) = batch.camera.cam_to_world, image.shape[2:4]
    camera = Camera(cam_to_world=pose, intrinsics=intrinsics, height=height, width=width)
    return Batch(cloud=batch.cloud, camera=camera, image=image, alpha=alpha, condition=condition, condition_mask=mask)
