"""The model for people who only want pictures: load a network, encode a cloud once, render it from anywhere.

    model = spnr_jax.load()  # the network of the package; or a run folder, a file of weights
    volume = model.encode(spnr_jax.read_cloud("chair.ply"))
    rendering = model.render(volume, model.camera(volume, azimuth=30, elevation=20))

Clouds, cameras and depths are in the cloud's own units; the transform into the network's box is kept with the volume.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.config import NetworkConfig
from spnr_jax.errors import UserError
from spnr_jax.kernels import cameras, cloud_arrays
from spnr_jax.kernels.records import Camera, Light, PointCloud, Rendering, SurfelScene, Volume
from spnr_jax.method import inference

FIELD_OF_VIEW, DISTANCE = np.deg2rad(40.0), 3.0  # of the training cameras; the object fits into the unit sphere
Angle = float | int | np.floating | jax.Array  # degrees
Quality = Literal["draft", "balanced", "best", "trained"]


@dataclass(frozen=True, kw_only=True)
class Model:
    """A trained network.

    Its programs are compiled once for each bucket of points and size of pictures; `encode` and `render` themselves also
    work on the host, so they are not for `jax.jit` (`inference.encode` and `inference.render` of networks
    other than that over surfels are).
    """

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
        return self._pictures.encode_volume(self.variables, cloud, centre, scale, config=self.config)

    def render(
        self, volume: Volume, camera: Camera, quality: Quality = "best", light: Light | None = None
    ) -> Rendering:
        """The object as the camera (unbatched, or with one axis of views) sees it; depth in the cloud's units.

        The network over surfels takes a light (default: the package's room), leaves its CNN out of `draft`, and draws
        fewer pixels at `balanced`, which are enlarged.  Other networks know the light that they were trained in alone.

        The paper's network looks near the points alone at `draft`, `balanced` and `best`, with a quarter, half and all
        of the samples of a ray, and renders as it was trained at `trained`.  At `best` a network without an upsampler
        has several rays a pixel where pictures are smaller than those of the training.
        """
        _check_quality(quality)
        return self._pictures.draw(self.variables, volume, camera, light, config=self.config, quality=quality)

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
        _check_quality(quality)
        lights = lights or [None] * len(views)
        return self._pictures.draw_each(self.variables, volume, views, lights, config=self.config, quality=quality)

    def camera(
        self,
        volume: Volume | SurfelScene,
        azimuth: Angle = 30.0,
        elevation: Angle = 20.0,
        resolution: int | None = None,
    ) -> Camera:
        """Camera that sees the whole object: degrees around the y axis from +z, and above the horizon.

        Pure: angles and object may be traced.
        """
        size = resolution or self.config.image_resolution
        return _orbit(azimuth, elevation, volume.centre, volume.scale, size=size)

    @property
    def params(self) -> dict:
        """The weights, a pytree of arrays: what `spnr_jax.encode` and `spnr_jax.render` take."""
        return self.variables

    @property
    def _pictures(self) -> ModuleType:
        """The module that encodes clouds and draws volumes with this kind of network; no other is imported."""
        if self.config.method == "surfels":
            from spnr_jax.method import surfel_pictures

            return surfel_pictures
        return inference


@partial(jax.jit, static_argnames="size")
def _orbit(azimuth, elevation, centre, scale, *, size: int) -> Camera:
    """Square camera of `size` pixels that looks at the centre; angles in degrees."""
    turn, rise = (jnp.deg2rad(jnp.asarray(angle, jnp.float32)) for angle in (azimuth, elevation))
    return cameras.pinhole(cameras.orbit(turn, rise, DISTANCE / scale, centre), FIELD_OF_VIEW, size, size)


def _check_quality(quality: str) -> None:
    if quality not in get_args(Quality):
        raise UserError(f"quality must be one of {', '.join(get_args(Quality))}, got {quality}")
