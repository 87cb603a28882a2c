"""Point-NeRF as adapted by the paper: an MLP over the nearest points of every place along a ray that has any.

    ray -> even candidates -> the first of them within reach of a point -> nearest points of each -> MLP -> density, RGB

Point-NeRF (Xu et al., 2022) learns a feature for every point of one scene; here a point carries its materials, so that
one network serves all objects, and nothing is grown, pruned or weighted by confidence.  Reach is a ball of `radius` in
units of the box [-1, 1]^3, in which an object's half-diagonal is 1: 0.1 is a twentieth of its diagonal.  Nearest points
are exact.  A ray without a point in reach is exactly white and has opacity 0; `loss` leaves it out.

Most of space is empty, so the work is done in blocks of shading points that exist, and blocks beyond the last of them
are skipped: time follows what there is, memory is that of a block.  The geometry has no gradient.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from experiments.baselines import ray_chunks
from spnr_jax.config import (
    MATERIAL_CHANNELS,
    NetworkConfig,
    OptimizerConfig,
    TrainConfig,
    check,
)
from spnr_jax.devices.programs import split_objects
from spnr_jax.errors import require
from spnr_jax.kernels import cameras, compositing, losses, sampling
from spnr_jax.kernels.imaging import WHITE
from spnr_jax.kernels.metrics import psnr
from spnr_jax.kernels.numerics import length, per_feature
from spnr_jax.kernels.records import Batch, Camera, Key, PointCloud, Rays, Record, Rendering
from spnr_jax.kernels.voxels import map_existing
from spnr_jax.method.inference import opacity_loss
from spnr_jax.methods import Outcome
from spnr_jax.nn.paper_layers import encode_direction, waves

BLOCK = 1024  # shading points at once: 8 MB for a layer of 256 with 8 neighbours
SLOPE, GAIN = 0.01, math.sqrt(2 / (1 + 0.01**2))  # of the leaky ReLU, and what it asks of the weights before it
WIDENED = 0.001  # colours reach past [0, 1] by this, so that 0 and 1 are not at infinity

Layer = tuple[Array, Array]  # kernel and bias
Weights = Mapping[str, Sequence[Layer]]


@dataclass(frozen=True, kw_only=True)
class PointNeRFConfig(NetworkConfig):
    """Sizes of Point-NeRF; the defaults are the published ones and the paper's."""

    method: ClassVar[str] = "point_nerf"

    radius: float = 0.1
    """Reach of a point [paper], in units of the box [-1, 1]^3 whose object has a half-diagonal of 1."""
    num_neighbors: int = 8
    """Nearest points inside the radius that a shading point sees [paper]."""
    num_candidates: int = 400
    """Even steps along each ray, of which those within reach of a point can be shaded."""
    num_samples: int = 64
    """Shading points of a ray: the first candidates within reach [paper]."""
    jitter: float = 0.3
    """How far a candidate moves in training, as a share of a step."""
    width: int = 256
    """Hidden layers of the MLPs that see a neighbour."""
    color_width: int = 128
    """Hidden layers of the MLP that sees the averaged feature and the view direction."""
    feature_frequencies: int = 3
    """Frequencies of the encoding of the materials."""
    offset_frequencies: int = 5
    """Frequencies of the encoding of the offset from neighbour to shading point."""
    direction_frequencies: int = 4
    """Frequencies of the encoding of the view direction."""
    density_scale: float = 1.0
    """Density of one unit of the network's output, per unit of the box; 1 as published, where it learns slowly."""
    ray_chunk: int = 256
    """Rays of an object rendered at once in evaluation."""
    pixel_stride: int = 1
    """Trained on every n-th row and column of a view, at a random offset."""

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = "num_neighbors", "num_candidates", "num_samples", "width", "color_width", "ray_chunk", "pixel_stride"
        check(self, positive=(*counts, "radius", "density_scale"), shares=("jitter",))
        require(
            self.num_samples <= self.num_candidates,
            f"num_samples {self.num_samples} must not exceed num_candidates {self.num_candidates}",
        )
        ray_chunks.check_stride(self)


def published_config(size: int) -> TrainConfig:
    """The published training at 128 (ABO) or 200 pixels (ShapeNet), 1024 or 1600 rays a step; meant for one GPU."""
    return TrainConfig(
        preset=f"point_nerf, {size} px, as published",
        model=PointNeRFConfig(image_resolution=size, pixel_stride={128: 4, 200: 5}[size]),
        loss=ray_chunks.SQUARES,
        optimizer=OptimizerConfig(lr_generator=5e-4, warmup_steps=0, decay="exponential"),
        num_steps=1_000_000,
        batch_objects=1,
    )


