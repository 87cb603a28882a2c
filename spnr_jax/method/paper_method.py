"""The paper's method on one page: points -> volume -> features along rays -> image.

    encode        PointNet on every point, mean per voxel, 3D U-Net (`nn/paper_layers.py`)        once per object
    render        64 x 64 rays, 64 coarse and 64 fine samples, field, compositing, 2D upsampler   once per view
    render_rays   empty rays are skipped, the others rendered in blocks on the device of their object
    march         rays of a block: coarse samples, fine samples where the coarse weights are large, compositing

It uses the loss of Linen modules (`inference.loss`) and a discriminator.  The first axis is objects, the second views:
clouds are (objects, points, ...), cameras (objects, views, ...).  A *field* is a function from distances along rays
(*rays, samples) to `Samples`.
"""

import dataclasses
import operator
from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from spnr_jax.config import PaperConfig, SamplingConfig, TrainConfig
from spnr_jax.devices.programs import split_objects
from spnr_jax.kernels import cameras, compositing, sampling, voxels
from spnr_jax.kernels.imaging import WHITE, resize_bilinear
from spnr_jax.kernels.numerics import clamp
from spnr_jax.kernels.records import LARGEST_REACH, Camera, Key, Light, PointCloud, Rays, Rendering, Scene, Volume
from spnr_jax.kernels.voxels import RayPath
from spnr_jax.method import inference
from spnr_jax.nn.paper_layers import Discriminator, Encoder, RadianceField, Upsampler

SAMPLES = {"draft": 0.25, "balanced": 0.5, "best": 1.0}  # share of the samples per ray in training
REACH_QUERIES = 4096  # points at which the spacing is measured
REACH_PER_SPACING = 1.6  # the smallest reach that loses nothing from 128 to 4096 points, docs/lab/cpu_forms.md
WHOLE_BLOCK = 1024  # rays through all the box that are rendered at once: about 80 MB at 128 samples
RAY_BLOCK = 256  # rays near points that are rendered at once
CPU_BLOCK = 64  # the same on a CPU outside of training: what a block reads stays in the first-level cache
HIT_BLOCK = 2**14  # rays that are tested at once for whether they hit anything


class Samples(NamedTuple):
    """The field at samples: density, and a pytree (*rays, samples, ...) of values to composite."""

    density: Array
    summed: Any


class CompositedRays(NamedTuple):
    """Rays after compositing: the composited values `summed`, opacity, and expected distance."""

    summed: Any
    acc: Array
    depth: Array


class RenderedRays(NamedTuple):
    """Rays of objects: features (the first three are RGB on white), expected distance, opacity."""

    features: Float[Array, "*rays k"]
    depth: Float[Array, "*rays"]
    acc: Float[Array, "*rays"]


Field = Callable[[Float[Array, "*rays samples"]], Samples]
Decode = Callable[[CompositedRays], Float[Array, "*rays k"]]


