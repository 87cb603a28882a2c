"""The network near points on one page: its samples also see the points around them, and a CNN refines the picture.

    encode   the volume of the paper's network, and the surface that the points lie on      once per object
    render   a ray a pixel, samples near the points, light on their materials once per ray
             (`nn/surface_field.py`), refiner (`nn/refiner.py`)                              once per view

Objects lead, views follow: clouds are (objects, points, ...), cameras (objects, views, ...).
"""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from spnr_jax.config import AS_TRAINED, NearPointsConfig, RenderOptions, surface_grid
from spnr_jax.kernels import cameras, surface, voxels
from spnr_jax.kernels.numerics import length
from spnr_jax.kernels.records import Camera, Key, PointCloud, Rays, Rendering, Scene
from spnr_jax.method.march import Field, Finish, Samples, Seen, Traced, places, trace
from spnr_jax.nn.encoder import Encoder
from spnr_jax.nn.refiner import ODDS, Refiner
from spnr_jax.nn.surface_field import NUM_TOLD, SurfaceField, told


class NearPointsNetwork(nn.Module):
    """The generator: a volume and a surface from a cloud, pictures from both."""

    config: NearPointsConfig

    def setup(self) -> None:
        """Encoder, field, and the refiner if it has a width."""
        c = self.config
        self.encoder = Encoder(c.encoder, c.bf16)
        self.field = SurfaceField(c.field_width, c.direction_frequencies, c.sees_direction, c.color == "lit")
        if c.refiner_width:
            self.refiner = Refiner(c.refiner_width, bf16=c.bf16)

    def encode(self, cloud: PointCloud, train: bool = False) -> Scene:
        """Feature volume of each object, the surface of its points, and the cells of its grid that hold them."""
        cells = surface_grid(cloud.mask.shape[-1], self.config.surface_cells)
        occupied = jax.vmap(partial(voxels.occupied, resolution=cells))
        return Scene(
            volume=self.encoder(cloud, train),
            occupied=occupied(jnp.asarray(cloud.positions), jnp.asarray(cloud.mask)),
            surface=surface.estimate(cloud, self.config.num_neighbors, cells),
        )

    def render(
        self, scene: Scene, camera: Camera, options: RenderOptions = AS_TRAINED, key: Key | None = None
    ) -> Rendering:
        """Views of encoded objects.  A key jitters the samples (training)."""
        samples = options.sampling or self.config.sampling
        traced = trace(self, scene, self.rays(camera), samples, options, key)
        return self.developed(camera, traced, self.refines(options))

    def rays(self, camera: Camera) -> Rays:
        """Rays of all views of an object in one axis, (objects, views * height * width, 3)."""
        return cameras.view_rays(camera)

    def refines(self, options: RenderOptions) -> bool:
        """Whether the refiner is used, and rays carry its inputs."""
        return options.refine and self.config.refiner_width > 0

    def num_features(self, options: RenderOptions) -> int:
        """Of a ray: RGB, and the inputs of the refiner."""
        return 3 + NUM_TOLD * self.refines(options)

    def along(
        self, scene: Scene, rays: Rays, objects: Int[Array, "*rays"], options: RenderOptions
    ) -> tuple[Field, Finish]:
        """Density, and what the light depends on, at samples along rays; and the features of what is seen of it."""
        assert scene.surface is not None, "encoded for this network"
        known, view = scene.surface, self.field.view(rays.directions)

        def field(distances: Float[Array, "*rays samples"]) -> Samples:
            positions = places(rays, distances)
            owners = jnp.broadcast_to(objects[..., None], distances.shape)
            directions = jnp.broadcast_to(rays.directions[..., None, :], positions.shape).reshape(-1, 3)
            features = voxels.trilinear(scene.volume, positions, owners).reshape(len(directions), -1)
            seen = surface.describe(known, positions.reshape(-1, 3), directions, owners.reshape(-1))
            density, shaded = self.field(features, directions, seen)
            means, least = told(seen, directions) if self.refines(options) else ((), ())
            samples = Samples(density, (shaded, means), least)
            return jax.tree.map(lambda x: x.reshape(*distances.shape, *x.shape[1:]), samples)

        def finish(seen: Seen) -> Float[Array, "*rays features"]:
            shaded, means = seen.summed
            rgb = self.field.finish(shaded, seen.acc, view)
            return jnp.concatenate([rgb, *jax.tree.leaves((means, seen.least))], axis=-1)

        return field, finish

    def developed(self, camera: Camera, traced: Traced, refined: bool) -> Rendering:
        """Images from the rays of `rays`."""
        views, (height, width) = camera.cam_to_world.shape[:-2], (camera.height, camera.width)
        features, depth, acc = (x.reshape(-1, height, width, *x.shape[2:]) for x in traced)
        rgb = features[..., :3]
        image, depth, acc = self.refine(camera, Traced(features, depth, acc)) if refined else (rgb, depth, acc)
        images = (image, rgb, depth, acc)
        image, rgb, depth, acc = (x.reshape(*views, height, width, *x.shape[3:]) for x in images)
        return Rendering(image=image, image_lr=rgb, depth=depth, acc=acc)

    def refine(self, camera: Camera, pictures: Traced) -> tuple[Array, Array, Array]:
        """Image, depth and opacity after the refiner, from what was rendered (objects * views, height, width, ...)."""
        rays = cameras.view_rays(camera)
        _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        far = far.reshape(pictures.depth.shape)
        shrink = max(round(max(camera.height, camera.width) / self.config.image_resolution), 1)
        image, refined = self.refiner(self.looked_over(camera, pictures), shrink)
        distance = (pictures.depth - far) / jnp.maximum(pictures.acc, ODDS)  # of the object alone, from the far side
        return image, far + refined * distance, refined

    def looked_over(self, camera: Camera, pictures: Traced) -> Float[Array, "pictures height width features"]:
        """What the refiner sees of pictures (objects * views, height, width, ...)."""
        eye = length(jnp.asarray(camera.cam_to_world)[..., 3]).reshape(-1, 1, 1)
        depth = pictures.acc * (pictures.depth - eye)
        return jnp.concatenate([pictures.features, depth[..., None], pictures.acc[..., None]], axis=-1)

    def __call__(self, cloud: PointCloud, camera: Camera, key: Key | None = None, train: bool = False) -> Rendering:
        """Views of each cloud from its cameras."""
        return self.render(self.encode(cloud, train), camera, key=key)
