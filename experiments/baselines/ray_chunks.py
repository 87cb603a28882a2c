"""Pictures of a baseline whose rays know nothing of each other, some rays at a time, which bounds the memory."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.records import Camera, Rendering


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