class PaperNetwork(nn.Module):
    """The generator: encodes clouds to volumes, and renders volumes."""

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
        occupied = jax.vmap(partial(voxels.mark_occupied, resolution=self.config.encoder.volume_resolution))
        return Scene(volume=volume, occupied=occupied(jnp.asarray(cloud.positions), jnp.asarray(cloud.mask)))

    def render(self, scene: Scene, camera: Camera) -> Rendering:
        """Views of encoded objects, some rays at a time; the camera's size is that of the image."""
        return self.draw(scene, camera, None if self.config.sampling.reach else WHOLE_BLOCK)

    def draw(self, scene: Scene, camera: Camera, block: int | None, key: Key | None = None) -> Rendering:
        """Views of encoded objects, `block` rays at a time (`render_rays`).  A key jitters the samples (training)."""
        drawn = render_rays(self, scene, self.rays(camera), self.config.sampling, block, key)
        return self.decode_images(camera, drawn)

    def rays(self, camera: Camera) -> Rays:
        """Rays of the volume rendering for all views of an object in one axis, (objects, views * height * width, 3)."""
        return cameras.view_rays(cameras.resize(camera, *self.render_size(camera)))

    def render_size(self, camera: Camera) -> tuple[int, int]:
        """Height and width of the volume rendering behind the camera's image."""
        ratio = self.config.render_resolution / self.config.image_resolution
        return round(camera.height * ratio), round(camera.width * ratio)

    def make_field(self, scene: Scene, rays: Rays, objects: Int[Array, "*rays"]) -> tuple[Field, Decode]:
        """The field along rays (density, emitted values), and the function from composited values to features."""
        view = self.field.view(rays.directions)

        def field(distances: Float[Array, "*rays samples"]) -> Samples:
            owners = jnp.broadcast_to(objects[..., None], distances.shape)
            return Samples(*self.field(voxels.trilinear(scene.volume, locate_samples(rays, distances), owners), view))

        def decode(composited: CompositedRays) -> Float[Array, "*rays features"]:
            return self.field.decode(composited.summed, composited.acc, view)

        return field, decode

    def decode_images(self, camera: Camera, rendered: RenderedRays) -> Rendering:
        """Images from the rays of `rays`: the feature image is resized, and the upsampler doubles it."""
        views, (height, width) = camera.cam_to_world.shape[:-2], self.render_size(camera)
        features = rendered.features.reshape(-1, height, width, self.config.num_features)
        image = features[..., :3]
        if self.config.upsamples:
            image = self.upsampler(resize_bilinear(features, camera.height // 2, camera.width // 2))
        return Rendering(
            image=image.reshape(*views, camera.height, camera.width, 3),
            image_lr=features[..., :3].reshape(*views, height, width, 3) if self.config.upsamples else None,
            depth=rendered.depth.reshape(*views, height, width),
            acc=rendered.acc.reshape(*views, height, width),
        )

    def __call__(self, cloud: PointCloud, camera: Camera, key: Key | None = None, train: bool = False) -> Rendering:
        """Views of each cloud from its cameras, all rays at once."""
        return self.draw(self.encode(cloud, train), camera, None, key)


# --- rays -------------------------------------------------------------------------------------------------------------


def render_rays(
    module: Any, scene: Scene, rays: Rays, samples: SamplingConfig, block_size: int | None, key: Key | None
) -> RenderedRays:
    """Renders rays (objects, rays, ...).  A key jitters the samples; each ray folds in its own number.

    `block_size` rays are rendered at once; None: all, or a default if samples lie only near points.  The network is a
    bound Linen module.  `make_field(scene, rays, objects)` returns its field and the function from `CompositedRays` to
    features; `config.num_features` is the number of features of a ray.
    """
    shape = rays.origins.shape[:-1]
    number = jnp.arange(shape[0] * shape[1]).reshape(shape)
    if module.is_initializing():
        return _on_one_device(lambda: module, scene, rays, number, samples, block_size, key)
    network, variables = module.unbind()  # JAX transformations must not close over a bound module

    def render_own(whole, scene, own_rays):
        variables, key = whole
        return _on_one_device(lambda: network.bind(variables), scene, *own_rays, samples, block_size, key)

    return split_objects(render_own, (variables, key), scene, (rays, number))


def _on_one_device(
    make_network: Callable[[], Any],
    scene: Scene,
    rays: Rays,
    number: Int[Array, "objects rays"],
    samples: SamplingConfig,
    block_size: int | None,
    key: Key | None,
) -> RenderedRays:
    """`render_rays` for the rays of one device; `make_network` binds the Linen module anew inside transformations."""
    shape = number.shape
    objects = jnp.broadcast_to(jnp.arange(shape[0])[:, None], shape)
    inputs = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (objects, number, rays))
    near_points = voxels.dilate(scene.occupied, samples.reach) if samples.reach else None

    def block(objects, number, rays):
        field, decode = make_network().make_field(scene, rays, objects)
        keys = None if key is None else jax.vmap(jax.random.fold_in, (None, 0))(key, number)
        composited = march(field, _path(near_points, rays, objects), samples, keys)
        return RenderedRays(decode(composited), composited.depth, composited.acc)

    if block_size is None and samples.reach:
        block_size = CPU_BLOCK if key is None and jax.default_backend() == "cpu" else RAY_BLOCK
    if block_size is None or make_network().is_initializing():  # then there are no weights yet that a block could read
        rendered = block(*inputs)
    else:
        objects, _, rays = inputs
        _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        white = jnp.zeros((far.size, make_network().config.num_features)).at[:, :3].set(WHITE)
        missed = RenderedRays(white, far, jnp.zeros_like(far))
        rendered = voxels.map_existing(block, _find_hits(near_points, rays, objects), inputs, missed, block_size)
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), rendered)


def _path(near_points: Bool[Array, "objects g g g"] | None, rays: Rays, objects: Int[Array, "*rays"]) -> RayPath:
    """The sampled part of each ray: its segments near points, or all of it inside the box."""
    near, far, _ = cameras.intersect_box(rays.origins, rays.directions)
    if near_points is None:
        return voxels.whole_path(near, far)
    return voxels.open_path(near_points, rays, near, far, near_points.shape[-1], objects)


def _find_hits(
    near_points: Bool[Array, "objects g g g"] | None, rays: Rays, objects: Int[Array, " rays"]
) -> Bool[Array, " rays"]:
    """Whether a ray has anything to sample; paths are large, so they are not stored."""
    return jax.lax.map(lambda x: _path(near_points, *x).travelled[-1] > 0, (rays, objects), batch_size=HIT_BLOCK)


def locate_samples(rays: Rays, distances: Float[Array, "*rays samples"]) -> Float[Array, "*rays samples 3"]:
    """Positions of samples, clamped to the box: rays end on its faces, and rounding must not push samples out."""
    return clamp(rays.origins[..., None, :] + distances[..., None] * rays.directions[..., None, :], -1, 1)