def point_nerf_tiny() -> TrainConfig:
    """Narrower, fewer samples, denser, 64 px, minutes on two cores.

    `spnr train --methods experiments.baselines --preset point_nerf_tiny DATA RUN`
    """
    return TrainConfig(
        preset="point_nerf_tiny",
        model=PointNeRFConfig(
            num_candidates=80,
            num_samples=24,
            width=64,
            color_width=32,
            density_scale=20.0,  # at the published 1 the objects are still fog after 1200 steps
            image_resolution=64,
            ray_chunk=1024,
            pixel_stride=4,
        ),
        loss=ray_chunks.SQUARES,
        optimizer=OptimizerConfig(lr_generator=2e-3, warmup_steps=100, ema_decay=0.995),
        num_steps=1200,
        batch_objects=4,
        max_points=1024,
    )


class ViewRays(Record):
    """Rays, and for each the axes of its camera as columns: offsets are seen from the world and from the camera."""

    rays: Rays
    axes: Float[Array, "*batch 3 3"]


class ShadingPoints(Record):
    """Where a ray is shaded; a ray with fewer than its share has them first, and the rest do not exist."""

    distances: Float[Array, "*batch samples"]
    delta: Float[Array, "*batch samples"]
    exists: Bool[Array, "*batch samples"]


def candidates(
    key: Key | None, near: Float[Array, "*batch"], far: Float[Array, "*batch"], count: int, jitter: float
) -> Float[Array, "*batch {count}"]:
    """Sorted distances at the middles of equal steps; a key moves each by up to half of `jitter` steps."""
    middle = (jnp.arange(count, dtype=jnp.float32) + 0.5) / count
    at = per_feature(middle, near[..., None]) + jnp.zeros_like(near)[..., None]
    if key is not None:
        at = at + jitter / count * (jax.random.uniform(key, at.shape) - 0.5)
    return near[..., None] + (far - near)[..., None] * at


def within_reach(
    rays: Rays, distances: Float[Array, "rays n"], cloud: PointCloud, radius: float
) -> Bool[Array, "rays n"]:
    """Whether a point lies within `radius` of each place along the rays: whether it lies on the chord of its ball."""
    # axis by axis, points leading: as (points, rays, 3) it takes four times as long
    axes = [(cloud.positions[:, i, None] - rays.origins[None, :, i], rays.directions[None, :, i]) for i in range(3)]
    along = sum(offset * direction for offset, direction in axes)
    beside = sum((offset - along * direction) ** 2 for offset, direction in axes)
    crossed = cloud.mask[:, None] & (beside <= radius**2)
    half = jnp.sqrt(jnp.maximum(radius**2 - beside, 0))
    entry, leave = jnp.where(crossed, along - half, jnp.inf), jnp.where(crossed, along + half, -jnp.inf)

    def union(found, chord):  # point by point: a reduction of all pairs at once takes ten times as long on a CPU
        entry, leave = chord
        return found | ((distances >= entry[:, None]) & (distances <= leave[:, None])), None

    return jax.lax.scan(union, jnp.zeros(distances.shape, bool), (entry, leave), unroll=8)[0]


def shading_points(
    distances: Float[Array, "*batch n"], reach: Bool[Array, "*batch n"], count: int, voxel: float
) -> ShadingPoints:
    """The first `count` candidates within reach, and the length that each owns: up to the next one.

    Across a gap (more than two voxels), and for the last one, that is a voxel.
    """
    rank = jnp.cumsum(reach, axis=-1)
    wanted = jnp.broadcast_to(per_feature(jnp.arange(count), rank), (*rank.shape[:-1], count))
    exists = wanted < rank[..., -1:]
    index = jnp.minimum(sampling.count_at_most(rank, wanted), distances.shape[-1] - 1)
    kept = jnp.take_along_axis(distances, index, axis=-1)
    step = jnp.diff(kept, axis=-1, append=kept[..., -1:])
    follows = jnp.concatenate([exists[..., 1:], jnp.zeros_like(exists[..., :1])], axis=-1)
    near_next = follows & (step >= 1e-8) & (step <= 2 * voxel)
    return ShadingPoints(distances=kept, delta=jnp.where(near_next, step, voxel), exists=exists)


