"""The method on one page: points -> features -> volume -> samples along rays -> image.

    encode   PointNet on every point, mean per voxel, 3D U-Net                     once per object
    render   rays, coarse samples, fine samples, compositing, 2D upsampler         once per view

Networks that see the nearest points have a refiner in the upsampler's place, or neither.

Objects lead, views follow: clouds are (objects, points, ...), cameras (objects, views, ...).
"""

import operator
from functools import partial, reduce

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from spnr_jax.devices.placement import divide_pixels, on_own_rays, undivided
from spnr_jax.kernels import cameras, compositing, occupancy, sampling, surface, voxels
from spnr_jax.kernels.numerics import clamp, length
from spnr_jax.kernels.occupancy import Path
from spnr_jax.kernels.records import Camera, Key, PointCloud, Rays, Rendering, Scene
from spnr_jax.kernels.resizing import bilinear
from spnr_jax.model_config import ModelConfig, surface_grid
from spnr_jax.nn.field import RadianceField
from spnr_jax.nn.pointnet import PointNet
from spnr_jax.nn.refiner import ODDS, Refiner
from spnr_jax.nn.surface_field import SurfaceField
from spnr_jax.nn.unet3d import UNet3D
from spnr_jax.nn.upsampler import Upsampler

CELLS_PER_VOXEL = 1  # of a path through the box, counted along an axis
RAY_BLOCK = 256  # rays near points that are rendered at once
CPU_BLOCK = 64  # the same on a CPU without a training's key: what they read stays in its first cache


