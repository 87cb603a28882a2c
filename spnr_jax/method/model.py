"""The handle for people who only want pictures: load a network, encode a cloud once, render it from anywhere.

    model = spnr_jax.load()  # "small" of the package; or "tiny", a run folder, a file of weights
    volume = model.encode(spnr_jax.read_cloud("chair.ply"))
    rendering = model.render(volume, model.camera(volume, azimuth=30, elevation=20))

Clouds, cameras and depths are in the cloud's own units; the transform into the network's box is kept with the volume.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from types import ModuleType
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from spnr_jax.devices.placement import by_all_devices, everywhere
from spnr_jax.errors import UserError
from spnr_jax.kernels import cameras, cloud_arrays
from spnr_jax.kernels.records import Camera, Light, PointCloud, Rendering
from spnr_jax.method import inference
from spnr_jax.model_config import NetworkConfig, PaperConfig, RayNetworkConfig, RenderOptions, SamplingConfig

FIELD_OF_VIEW, DISTANCE = np.deg2rad(40.0), 3.0  # of the training cameras; the object fits into the unit sphere
Quality = Literal["draft", "balanced", "best", "trained"]
SAMPLES = {"draft": 0.25, "balanced": 0.5, "best": 1.0}  # share of the samples a ray was trained with
BALANCED = 0.75  # of the pixels along a side, which the network over surfels draws and enlarges: docs/performance.md
REACH_PER_SPACING, LARGEST_REACH = 1.6, 4  # what loses nothing from 128 to 4096 points, docs/cpu_forms.md


@struct.dataclass
class Volume:
    """An encoded object in the box [-1, 1]^3, which is (position - centre) * scale of the cloud.

    `scene` is what the network encodes a cloud as: for ours a `records.Scene`.
    """

    scene: Any
    centre: Float[Array, "3"]
    scale: Float[Array, ""]
    reach: int = struct.field(pytree_node=False, default=LARGEST_REACH)
    """Voxels around points that rendering looks at, from how far the points lie apart."""


@dataclass(frozen=True, kw_only=True)
class Model:
    """A trained network; `encode` and `render` are jitted, one compilation per bucket of points and image size."""

    config: NetworkConfig
    variables: dict

    def encode(self, cloud: PointCloud) -> Volume:
        """Volume of a cloud (unbatched, any units, y up).  ValueError if it holds no points, NaN or infinity."""
        positions = np.asarray(cloud.positions, np.float32)
        mask = np.asarray(cloud.mask)
        if not mask.any():
            raise UserError("the cloud has no points; give at least one")
        for name, values in vars(cloud).items():
            if values is not None and not np.isfinite(np.asarray(values)[mask]).all():
                raise UserError(f"the cloud has NaN or infinity in its {name}; remove those points")
        centre, scale = cloud_arrays.normalization(positions[mask])
        # the ends of a thin stick lie on the faces of the box: rounding must not push them out of it
        inside = np.clip((positions - centre) * scale, -1, 1).astype(np.float32)
        cloud = dataclasses.replace(cloud, positions=inside)
        if self._surfels is not None:
            scene = self._surfels.encode(self.variables, cloud, config=self.config)
            return Volume(scene=scene, centre=jnp.asarray(centre), scale=jnp.asarray(scale))
        cloud = dataclasses.replace(cloud, normals=None, materials_known=None)
        cloud = cloud_arrays.pad(cloud, cloud_arrays.bucket(len(positions)))
        scene = _encode(self.variables, cloud, config=self.config)
        volume = Volume(scene=scene, centre=jnp.asarray(centre), scale=jnp.asarray(scale))
        if self.config.method != "paper":
            return volume
        resolution = cast(PaperConfig, self.config).encoder.volume_resolution
        return dataclasses.replace(volume, reach=reach_of(inside[mask], resolution))

    def render(
        self, volume: Volume, camera: Camera, quality: Quality = "best", light: Light | None = None
    ) -> Rendering:
        """The object as the camera (unbatched, or with one axis of views) sees it; depth in the cloud's units.

        The network over surfels takes a light (default: the package's room), leaves its CNN out of `draft`, and draws
        fewer pixels at `balanced`, which are enlarged; the networks of rays know the light that they were trained in
        alone, and have these levels:

        `draft`, `balanced` and `best` look near the points alone, with a quarter, half and all of the samples of a ray,
        and `best` has several rays a pixel where pictures are smaller than those of the training (`supersampling.py`);
        the network's refiner, if it has one, is left out of `draft`, and of smaller pictures by any other than `best`;
        `trained` renders as the network was trained.  Other networks than ours know one number of samples.
        """
        if self._surfels is not None:
            draw = self._surfels.render if camera.cam_to_world.ndim == 2 else self._surfels.render_views
            inside = _in_box(camera, volume.centre, volume.scale)
            shader, share = self._shader(quality), _share(quality)
            drawn = draw(shader, volume.scene, inside, _or_room(light), config=self.config, share=share)
            return _in_units(drawn, volume)
        if light is not None:
            raise UserError("this network knows the light of its training alone; give no light")
        if self.config.upsamples and (camera.height % 2 or camera.width % 2):
            raise UserError(f"this network doubles its pictures: {camera.width} x {camera.height} pixels must be even")
        options = at_quality(self.config, quality, volume.reach, camera.width)
        render = partial(_render, config=self.config, options=options)
        return by_all_devices(render, self._spread, volume.scene, volume.centre, volume.scale, camera)

    def render_each(
        self,
        volume: Volume,
        views: Sequence[Camera],
        quality: Quality = "best",
        lights: Sequence[Light | None] | None = None,
    ) -> Iterator[Rendering]:
        """The object from several cameras, one after the other, each in its light: for films, whose frames are alike.

        The network over surfels gives its pictures common sizes, so that it is compiled once and not for most of them.
        """
        lights = lights or [None] * len(views)
        if self._surfels is None:
            yield from (self.render(volume, view, quality, light) for view, light in zip(views, lights, strict=True))
            return
        inside = [_in_box(view, volume.centre, volume.scale) for view in views]
        shone = [_or_room(light) for light in lights]
        shader, share = self._shader(quality), _share(quality)
        draw = self._surfels.render_each
        for drawn in draw(shader, volume.scene, inside, shone, config=self.config, share=share):
            yield _in_units(drawn, volume)

    @property
    def _surfels(self) -> ModuleType | None:
        """The module that draws this network if it is the one over surfels: no other needs it imported."""
        if self.config.method != "surfels":
            return None
        from spnr_jax.method import surfel_renderer

        return surfel_renderer

    def _shader(self, quality: Quality) -> dict | None:
        """Variables of the CNN over surfels; None where a quality leaves it out."""
        _check_quality(quality)
        return None if quality == "draft" else self.variables

    @cached_property
    def _spread(self) -> dict:
        return everywhere(self.variables)

    def camera(
        self, volume: Volume, azimuth: float = 30.0, elevation: float = 20.0, resolution: int | None = None
    ) -> Camera:
        """Camera that sees the whole object: degrees around the y axis from +z, and above the horizon."""
        angles = np.deg2rad(np.float32(azimuth)), np.deg2rad(np.float32(elevation))
        size = resolution or self.config.image_resolution
        return _orbiting(*angles, np.float32(DISTANCE) / np.asarray(volume.scale), volume.centre, size=size)


# These are compiled whole: each operation outside of a jit would be compiled alone, 30 ms apiece at the first call.


# this option halves the compilation of the U-Net and costs it no time; rendering would take twice as long
@partial(jax.jit, static_argnames="config", compiler_options={"xla_cpu_use_fusion_emitters": False})
def _encode(variables: dict, cloud: PointCloud, *, config: NetworkConfig) -> Any:
    """What the network makes of a cloud in the box (unbatched)."""
    scene = inference.encode(variables, jax.tree.map(lambda x: x[None], cloud), config=config)
    return jax.tree.map(lambda x: x[0], scene)


@partial(jax.jit, static_argnames=("config", "options"))
def _render(
    variables: dict, scene: Any, centre, scale, camera: Camera, *, config: NetworkConfig, options: RenderOptions
) -> Rendering:
    """`Model.render` with the options of a quality."""
    single = camera.cam_to_world.ndim == 2
    inside = jax.tree.map(lambda x: x.reshape(1, -1, *x.shape[-2:]), _in_box(camera, centre, scale))
    scene = jax.tree.map(lambda x: x[None], scene)
    rendering = inference.render(variables, scene, inside, config=config, options=options)
    rendering = dataclasses.replace(rendering, depth=rendering.depth / scale)
    return jax.tree.map(lambda x: x[0, 0] if single else x[0], rendering)


@jax.jit
def _in_box(camera: Camera, centre, scale) -> Camera:
    """The camera in the coordinates of the box."""
    rotation, eye = camera.cam_to_world[..., :3], camera.cam_to_world[..., 3]
    eye = (eye - jnp.broadcast_to(centre, eye.shape)) * scale
    return dataclasses.replace(camera, cam_to_world=jnp.concatenate([rotation, eye[..., None]], axis=-1))


@partial(jax.jit, static_argnames="size")
def _orbiting(azimuth, elevation, distance, centre, *, size: int) -> Camera:
    """Square camera of `size` pixels that looks at the centre; angles in radians."""
    return cameras.pinhole(cameras.orbit(azimuth, elevation, distance, centre), FIELD_OF_VIEW, size, size)


def _or_room(light: Light | None) -> Light:
    from spnr_jax.surfels import lighting  # networks of rays know no lights

    return lighting.room_light() if light is None else light


def _in_units(drawn: Rendering, volume: Volume) -> Rendering:
    """What was drawn in the box with its depth in the cloud's units."""
    return dataclasses.replace(drawn, depth=_over(drawn.depth, volume.scale))


@jax.jit
def _over(depth, scale) -> Array:
    return depth / scale


def _share(quality: Quality) -> float:
    return BALANCED if quality == "balanced" else 1.0


def _check_quality(quality: str) -> None:
    if quality not in (*SAMPLES, "trained"):
        raise UserError(f"quality must be one of {', '.join(SAMPLES)}, trained, got {quality}")


def at_quality(config: NetworkConfig, quality: Quality, reach: int, width: int) -> RenderOptions:
    """The options that render a picture so wide at a quality, with samples within `reach` voxels of points.

    A network near points keeps its own reach: the cells of the surface's grid grow with the spacing.
    """
    _check_quality(quality)
    needed = inference.rays_per_side(config, width)
    side = needed if quality == "best" else 1
    # a refiner has learnt to see pictures of the training's size
    options = dataclasses.replace(
        inference.trained(config), rays_per_side=side, refine=quality != "draft" and side == needed
    )
    if quality == "trained" or not isinstance(config, RayNetworkConfig):
        return options
    counts = config.sampling
    samples = max(round(SAMPLES[quality] * (counts.num_coarse + counts.num_fine)), 1)
    sampling = SamplingConfig(num_coarse=samples, num_fine=0, reach=reach if config.method == "paper" else counts.reach)
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