def nearest_points(
    places: Float[Array, "places 3"], cloud: PointCloud, count: int, radius: float
) -> tuple[Int[Array, "places k"], Bool[Array, "places k"]]:
    """Indices of the nearest points of each place, and which of them lie within the radius; of equals the first."""
    squared = sum((places[:, i : i + 1] - cloud.positions[None, :, i]) ** 2 for i in range(3))
    squared = jnp.where(cloud.mask[None], squared, jnp.inf)
    closeness, index = jax.lax.top_k(-squared, min(count, squared.shape[-1]))
    return index, -closeness <= radius**2


def point_features(cloud: PointCloud, frequencies: int) -> Float[Array, "points channels"]:
    """The materials of each point and their waves."""
    materials = jnp.concatenate([cloud.base_color, cloud.roughness[:, None], cloud.metallic[:, None]], axis=-1)
    return encode_direction(materials, frequencies)


def mlp(layers: Sequence[Layer], x: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
    """Dense layers with a leaky ReLU after each."""
    for layer in layers:
        x = nn.leaky_relu(dense(layer, x), SLOPE)
    return x


def dense(layer: Layer, x: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
    """One layer without activation."""
    return x @ layer[0] + per_feature(layer[1], x)


def shade(
    weights: Weights,
    config: PointNeRFConfig,
    cloud: PointCloud,
    features: Float[Array, "points channels"],
    places: Float[Array, "places 3"],
    directions: Float[Array, "places 3"],
    axes: Float[Array, "places 3 3"],
) -> tuple[Float[Array, " places"], Float[Array, "places 3"]]:
    """Density and RGB at places of one object, from its points' `features`; density 0 where no point is in reach."""
    index, valid = nearest_points(places, cloud, config.num_neighbors, config.radius)
    offset = places[:, None] - cloud.positions[index]
    seen = jnp.einsum("pkj,pji->pki", offset, axes, precision="highest")
    encoded = jnp.concatenate(waves(jnp.concatenate([offset, seen], axis=-1), config.offset_frequencies), axis=-1)
    feature = mlp(weights["near"], jnp.concatenate([features[index], encoded], axis=-1))
    feature = mlp(weights["colored"], jnp.concatenate([feature, cloud.base_color[index]], axis=-1))
    density = config.density_scale * nn.softplus(dense(weights["density"][0], feature)[..., 0] - 1)
    away = jnp.maximum(length(offset), 1e-6)
    share = jnp.where(valid, 1 / away, 0.0)
    share = share / jnp.maximum(jnp.sum(share, axis=-1, keepdims=True), 1e-8)
    feature = jnp.einsum("pk,pkc->pc", share, feature)
    view = jnp.concatenate(waves(directions, config.direction_frequencies), axis=-1)
    hidden = mlp(weights["color"][:-1], jnp.concatenate([feature, view], axis=-1))
    rgb = nn.sigmoid(dense(weights["color"][-1], hidden)) * (1 + 2 * WIDENED) - WIDENED
    return jnp.sum(share * density, axis=-1), rgb


class PointNeRF(nn.Module):
    """Pictures from the points themselves: there is nothing to encode."""

    config: PointNeRFConfig

    def setup(self) -> None:
        """The layers' weights; `shade` is a pure function of them."""
        c, channels = self.config, sum(MATERIAL_CHANNELS.values())
        inputs = channels * (1 + 2 * c.feature_frequencies) + 6 * 2 * c.offset_frequencies
        view = 3 * 2 * c.direction_frequencies
        sizes = {
            "near": (inputs, c.width, c.width),
            "colored": (c.width + 3, c.width, c.width),
            "density": (c.width, 1),
            "color": (c.width + view, *[c.color_width] * 3, 3),
        }
        self.weights = {
            name: [
                self.layer(f"{name}_{i}", n, m, 1.0 if m == widths[-1] and m <= 3 else GAIN)
                for i, (n, m) in enumerate(zip(widths, widths[1:], strict=False))
            ]
            for name, widths in sizes.items()
        }

    def layer(self, name: str, inputs: int, outputs: int, gain: float) -> Layer:
        """Kernel and bias of a dense layer: uniform after Glorot times the gain, and 0."""
        init = nn.initializers.variance_scaling(gain**2, "fan_avg", "uniform")
        kernel = self.param(f"{name}_kernel", init, (inputs, outputs))
        return kernel, self.param(f"{name}_bias", nn.initializers.zeros, (outputs,))

    def encode(self, cloud: PointCloud, train: bool = False) -> PointCloud:
        """The cloud."""
        return cloud

    def rays(self, camera: Camera) -> ViewRays:
        """Rays of all views of an object in one axis, (objects, views * height * width, ...)."""
        axes = jnp.repeat(camera.cam_to_world[..., :3], camera.height * camera.width, axis=1)
        return ViewRays(rays=cameras.view_rays(camera), axes=axes)

    def render_rays(
        self, cloud: PointCloud, view: ViewRays, key: Key | None = None
    ) -> tuple[Float[Array, "objects rays 3"], Float[Array, "objects rays"], Float[Array, "objects rays"]]:
        """RGB on white, expected distance and opacity of each ray, one object after the other."""
        near, far, hit = cameras.intersect_box(view.rays.origins, view.rays.directions)
        distances = candidates(key, near, far, self.config.num_candidates, self.config.jitter)

        def own(weights, cloud, of_rays):
            one = partial(render_object, weights, self.config)
            return jax.lax.map(lambda x: one(*x), (cloud, *of_rays))

        cloud = jax.tree.map(jnp.asarray, cloud)
        return split_objects(own, self.weights, *jax.lax.stop_gradient((cloud, (view, distances, far, hit))))

    def render(self, cloud: PointCloud, camera: Camera) -> Rendering:
        """Views of each cloud, some rays at a time."""
        return ray_chunks.render(self, cloud, camera, self.rays(camera), self.config.ray_chunk)

    def __call__(self, cloud: PointCloud, camera: Camera, key: Key | None = None, train: bool = False) -> Rendering:
        """Views of each cloud from its cameras, all rays at once.  A key moves the candidates (training)."""
        return ray_chunks.as_images(camera, *self.render_rays(self.encode(cloud, train), self.rays(camera), key))


def loss(
    variables: dict, batch: Batch, key: Key | None = None, *, config: TrainConfig
) -> tuple[Float[Array, ""], Outcome]:
    """(errors of the rays with a point in reach, and of the opacity, weighted as the config says; outcome)."""
    assert isinstance(config.model, PointNeRFConfig)
    key, batch = ray_chunks.choose_pixels(key, batch, config.model.pixel_stride)
    rendering: Any = PointNeRF(config.model).apply(variables, batch.cloud, batch.camera, key, train=True)
    hit, reference = rendering.acc[..., None] > 0, jnp.asarray(batch.image)
    off, count = jnp.where(hit, rendering.image - reference, 0), jnp.maximum(3 * jnp.sum(hit), 1)
    value = config.loss.l1_weight * jnp.sum(jnp.abs(off)) + config.loss.mse_weight * jnp.sum(off**2)
    metrics = {"psnr": jnp.mean(psnr(rendering.image, reference)), "l1": losses.l1(rendering.image, reference)}
    return value / count + opacity_loss(config, rendering.acc, jnp.asarray(batch.alpha)), Outcome(metrics)


def render_object(
    weights: Weights,
    config: PointNeRFConfig,
    cloud: PointCloud,
    view: ViewRays,
    distances: Float[Array, "rays n"],
    far: Float[Array, " rays"],
    hit: Bool[Array, " rays"],
) -> tuple[Float[Array, "rays 3"], Float[Array, " rays"], Float[Array, " rays"]]:
    """RGB on white, expected distance and opacity of the rays of one object."""
    rays = view.rays
    reach = within_reach(rays, distances, cloud, config.radius) & hit[:, None]
    # the ball of a point is four of the published code's voxels wide
    points = shading_points(distances, reach, config.num_samples, config.radius / 4)
    places = rays.origins[:, None] + points.distances[..., None] * rays.directions[:, None]

    def per_place(x):
        return jnp.broadcast_to(x[:, None], (x.shape[0], config.num_samples, *x.shape[1:])).reshape(-1, *x.shape[1:])

    exists = points.exists.reshape(-1)
    density, rgb = map_existing(
        partial(shade, weights, config, cloud, point_features(cloud, config.feature_frequencies)),
        exists,
        (places.reshape(-1, 3), per_place(rays.directions), per_place(view.axes)),
        (jnp.zeros(exists.shape), jnp.zeros((*exists.shape, 3))),
        BLOCK,
    )
    density, rgb = density.reshape(points.exists.shape), rgb.reshape(*points.exists.shape, 3)
    shares, _ = compositing.volume_weights(density, points.delta)
    image = compositing.composite(shares, rgb, jnp.full((1, 3), WHITE))
    return image, compositing.expected_distance(shares, points.distances, far), jnp.sum(shares, axis=-1)
