"""The handle for pictures: load a network, encode a cloud once, render it from any camera.

    model = spnr_jax.load()  # pretrained; or a run folder, or a weights file
    volume = model.encode(spnr_jax.read_cloud("chair.ply"))
    rendering = model.render(volume, model.camera(volume, azimuth=30, elevation=20))

Clouds, cameras and depths are in the cloud's own units; the volume stores the transform into the network's box.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.config import NetworkConfig, Quality
from spnr_jax.errors import UserError, check_kind
from spnr_jax.kernels import cameras, cloud_arrays
from spnr_jax.kernels.records import Camera, Encoded, Light, PointCloud, Rendering, unstack
from spnr_jax.method.checks import check_camera_kind, check_light
from spnr_jax.methods import method_of

COARSEST_STEP = 1e-3  # of float32 at a cloud's coordinates, relative to half its diagonal
FIELD_OF_VIEW, DISTANCE = np.deg2rad(40.0), 3.0  # of the training cameras; the object fits into the unit sphere
Angle = float | int | np.floating | jax.Array  # degrees


@dataclass(frozen=True, kw_only=True)
class Model:
    """A trained network: the functions of its method (`methods.Method`) with its weights.

    Its programs are compiled once for each padded cloud size and picture size.  `encode` and `render` also work on the
    host, so they cannot be traced by `jax.jit`.  The functions that can are `spnr_jax.encode` and `spnr_jax.render`;
    for Linen modules, `inference.encode` and `inference.render`.
    """

    config: NetworkConfig
    params: dict = field(repr=False)
    """The variables: the first argument of `spnr_jax.encode` and `spnr_jax.render`.

    The shader's weights are in `params["params"]`, as Flax has it, and the densifier's in `params["densifier"]`.
    """

    def encode(self, cloud: PointCloud, densify: bool = True) -> Encoded:
        """What `render` draws of a cloud (unbatched, any units, y up): for surfels a scene, as of `spnr_jax.encode`.

        ValueError if it is empty or contains NaN or infinity.

        Without `densify`, a sparse cloud gets no learned points: faster, but less sharp at rims and on curved parts.
        """
        cloud_arrays.check_cloud(cloud, "encode")
        cloud_arrays.refuse_tracers(cloud, "Model.encode")
        cloud_arrays.refuse_jit("Model.encode")
        positions = np.asarray(cloud.positions, np.float32)
        mask = np.asarray(cloud.mask)
        if not mask.any():
            raise UserError("encode: the cloud has no points; give at least one")
        cloud_arrays.check_finite(cloud, "encode")
        for name in ("base_color", "roughness", "metallic"):
            given = np.asarray(getattr(cloud, name))[mask]
            if given.min() < 0 or given.max() > 1:
                raise UserError(f"the cloud's {name} is {given.min():g} to {given.max():g}; expected 0 to 1, linear")
        centre, scale = cloud_arrays.normalization(positions[mask])
        farthest = np.abs(positions[mask]).max()
        if scale * np.spacing(farthest) > COARSEST_STEP:
            found = f"the positions reach {farthest:g}, where float32 is too coarse for this cloud"
            raise UserError(f"{found}: subtract its centre from positions and cameras first, in float64")
        # the ends of a thin stick lie on the faces of the box: rounding must not push them out of it
        inside = np.clip((positions - centre) * scale, -1, 1).astype(np.float32)
        cloud = dataclasses.replace(cloud, positions=inside)
        method = method_of(self.config)
        left_out = () if densify else method.companions
        params = {name: tree for name, tree in self.params.items() if name not in left_out}
        return method.encode(params, cloud, centre, scale, config=self.config)

    def render(
        self, volume: Encoded, camera: Camera, quality: Quality = "best", light: Light | None = None
    ) -> Rendering:
        """The object as seen by the camera (unbatched, or with one axis of views); depth in the cloud's units.

        The surfel network takes a light (default: the room).  It skips its CNN at `draft`, and draws fewer pixels and
        enlarges the picture at `balanced`.  Other networks know only the light that they were trained with.

        The paper's network samples only near the points at `draft`, `balanced` and `best`, with a quarter, half and all
        of its samples per ray.  At `trained` it samples the whole box, as in training.
        """
        check_camera_kind(camera)
        cloud_arrays.refuse_tracers(camera, "Model.render")
        axes = np.shape(camera.cam_to_world)[:-2]
        if not axes:
            return next(self.render_each(volume, [camera], quality, [light]))
        if len(axes) > 1:
            raise UserError(f"render: expected one camera, or one axis of them, got axes {axes}")
        intrinsics = np.broadcast_to(camera.intrinsics, (*axes, 3, 3))  # also one for all views
        views = unstack(dataclasses.replace(camera, intrinsics=intrinsics))
        drawn = self.render_each(volume, views, quality, [light] * len(views))
        return jax.tree.map(lambda *x: np.stack(x), *drawn)

    def render_each(
        self,
        volume: Encoded,
        views: Sequence[Camera],
        quality: Quality = "best",
        lights: Sequence[Light | None] | None = None,
    ) -> Iterator[Rendering]:
        """The object from several cameras, one after the other, each in its light: for films, whose frames are alike.

        The surfel network uses common array sizes for all frames, so that it is compiled once.
        """
        if quality not in get_args(Quality):
            raise UserError(f"quality must be one of {', '.join(get_args(Quality))}, got {quality}")
        check_kind(volume, Encoded, "render: expected what Model.encode returns")
        if np.ndim(volume.scale):
            raise UserError(f"render: expected one object, got a stack {np.shape(volume.scale)}; use jax.vmap for more")
        cloud_arrays.refuse_jit("Model.render")
        lights = lights or [None] * len(views)
        for light in lights:
            check_light(light)
        draw = method_of(self.config).render
        return draw(self.params, volume, views, lights, config=self.config, quality=quality)

    def camera(
        self,
        volume: Encoded,
        azimuth: Angle = 30.0,
        elevation: Angle = 20.0,
        resolution: int | None = None,
    ) -> Camera:
        """Camera that frames the whole object; azimuth around the y axis from +z and elevation, in degrees.

        Pure: angles and volume may be traced.
        """
        check_kind(volume, Encoded, "camera: expected what Model.encode or spnr_jax.encode returns")
        size = self.config.image_resolution if resolution is None else resolution
        if not isinstance(size, int | np.integer) or size < 1:
            raise UserError(f"camera: resolution={size} is no number of pixels; `cameras.resize` makes other shapes")
        return _orbit(azimuth, elevation, volume.centre, volume.scale, size=size)


def render_views(
    variables: dict,
    config: NetworkConfig,
    cloud: PointCloud,
    camera: Camera,
    light: Light | Sequence[Light] | None = None,
) -> Rendering:
    """All views of one object that is already in the box (as clouds of data sets are), at the quality of training.

    `light`, one or one for each view, is for networks that take a light; None is the room.
    """
    method, views = method_of(config), unstack(camera)
    volume = method.encode(variables, cloud, np.zeros(3, np.float32), np.float32(1), config=config)
    lights: Sequence[Light | None] = [None] * len(views)
    if light is not None and method.takes_light:
        lights = [light] * len(views) if isinstance(light, Light) else light
    drawn = method.render(variables, volume, views, lights, config=config, quality="trained")
    return jax.tree.map(lambda *x: np.stack(x), *drawn)


@partial(jax.jit, static_argnames="size")
def _orbit(azimuth, elevation, centre, scale, *, size: int) -> Camera:
    """Square camera of `size` pixels that looks at the centre; angles in degrees."""
    turn, rise = (jnp.deg2rad(jnp.asarray(angle, jnp.float32)) for angle in (azimuth, elevation))
    return cameras.pinhole(cameras.orbit(turn, rise, DISTANCE / scale, centre), FIELD_OF_VIEW, size, size)
