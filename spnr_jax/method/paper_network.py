"""The paper's network on one page: points -> volume -> features along rays -> image.

    encode   PointNet on every point, mean per voxel, 3D U-Net (`nn/encoder.py`)             once per object
    render   64 x 64 rays, 64 coarse and 64 fine samples (`march.py`), field, compositing,
             2D upsampler                                                                    once per view

Objects lead, views follow: clouds are (objects, points, ...), cameras (objects, views, ...).
"""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from spnr_jax.config import AS_TRAINED, PaperConfig, RenderOptions
from spnr_jax.kernels import cameras, voxels
from spnr_jax.kernels.records import Camera, Key, PointCloud, Rays, Rendering, Scene
from spnr_jax.kernels.resizing import bilinear
from spnr_jax.method.march import Field, Finish, Samples, Seen, Traced, places, trace
from spnr_jax.nn.encoder import Encoder
from spnr_jax.nn.field import RadianceField
from spnr_jax.nn.upsampler import Upsampler


class PaperNetwork(nn.Module):
    """The generator: a volume from a cloud, pictures from a volume."""

    config: PaperConfig

    def setup(self) -> None:
        """Encoder, radiance field, and the upsampler unless pictures have the size of the volume rendering."""
        c = self.config
        self.encoder = Encoder(c.encoder, c.bf16)
        self.field = RadianceField(c.field_width, c.num_features, c.direction_frequencies, c.sees_direction)
        if c.upsamples:
            self.upsampler = Upsampler(c.upsampler_width, c.bf16)

    def encode(self, cloud: PointCloud, train: bool = False) -> Scene:
        """Feature volume of each object from its points, and the voxels that hold them."""
        volume = self.encoder(cloud, train)
        occupied = jax.vmap(partial(voxels.occupied, resolution=self.config.encoder.volume_resolution))
        return Scene(volume=volume, occupied=occupied(jnp.asarray(cloud.positions), jnp.asarray(cloud.mask)))

    def render(
        self, scene: Scene, camera: Camera, options: RenderOptions = AS_TRAINED, key: Key | None = None
    ) -> Rendering:
        """Views of encoded objects; the camera's size is that of the image.  A key jitters the samples (training)."""
        samples = options.sampling or self.config.sampling
        return self.developed(camera, trace(self, scene, self.rays(camera), samples, options, key))

    def rays(self, camera: Camera) -> Rays:
        """Rays of the volume rendering for all views of an object in one axis, (objects, views * height * width, 3)."""
        return cameras.view_rays(cameras.resize(camera, *self.render_size(camera)))

    def render_size(self, camera: Camera) -> tuple[int, int]:
        """Height and width of the volume rendering behind the camera's image."""
        ratio = self.config.render_resolution / self.config.image_resolution
        return round(camera.height * ratio), round(camera.width * ratio)

    def along(self, scene: Scene, rays: Rays, objects: Int[Array, "*rays"]) -> tuple[Field, Finish]:
        """Density, and what is emitted, at samples along rays; and the features of what is composited of it."""
        view = self.field.view(rays.directions)

        def field(distances: Float[Array, "*rays samples"]) -> Samples:
            owners = jnp.broadcast_to(objects[..., None], distances.shape)
            return Samples(*self.field(voxels.trilinear(scene.volume, places(rays, distances), owners), view))

        def finish(seen: Seen) -> Float[Array, "*rays features"]:
            return self.field.finish(seen.summed, seen.acc, view)

        return field, finish

    def developed(self, camera: Camera, traced: Traced) -> Rendering:
        """Images from the rays of `rays`: the feature image is resized, and the upsampler doubles it."""
        views, (height, width) = camera.cam_to_world.shape[:-2], self.render_size(camera)
        features = traced.features.reshape(-1, height, width, self.config.num_features)
        image = features[..., :3]
        if self.config.upsamples:
            image = self.upsampler(bilinear(features, camera.height // 2, camera.width // 2))
        return Rendering(
            image=image.reshape(*views, camera.height, camera.width, 3),
            image_lr=features[..., :3].reshape(*views, height, width, 3),
            depth=traced.depth.reshape(*views, height, width),
            acc=traced.acc.reshape(*views, height, width),
        )

    def __call__(self, cloud: PointCloud, camera: Camera, key: Key | None = None, train: bool = False) -> Rendering:
        """Views of each cloud from its cameras."""
        return self.render(self.encode(cloud, train), camera, key=key)