def march(field: Field, path: RayPath, counts: SamplingConfig, key: Key | None) -> CompositedRays:
    """Renders a field along paths; `key` is one key for all rays, or one per ray."""
    coarse_key, fine_key = (None, None) if key is None else sampling.split(key)
    length, far = path.travelled[..., -1], path.edges[..., -1]
    coarse, edges = sampling.stratified(coarse_key, jnp.zeros_like(length), length, counts.num_coarse)
    passes = [field(voxels.distance_at(path, coarse))]
    weights, _ = compositing.volume_weights(passes[0].density, compositing.interval_lengths(coarse, length))
    travelled, shares = coarse, [weights]
    if counts.num_fine:
        # 64 fine samples where the coarse weights are large [paper]; both sets are composited together
        fine = sampling.importance(fine_key, edges, weights, counts.num_fine, counts.padding)
        passes.append(field(voxels.distance_at(path, fine)))
        density = jnp.concatenate([samples.density for samples in passes], axis=-1)
        weights = union_weights(coarse, fine, density, length)
        travelled = jnp.concatenate([coarse, fine], axis=-1)
        shares = jnp.split(weights, [counts.num_coarse], axis=-1)

    # coarse and fine samples are summed separately: the order does not matter, and no large arrays are concatenated
    sums = [
        jax.tree.map(partial(compositing.composite, share), samples.summed)
        for share, samples in zip(shares, passes, strict=True)
    ]
    return CompositedRays(
        summed=jax.tree.map(lambda *parts: reduce(operator.add, parts), *sums),
        acc=jnp.sum(weights, axis=-1),
        depth=compositing.expected_distance(weights, voxels.distance_at(path, travelled), far),
    )


def union_weights(
    coarse: Float[Array, "*batch n"],
    fine: Float[Array, "*batch m"],
    density: Float[Array, "*batch n+m"],
    far: Float[Array, "*batch"],
) -> Float[Array, "*batch n+m"]:
    """Compositing weights of coarse and fine samples together, in the order [coarse, fine].

    Only the densities are sorted along the ray; the values that the weights multiply need not be.
    """
    order, rank = sampling.merge(coarse, fine)
    distances = jnp.concatenate([coarse, fine], axis=-1)
    distances, density = (jnp.take_along_axis(x, order, axis=-1) for x in (distances, density))
    weights, _ = compositing.volume_weights(density, compositing.interval_lengths(distances, far))
    return jnp.take_along_axis(weights, rank, axis=-1)


# --- the functions of the method --------------------------------------------------------------------------------------


def encode_object(
    variables: dict, cloud: PointCloud, centre: np.ndarray, scale: np.floating, *, config: PaperConfig
) -> Volume:
    """Volume of a cloud in the box (unbatched), and how far from its points rays are sampled."""
    reach = estimate_reach(np.asarray(cloud.positions)[np.asarray(cloud.mask)], config.encoder.volume_resolution)
    volume = inference.encode_object(variables, cloud, centre, scale, config=config)
    return dataclasses.replace(volume, reach=reach)


def render_each(
    variables: dict,
    volume: Volume,
    views: Sequence[Camera],
    lights: Sequence[Light | None],
    *,
    config: PaperConfig,
    quality: str,
) -> Iterator[Rendering]:
    """Views one after the other, with the number of samples of a quality level."""
    config = choose_samples(config, quality, volume.reach)
    return inference.render_each(variables, volume, views, lights, config=config, quality=quality)


def choose_samples(config: PaperConfig, quality: str, reach: int) -> PaperConfig:
    """The network with the samples of a quality level, which lie only within `reach` voxels of points."""
    if quality == "trained":
        return config
    counts = config.sampling
    samples = max(round(SAMPLES[quality] * (counts.num_coarse + counts.num_fine)), 1)
    return dataclasses.replace(config, sampling=SamplingConfig(num_coarse=samples, num_fine=0, reach=reach))


def discriminator(config: TrainConfig) -> Discriminator:
    """The PatchGAN discriminator of images and condition images."""
    assert isinstance(config.model, PaperConfig)
    return Discriminator(config.loss.discriminator_width, config.model.encoder.num_groups, config.model.bf16)


def estimate_reach(positions: np.ndarray, resolution: int) -> int:
    """Distance from points, in voxels, within which the surface lies; from the median distance to the nearest neighbor.

    Duplicates of a point (closer than 1/1024 of the box) count once.
    """
    x, y, z = np.floor((positions.T + 1) * 512).astype(np.int64)
    _, distinct = np.unique((x * 2048 + y) * 2048 + z, return_index=True)
    positions = positions[distinct]
    if len(positions) < 2:
        return LARGEST_REACH
    queries = positions[:: -(-len(positions) // REACH_QUERIES)]
    distances, _ = cKDTree(positions).query(queries, 2)
    spacing = np.median(distances[:, 1]) * resolution / 2
    return int(np.clip(np.ceil(REACH_PER_SPACING * spacing), 1, LARGEST_REACH))