class Renderer(nn.Module):
    """The generator: a volume from a cloud, pictures from a volume."""

    config: ModelConfig

    def setup(self) -> None:
        """Builds the parts that the config asks for."""
        c = self.config
        self.pointnet = PointNet(c.point_widths, c.point_features, c.point_norm)
        self.unet = UNet3D(c.volume_resolution, c.base_width, c.num_stages, c.num_groups, c.bf16, c.skip)
        self.field: RadianceField | SurfaceField
        if c.num_neighbors:
            self.field = SurfaceField(
                c.field_width, c.direction_frequencies, c.sees_direction, c.color == "lit", tells=c.refiner_width > 0
            )
        else:
            self.field = RadianceField(c.field_width, c.num_features, c.direction_frequencies, c.sees_direction)
        if c.upsamples:
            self.upsampler = Upsampler(c.upsampler_width, c.bf16)
        if c.refiner_width:
            self.refiner = Refiner(c.refiner_width, bf16=c.bf16)

    def encode(self, cloud: PointCloud, train: bool = False) -> Scene:
        """Feature volume of each object from its points, where these are, and the surface that they lie on."""
        positions, mask = jnp.asarray(cloud.positions), jnp.asarray(cloud.mask)
        features = self.pointnet(self.point_inputs(cloud), mask, train)
        spread = partial(voxels.spread, self.config.scatter, resolution=self.config.volume_resolution)
        volume = self.unet(*jax.vmap(spread)(positions, features, mask))
        near, cells = None, self.config.volume_resolution
        if self.config.num_neighbors:
            cells = surface_grid(mask.shape[-1], self.config.surface_cells)
            near = surface.estimate(cloud, self.config.num_neighbors, cells)
        occupied = jax.vmap(partial(voxels.occupied, resolution=cells))(positions, mask)
        return Scene(volume=volume, occupied=occupied, surface=near)

    def point_inputs(self, cloud: PointCloud) -> Float[Array, "objects points channels"]:
        """Position, offset from the centre of the own voxel, and the materials that the network is built for."""
        _, offset = voxels.locate(jnp.asarray(cloud.positions), self.config.volume_resolution)
        materials = [getattr(cloud, name) for name in self.config.materials]
        materials = [m[..., None] if m.ndim < cloud.positions.ndim else m for m in materials]
        inputs = jnp.concatenate([cloud.positions, offset, *materials], axis=-1)
        return jnp.where(cloud.mask[..., None], inputs, 0.0)

    def render(self, scene: Scene, camera: Camera, key: Key | None = None) -> Rendering:
        """Views of encoded objects; the camera's size is that of the image.  A key jitters the samples (training)."""
        rays = self.rays(camera)
        return self.develop(camera, *self.render_rays(scene, rays, key))

    def rays(self, camera: Camera) -> Rays:
        """Rays of the volume rendering for all views of an object in one axis, (objects, views * height * width, 3)."""
        return divide_pixels(cameras.view_rays(cameras.resize(camera, *self.render_size(camera))))

    def render_size(self, camera: Camera) -> tuple[int, int]:
        """Height and width of the volume rendering behind the camera's image."""
        ratio = self.config.render_resolution / self.config.image_resolution
        return round(camera.height * ratio), round(camera.width * ratio)

    def develop(
        self,
        camera: Camera,
        features: Float[Array, "objects rays k"],
        depth: Float[Array, "objects rays"],
        acc: Float[Array, "objects rays"],
    ) -> Rendering:
        """Images from the rays of `rays`: upsampler or refiner, and everything in its place."""
        views, (height, width) = camera.cam_to_world.shape[:-2], self.render_size(camera)
        features = undivided(features).reshape(-1, height, width, self.config.num_features)
        image = features[..., :3]
        depth, acc = (x.reshape(-1, height, width) for x in (depth, acc))
        if self.config.refiner_width:
            image, depth, acc = self.refine(camera, features, undivided(depth), undivided(acc))
        if self.config.upsamples:
            small = divide_pixels(bilinear(features, camera.height // 2, camera.width // 2))
            image = undivided(self.upsampler(small))
        return Rendering(
            image=image.reshape(*views, camera.height, camera.width, 3),
            image_lr=features[..., :3].reshape(*views, height, width, 3),
            depth=depth.reshape(*views, height, width),
            acc=acc.reshape(*views, height, width),
        )

    def refine(self, camera: Camera, features, depth, acc):
        """Image, depth and opacity after the refiner, from what was rendered (objects * views, height, width, ...)."""
        rays = cameras.view_rays(camera)
        _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        far = far.reshape(depth.shape)
        shrink = max(round(max(camera.height, camera.width) / self.config.image_resolution), 1)
        image, refined = self.refiner(self.seen(camera, features, depth, acc), shrink)
        distance = (depth - far) / jnp.maximum(acc, ODDS)  # of the object alone, from the far side
        return image, far + refined * distance, refined

    def seen(self, camera: Camera, features, depth, acc):
        """What the refiner sees of pictures (objects * views, height, width, ...)."""
        eye = length(jnp.asarray(camera.cam_to_world)[..., 3]).reshape(-1, 1, 1)
        return jnp.concatenate([features, (acc * (depth - eye))[..., None], acc[..., None]], axis=-1)

    def render_rays(
        self, scene: Scene, rays: Rays, key: Key | None = None
    ) -> tuple[Float[Array, "objects rays k"], Float[Array, "objects rays"], Float[Array, "objects rays"]]:
        """Feature vector (RGB on white first), expected distance and opacity of each ray."""
        if self.config.sampling.reach and not self.is_initializing():
            return self.render_near_points(scene, rays, key)
        near, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        view = self.field.view(rays.directions)
        shade = partial(self.shade, scene, rays, view)
        features, weights, distances = self.march(shade, near, far, view, key)
        return features, compositing.expected_distance(weights, distances, far), jnp.sum(weights, axis=-1)

    def render_near_points(self, scene: Scene, rays: Rays, key: Key | None):
        """`render_rays` with samples near the points alone: rays that miss them are white and cost nothing."""
        renderer, variables = self.unbind()
        shape = rays.origins.shape[:-1]
        number = jnp.arange(shape[0] * shape[1]).reshape(shape)

        def own(whole, scene, own_rays):
            variables, key = whole
            return renderer.bind(variables).render_open(scene, *own_rays, key)

        return on_own_rays(own, (variables, key), scene, (rays, number))

    def render_open(self, scene: Scene, rays: Rays, number: Int[Array, "objects rays"], key: Key | None):
        """`render_near_points` on one device; what a ray draws depends on its number, not on those beside it."""
        near, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        near_points = occupancy.dilate(scene.occupied, self.config.sampling.reach)
        path = occupancy.open_path(near_points, rays, near, far, CELLS_PER_VOXEL * scene.occupied.shape[-1])
        renderer, variables = self.unbind()

        def block(objects, number, rays, far, path):
            keys = None if key is None else jax.vmap(jax.random.fold_in, (None, 0))(key, number)
            return renderer.bind(variables).march_open(scene, objects, rays, far, path, keys)

        shape = near.shape
        objects = jnp.broadcast_to(jnp.arange(shape[0])[:, None], shape)
        inputs = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (objects, number, rays, far, path))
        far, path = inputs[-2:]
        size = CPU_BLOCK if key is None and jax.default_backend() == "cpu" else RAY_BLOCK
        white = jnp.zeros((far.size, self.config.num_features)).at[:, :3].set(compositing.WHITE)
        outputs = occupancy.map_existing(
            block, path.travelled[:, -1] > 0, inputs, (white, far, jnp.zeros_like(far)), size
        )
        return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), outputs)

    def march_open(self, scene: Scene, objects: Int[Array, " rays"], rays: Rays, far, path: Path, key: Key | None):
        """Outputs of `render_rays` for rays of given objects, sampled along the open part of each."""
        view = self.field.view(rays.directions)

        def shade(travelled):
            return self.shade(scene, rays, view, occupancy.distance_at(path, travelled), objects)

        length = path.travelled[..., -1]
        features, weights, travelled = self.march(shade, jnp.zeros_like(length), length, view, key)
        distances = occupancy.distance_at(path, travelled)
        return features, compositing.expected_distance(weights, distances, far), jnp.sum(weights, axis=-1)

    def shade(self, scene: Scene, rays: Rays, view, distances: Float[Array, "*rays samples"], objects=None):
        """The radiance field at each sample; `objects` as `voxels.trilinear` has them, one for each ray."""
        positions = rays.origins[..., None, :] + distances[..., None] * rays.directions[..., None, :]
        # rays end on the faces of the box: rounding must not push their samples out of it
        positions = clamp(positions, -1, 1)
        if objects is not None:
            objects = jnp.broadcast_to(objects[..., None], distances.shape)
        features = voxels.trilinear(scene.volume, positions, objects)
        if isinstance(self.field, RadianceField):
            return self.field(features, view)
        assert scene.surface is not None, "encoded for this field"
        if objects is None:
            objects = jnp.broadcast_to(jnp.arange(len(positions))[:, None, None], distances.shape)
        directions = jnp.broadcast_to(rays.directions[..., None, :], positions.shape).reshape(-1, 3)
        seen = surface.describe(scene.surface, positions.reshape(-1, 3), directions, objects.reshape(-1))
        outputs = self.field(features.reshape(len(directions), -1), directions, seen)
        return jax.tree.map(lambda x: x.reshape(*distances.shape, *x.shape[1:]), outputs)

    def march(self, shade, near, far, view, key: Key | None):
        """Features of rays that `shade` evaluates between near and far, and weights and places of their samples.

        The key is one for all rays, or one for each.
        """
        counts = self.config.sampling
        coarse_key, fine_key = (None, None) if key is None else sampling.split(key)
        distances, edges = sampling.stratified(coarse_key, near, far, counts.num_coarse)
        density, emitted = shade(distances)
        if self.config.refiner_width:
            *emitted, least = emitted
            least = jnp.min(least, axis=-2)
        weights, _ = compositing.volume_weights(density, compositing.interval_lengths(distances, far))
        passes = [(weights, emitted)]
        if counts.num_fine:
            fine = sampling.importance(fine_key, edges, weights, counts.num_fine, counts.padding)
            fine_density, fine_emitted = shade(fine)
            weights = union_weights(distances, fine, jnp.concatenate([density, fine_density], axis=-1), far)
            distances = jnp.concatenate([distances, fine], axis=-1)
            parts = jnp.split(weights, [counts.num_coarse], axis=-1)
            passes = [(parts[0], emitted), (parts[1], fine_emitted)]

        # each pass is composited where it lies: sums do not mind the order, and nothing wide is concatenated
        sums = [jax.tree.map(partial(compositing.composite, w), emitted) for w, emitted in passes]
        emitted = jax.tree.map(lambda *parts: reduce(operator.add, parts), *sums)
        acc = jnp.sum(weights, axis=-1)
        if self.config.refiner_width:
            *emitted, means = emitted
        features = self.field.finish(tuple(emitted), acc, view)
        if self.config.refiner_width:
            features = jnp.concatenate([features, means, least], axis=-1)
        return features, weights, distances

    def __call__(self, cloud: PointCloud, camera: Camera, key: Key | None = None, train: bool = False) -> Rendering:
        """Views of each cloud from its cameras."""
        return self.render(self.encode(cloud, train), camera, key)


def union_weights(
    coarse: Float[Array, "*batch n"],
    fine: Float[Array, "*batch m"],
    density: Float[Array, "*batch n+m"],
    far: Float[Array, "*batch"],
) -> Float[Array, "*batch n+m"]:
    """Compositing weights of coarse and fine samples together, in the order [coarse, fine].

    Only densities are sorted along the ray; what the weights multiply can stay where it is.
    """
    order, rank = sampling.merge(coarse, fine)
    distances = jnp.concatenate([coarse, fine], axis=-1)
    distances, density = (jnp.take_along_axis(x, order, axis=-1) for x in (distances, density))
    weights, _ = compositing.volume_weights(density, compositing.interval_lengths(distances, far))
    return jnp.take_along_axis(weights, rank, axis=-1)
