"""Opacity prior for sparse clouds, rendered by near_points: thin parts and outlines between points far apart.

    encode   the points of a sparse cloud            once per object
    seen     opacity and depth of a small picture    once per view

Discs of points tell where a surface is that they cover; a field that has learnt shapes tells where it ends.  Where
points lie close the discs tell it better, so dense clouds do without.  The network is trained before the shader, whose
input this is, and stays as it is.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.config import SOLID, RenderOptions
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, PointCloud, Scene, Surfels
from spnr_jax.kernels.resizing import averaged, doubled
from spnr_jax.method.near_points import NearPointsNetwork

MOST_POINTS, MOST_PIXELS = 6000, 128  # of a sparse cloud, and along a side of the picture
LEAST_OPACITY = 1e-3  # that a depth is divided by


def encode(variables: dict, cloud: PointCloud) -> Scene:
    """The scene of a sparse cloud (unbatched, in the box), objects first on every array."""
    plain = dataclasses.replace(cloud, normals=None, materials_known=None)
    return NearPointsNetwork(SOLID).bind(variables).encode(jax.tree.map(lambda x: jnp.asarray(x)[None], plain))


def of_surfels(variables: dict, surfels: Surfels) -> Scene:
    """`encode` of the points of surfels, those too that are not drawn: all that have a normal."""
    cloud = PointCloud(
        positions=surfels.position,
        base_color=surfels.base_color,
        roughness=surfels.roughness,
        metallic=surfels.metallic,
        mask=jnp.any(surfels.normal != 0, axis=-1),
    )
    return encode(variables, cloud)


def seen(variables: dict, scene: Scene, camera: Camera) -> Float[Array, "height width 2"]:
    """Opacity, and depth along the camera's axis, of a view (camera unbatched, in the box)."""
    halvings = max(int(np.ceil(np.log2(max(camera.height, camera.width) / MOST_PIXELS))), 0)
    height, width = (-(-n // 2**halvings) for n in (camera.height, camera.width))
    side = max(round(SOLID.image_resolution / max(height, width)), 1)  # rays as close as in the training
    whole = dataclasses.replace(camera, height=height << halvings, width=width << halvings)
    view = cameras.resize(whole, side * height, side * width)
    network = NearPointsNetwork(SOLID).bind(variables)
    drawn = averaged(network.render(scene, jax.tree.map(lambda x: x[None, None], view), RenderOptions()), side)
    acc, depth = drawn.acc[0, 0], drawn.depth[0, 0]
    rays = cameras.camera_rays(cameras.resize(whole, height, width))
    _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
    along = -jnp.einsum("hwi,i->hw", rays.directions, jnp.asarray(camera.cam_to_world)[:, 2], precision="highest")
    layers = jnp.stack([acc, (depth - (1 - acc) * far) * along], axis=-1)[None]
    for _ in range(halvings):
        layers = doubled(layers)
    acc, depth = jnp.moveaxis(layers[0, : camera.height, : camera.width], -1, 0)
    return jnp.stack([acc, depth / jnp.maximum(acc, LEAST_OPACITY)], axis=-1)
