"""What a trained network is asked for: scenes of clouds, and views of scenes.

The config of a network finds its module (`network`): any Linen module with `encode(cloud, train)` and
`render(scene, camera, options)`.  A network is imported when it is first asked for, and no other with it.  The network
over surfels, whose sizes are counted before they are compiled, is a module of functions beside these.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from spnr_jax.devices.placement import by_all_devices
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Key, Light, PointCloud, Rendering
from spnr_jax.kernels.resizing import averaged
from spnr_jax.model_config import SOLID, NearPointsConfig, NetworkConfig, PaperConfig, RenderOptions, SurfelConfig

WHOLE_BLOCK = 1024  # rays that are sampled through all the box at once: about 80 MB at 128 samples


def network(config: NetworkConfig) -> nn.Module:
    """The module that a network's config describes."""
    match config.method:
        case "paper":
            from spnr_jax.method.paper_network import PaperNetwork

            return PaperNetwork(cast(PaperConfig, config))
        case "near_points":
            from spnr_jax.method.near_points import NearPointsNetwork

            return NearPointsNetwork(cast(NearPointsConfig, config))
    from spnr_jax.baselines.networks import NETWORKS

    return NETWORKS[config.method](config)


def init(key: Key, config: NetworkConfig) -> dict:
    """Fresh variables of a config's network."""
    if config.method == "surfels":
        from spnr_jax.method import surfel_renderer

        sizes = cast(SurfelConfig, config)
        variables = surfel_renderer.init(key, sizes)
        return variables | ({"batch_stats": init(key, SOLID)} if sizes.solid else {})
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
    variables: dict, scene: Any, camera: Camera, *, config: NetworkConfig, options: RenderOptions | None = None
) -> Rendering:
    """Views of encoded scenes, samples at the middles of their strata, rays_per_side^2 rays a pixel averaged.

    On a CPU a pixel of one object of the paper's network has the same bits for every block from 256 to 2048 rays: the
    matrix products then add up in one order.
    """
    options = options or trained(config)
    if (side := options.rays_per_side) > 1:
        wide = cameras.resize(camera, side * camera.height, side * camera.width)
        narrow = dataclasses.replace(options, rays_per_side=1)
        return averaged(render(variables, scene, wide, config=config, options=narrow), side)
    return network(config).bind(variables).render(scene, camera, options)


def trained(config: NetworkConfig) -> RenderOptions:
    """Pictures as the network was trained; where a ray is sampled through all the box, few rays at once."""
    return RenderOptions(block=WHOLE_BLOCK if config.method == "paper" else None)


def rays_per_side(config: NetworkConfig, size: int) -> int:
    """Rays along each side of a pixel of a picture `size` pixels wide, so that they lie as close as in the training.

    A network that renders pictures of any size has learnt what a ray of its training sees, a cone of one pixel there.
    The pixels of a smaller picture are wider: each is the mean of the rays that it would have had in the training.
    """
    sees_rays = config.any_size and config.method != "surfels"
    return max(round(config.image_resolution / size), 1) if sees_rays else 1


jitted_encode = jax.jit(encode, static_argnames="config")
jitted_render = jax.jit(render, static_argnames=("config", "options"))


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
    if config.method == "surfels":
        from spnr_jax.method import surfel_renderer
        from spnr_jax.surfels.lighting import room_light

        sizes = cast(SurfelConfig, config)
        scene = surfel_renderer.encode(variables, cloud, config=sizes)
        return surfel_renderer.render_views(variables, scene, camera, light or room_light(), config=sizes)
    cloud, camera = jax.tree.map(lambda x: jnp.asarray(x)[None], (cloud, camera))
    volume = jitted_encode(variables, cloud, config=config)
    options = dataclasses.replace(trained(config), rays_per_side=rays_per_side(config, camera.width))
    render = partial(jitted_render, config=config, options=options)
    rendering = by_all_devices(render, variables, volume, camera)
    return jax.tree.map(lambda x: x[0], rendering)
