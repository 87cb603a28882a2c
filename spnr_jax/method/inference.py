"""What a trained network is asked for: scenes of clouds, and views of scenes, in chunks of rays that bound the memory.

The config of a network finds its module (`network`): any with `encode`, `render` and `develop`.  One that renders rays
each by itself has `rays` and `render_rays`; the others, whose `ray_chunk` is None, render whole images.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from spnr_jax.devices.placement import by_all_devices, on_own_rays
from spnr_jax.kernels import cameras, supersampling
from spnr_jax.kernels.records import Camera, Key, Light, PointCloud, Rendering
from spnr_jax.method import surfel_renderer
from spnr_jax.method.renderer import Renderer
from spnr_jax.model_config import ModelConfig, NetworkConfig, SurfelConfig
from spnr_jax.surfels.lighting import room_light


def network(config: NetworkConfig) -> nn.Module:
    """The module that a network's config describes."""
    if isinstance(config, ModelConfig):
        return Renderer(config)
    from spnr_jax.baselines.networks import NETWORKS  # here: our own network is drawn without them

    return NETWORKS[type(config)](config)


def init(key: Key, config: NetworkConfig) -> dict:
    """Fresh variables of a config's network."""
    if isinstance(config, SurfelConfig):
        return surfel_renderer.init(key, config)
    return dict(network(config).init(key, *example_inputs(config)))


def example_inputs(config: NetworkConfig) -> tuple[PointCloud, Camera]:
    """The smallest valid inputs of the generator, for the shapes of its parameters."""
    points, size = jnp.zeros((1, 2, 3)), config.image_resolution
    scalars = jnp.zeros((1, 2))
    cloud = PointCloud(
        positions=points, base_color=points, roughness=scalars, metallic=scalars, mask=jnp.ones((1, 2), bool)
    )
    pose = jnp.concatenate([jnp.eye(3), jnp.array([[0.0], [0.0], [3.0]])], axis=1)
    return cloud, Camera(cam_to_world=pose[None, None], intrinsics=jnp.eye(3)[None, None], height=size, width=size)


def encode(variables: dict, cloud: PointCloud, *, config: NetworkConfig) -> Any:
    """Scenes of the clouds, objects first on every array: feature volumes (objects, d, d, d, features) for ours."""
    return network(config).bind(variables).encode(cloud)


def render(
    variables: dict,
    scene: Any,
    camera: Camera,
    *,
    config: NetworkConfig,
    ray_chunk: int | None = None,
    rays_per_side: int = 1,
) -> Rendering:
    """Views of encoded scenes, samples at the middles of their strata, rays_per_side^2 rays a pixel averaged.

    So many rays of each object (the network's own number by default) are rendered at a time, which bounds the memory.
    On a CPU a pixel of one object of ours has the same bits for every chunk from 256 to 2048 rays, whatever is rendered
    beside it: the matrix products then add up in one order.
    """
    if rays_per_side > 1:
        wide = cameras.resize(camera, rays_per_side * camera.height, rays_per_side * camera.width)
        rendering = render(variables, scene, wide, config=config, ray_chunk=ray_chunk)
        return supersampling.averaged(rendering, rays_per_side)
    module = network(config)
    if (ray_chunk := ray_chunk or config.ray_chunk) is None:
        return module.bind(variables).render(scene, camera)
    in_chunks = partial(_in_chunks, module, ray_chunk)
    outputs = on_own_rays(in_chunks, variables, scene, module.rays(camera))
    return module.bind(variables).develop(camera, *outputs)


def _in_chunks(module: nn.Module, ray_chunk: int, variables: dict, scene: Any, rays: Any) -> Any:
    """What the module's `render_rays` gives for rays (objects, rays, ...), so many of each object at a time."""
    num_rays = jax.tree.leaves(rays)[0].shape[1]
    chunk = min(ray_chunk, num_rays)

    def chunked(x):
        padded = jnp.pad(x, ((0, 0), (0, -num_rays % chunk), *[(0, 0)] * (x.ndim - 2)), mode="edge")
        return padded.reshape(x.shape[0], -1, chunk, *x.shape[2:])

    chunks = jax.tree.map(chunked, rays)
    outputs = jax.lax.map(
        lambda rays: module.bind(variables).render_rays(scene, rays),
        jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), chunks),
    )
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1, *x.shape[3:])[:, :num_rays], outputs)


jitted_encode = jax.jit(encode, static_argnames="config")
jitted_render = jax.jit(render, static_argnames=("config", "ray_chunk", "rays_per_side"))


def render_views(
    variables: dict,
    config: NetworkConfig,
    cloud: PointCloud,
    camera: Camera,
    light: Light | Sequence[Light] | None = None,
) -> Rendering:
    """All views of one object (clouds of data sets are normalised already), rays divided among the devices.

    The light, or one for each view, is for a network that sees it; None is the package's room.
    """
    if isinstance(config, SurfelConfig):
        scene = surfel_renderer.encode(cloud)
        return surfel_renderer.render_views(variables, scene, camera, light or room_light(), config=config)
    cloud, camera = jax.tree.map(lambda x: jnp.asarray(x)[None], (cloud, camera))
    volume = jitted_encode(variables, cloud, config=config)
    side = supersampling.rays_per_side(config, camera.width)
    render = partial(jitted_render, config=config, rays_per_side=side)
    rendering = by_all_devices(render, variables, volume, camera)
    return jax.tree.map(lambda x: x[0], rendering)
