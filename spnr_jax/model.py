"""The handle for people who only want pictures: load a network, encode a cloud once, render it from anywhere.

    model = spnr_jax.load("runs/demo/run")
    volume = model.encode(spnr_jax.read_cloud("chair.ply"))
    rendering = model.render(volume, model.camera(volume, azimuth=30, elevation=20))

Clouds, cameras and depths are in the cloud's own units; the transform into the network's box is kept with the volume.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from spnr_jax import cameras, checkpoint, clouds, training
from spnr_jax.config import ModelConfig
from spnr_jax.types import Camera, PointCloud, Rendering

FIELD_OF_VIEW, DISTANCE = np.deg2rad(40.0), 3.0  # of the training cameras; the object fits into the unit sphere


@struct.dataclass
class Volume:
    """An encoded object: features in the box [-1, 1]^3, which is (position - centre) * scale of the cloud."""

    features: Float[Array, "d d d features"]
    centre: Float[Array, "3"]
    scale: Float[Array, ""]


@dataclass(frozen=True, kw_only=True)
class Model:
    """A trained network; `encode` and `render` are jitted, one compilation per bucket of points and image size."""

    config: ModelConfig
    variables: dict

    def encode(self, cloud: PointCloud) -> Volume:
        """Volume of a cloud (unbatched, any units, y up).  ValueError if it holds no points, NaN or infinity."""
        positions = np.asarray(cloud.positions, np.float32)
        mask = np.asarray(cloud.mask)
        if not mask.any():
            raise ValueError("the cloud has no points; give at least one")
        for field in dataclasses.fields(cloud):
            if not np.isfinite(np.asarray(getattr(cloud, field.name))[mask]).all():
                raise ValueError(f"the cloud has NaN or infinity in its {field.name}; remove those points")
        centre, scale = clouds.normalization(positions[mask])
        # the ends of a thin stick lie on the faces of the box: rounding must not push them out of it
        inside = np.clip((positions - centre) * scale, -1, 1).astype(np.float32)
        cloud = dataclasses.replace(cloud, positions=inside)
        cloud = clouds.pad(cloud, clouds.bucket(len(positions)))
        features = training.jitted_encode(
            self.variables, jax.tree.map(lambda x: jnp.asarray(x)[None], cloud), config=self.config
        )
        return Volume(features=features[0], centre=jnp.asarray(centre), scale=jnp.asarray(scale))

    def render(self, volume: Volume, camera: Camera) -> Rendering:
        """The object as the camera (unbatched, or with one axis of views) sees it; depth in the cloud's units."""
        if self.config.upsamples and (camera.height % 2 or camera.width % 2):
            raise ValueError(f"this network doubles its pictures: {camera.width} x {camera.height} pixels must be even")
        single = camera.cam_to_world.ndim == 2
        rotation, eye = camera.cam_to_world[..., :3], camera.cam_to_world[..., 3]
        eye = (eye - jnp.broadcast_to(volume.centre, eye.shape)) * volume.scale
        pose = jnp.concatenate([rotation, eye[..., None]], axis=-1)
        inside = dataclasses.replace(camera, cam_to_world=pose)
        inside = jax.tree.map(lambda x: jnp.asarray(x).reshape(1, -1, *x.shape[-2:]), inside)
        rendering = training.jitted_render(self.variables, volume.features[None], inside, config=self.config)
        rendering = dataclasses.replace(rendering, depth=rendering.depth / volume.scale)
        return jax.tree.map(lambda x: x[0, 0] if single else x[0], rendering)

    def camera(
        self, volume: Volume, azimuth: float = 30.0, elevation: float = 20.0, resolution: int | None = None
    ) -> Camera:
        """Camera that sees the whole object: degrees around the y axis from +z, and above the horizon."""
        pose = cameras.orbit(np.deg2rad(azimuth), np.deg2rad(elevation), DISTANCE / float(volume.scale), volume.centre)
        size = resolution or self.config.image_resolution
        return cameras.pinhole(pose, FIELD_OF_VIEW, size, size)


def load(run: Path | str) -> Model:
    """The averaged network of a run folder's newest checkpoint."""
    config, state = checkpoint.load_run(run)
    return Model(config=config.model, variables=training.averaged_variables(state))
