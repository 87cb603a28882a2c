"""What a trained network is asked for: scenes of clouds, and views of scenes.

The config of a network finds its module (`methods.network`): any Linen module with `encode(cloud, train)` and
`render(scene, camera, options)`.  A network is imported when it is first asked for, and no other with it.  The network
over surfels, whose sizes are counted before they are compiled, is a module of functions beside these.

    encode, render               batches of objects, in the box: for training and scores
    encode_volume, draw          one object, for the handle (model.py), which finds the same in surfel_pictures.py
"""

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from spnr_jax.config import NetworkConfig, PaperConfig, RenderOptions, SamplingConfig, SurfelConfig
from spnr_jax.devices.runtime import QUICK
from spnr_jax.errors import UserError
from spnr_jax.kernels import cameras, cloud_arrays
from spnr_jax.kernels.records import LARGEST_REACH, Camera, Key, Light, PointCloud, Rendering, Volume
from spnr_jax.kernels.resizing import averaged
from spnr_jax.methods import network

SAMPLES = {"draft": 0.25, "balanced": 0.5, "best": 1.0}  # share of the samples a ray was trained with
REACH_PER_SPACING = 1.6  # what loses nothing from 128 to 4096 points, docs/lab/cpu_forms.md
WHOLE_BLOCK = 1024  # rays that are sampled through all the box at once: about 80 MB at 128 samples


def init(key: Key, config: NetworkConfig) -> dict:
    """Fresh variables of a config's network."""
    if config.method == "surfels":
        from spnr_jax.method import surfel_renderer

        return surfel_renderer.init(key, cast(SurfelConfig, config))
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
    """All views of one object (clouds of data sets are normalised already), one compilation for each number of views.

    The light, or one for each view, is for a network that sees it; None is the package's room.
    """
    if config.method == "surfels":
        from spnr_jax.method import surfel_pictures

        return surfel_pictures.draw_views(variables, cloud, camera, light, config=cast(SurfelConfig, config))
    cloud, camera = jax.tree.map(lambda x: jnp.asarray(x)[None], (cloud, camera))
    volume = jitted_encode(variables, cloud, config=config)
    options = dataclasses.replace(trained(config), rays_per_side=rays_per_side(config, camera.width))
    rendering = jitted_render(variables, volume, camera, config=config, options=options)
    return jax.tree.map(lambda x: x[0], rendering)


def encode_volume(
    variables: dict, cloud: PointCloud, centre: np.ndarray, scale: np.floating, *, config: NetworkConfig
) -> Volume:
    """Volume of a cloud in the box (unbatched), one compilation per bucket of points."""
    positions = np.asarray(cloud.positions)
    reach = LARGEST_REACH
    if isinstance(config, PaperConfig):
        reach = reach_of(positions[np.asarray(cloud.mask)], config.encoder.volume_resolution)
    cloud = dataclasses.replace(cloud, normals=None, materials_known=None)
    cloud = cloud_arrays.pad(cloud, cloud_arrays.bucket(len(positions)))
    scene = _encode(variables, cloud, config=config)
    return Volume(scene=scene, centre=jnp.asarray(centre), scale=jnp.asarray(scale), reach=reach)


def draw(
    variables: dict, volume: Volume, camera: Camera, light: Light | None, *, config: NetworkConfig, quality: str
) -> Rendering:
    """A view, or one axis of views; UserError for a light, and for odd sizes of a network that doubles its pictures."""
    if light is not None:
        raise UserError("this network knows the light of its training alone; give no light")
    if config.upsamples and (camera.height % 2 or camera.width % 2):
        raise UserError(f"this network doubles its pictures: {camera.width} x {camera.height} pixels must be even")
    options = at_quality(config, quality, volume.reach, camera.width)
    return _render(variables, volume.scene, volume.centre, volume.scale, camera, config=config, options=options)


def draw_each(
    variables: dict,
    volume: Volume,
    views: Sequence[Camera],
    lights: Sequence[Light | None],
    *,
    config: NetworkConfig,
    quality: str,
) -> Iterator[Rendering]:
    """Views one after the other."""
    for view, light in zip(views, lights, strict=True):
        yield draw(variables, volume, view, light, config=config, quality=quality)


# These are compiled whole: each operation outside of a jit would be compiled alone, 30 ms apiece at the first call.


# this option halves the compilation of the U-Net and costs it no time; rendering would take twice as long
@partial(jax.jit, static_argnames="config", compiler_options=QUICK)
def _encode(variables: dict, cloud: PointCloud, *, config: NetworkConfig) -> Any:
    """What the network makes of a cloud in the box (unbatched)."""
    scene = encode(variables, jax.tree.map(lambda x: x[None], cloud), config=config)
    return jax.tree.map(lambda x: x[0], scene)


@partial(jax.jit, static_argnames=("config", "options"))
def _render(
    variables: dict,
    scene: Any,
    centre: Float[Array, "3"],
    scale: Float[Array, ""],
    camera: Camera,
    *,
    config: NetworkConfig,
    options: RenderOptions,
) -> Rendering:
    """A view, or one axis of views, with the options of a quality; depth in the cloud's units."""
    single = camera.cam_to_world.ndim == 2
    inside = jax.tree.map(lambda x: x.reshape(1, -1, *x.shape[-2:]), cameras.in_box(camera, centre, scale))
    scene = jax.tree.map(lambda x: x[None], scene)
    rendering = render(variables, scene, inside, config=config, options=options)
    rendering = dataclasses.replace(rendering, depth=rendering.depth / scale)
    return jax.tree.map(lambda x: x[0, 0] if single else x[0], rendering)


def at_quality(config: NetworkConfig, quality: str, reach: int, width: int) -> RenderOptions:
    """The options that render a picture so wide at a quality, with samples within `reach` voxels of points."""
    side = rays_per_side(config, width) if quality == "best" else 1
    options = dataclasses.replace(trained(config), rays_per_side=side)
    if quality == "trained" or not isinstance(config, PaperConfig):
        return options
    counts = config.sampling
    samples = max(round(SAMPLES[quality] * (counts.num_coarse + counts.num_fine)), 1)
    sampling = SamplingConfig(num_coarse=samples, num_fine=0, reach=reach)
    return dataclasses.replace(options, sampling=sampling, block=None)


def reach_of(positions: np.ndarray, resolution: int, num_queries: int = 4096) -> int:
    """Voxels around points in which their surface lies, from the median distance to the nearest other point.

    Copies of a point, closer than a 1024th of the box, count once.
    """
    x, y, z = np.floor((positions.T + 1) * 512).astype(np.int64)
    _, distinct = np.unique((x * 2048 + y) * 2048 + z, return_index=True)
    positions = positions[distinct]
    if len(positions) < 2:
        return LARGEST_REACH
    queries = positions[:: -(-len(positions) // num_queries)]
    distances, _ = cKDTree(positions).query(queries, 2)
    spacing = np.median(distances[:, 1]) * resolution / 2
    return int(np.clip(np.ceil(REACH_PER_SPACING * spacing), 1, LARGEST_REACH))
