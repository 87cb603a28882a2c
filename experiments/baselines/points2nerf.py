"""Points2NeRF: a hypernetwork writes the weights of one NeRF per object (Zimny et al., 2022, as its code has it).

    cloud -> shared MLP, max over points -> code -> hypernetwork -> weights -> NeRF along rays

The NeRF is a pure function of a tree of weights, `nerf(weights, positions)`; the scene that a cloud encodes to is
such a tree with objects first on every array, and rendering is `jax.vmap` over it.  The hypernetwork writes all weights
as one vector, chunk by chunk: one MLP sees the code and a learnt embedding of the chunk's number.  The chunks are laid
end to end and cut into kernel and bias, layer after layer (`split_weights`); what is left of the last one is dropped.

A picture is made from the mean of the code; training draws the code around it, and adds the KL term.
The published code takes exp(l) for the scale and for the log variance of the second head l, and a last interval of 1e10
that has to paint the background; here it is a variational autoencoder over finite intervals, white where nothing stops
the ray.  Its layers start in +-1/sqrt(inputs), so that the NeRF hardly sees its input; here signals keep their size on
the way to the picture: He et al., 2015, a small scale of the code, and the NeRF's layers times sqrt(2 / inputs).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from experiments.baselines import ray_chunks
from spnr_jax.config import Material, NetworkConfig, OptimizerConfig, TrainConfig, check
from spnr_jax.errors import UserError, require
from spnr_jax.kernels import cameras, compositing, sampling
from spnr_jax.kernels.imaging import WHITE
from spnr_jax.kernels.numerics import per_feature
from spnr_jax.kernels.records import Batch, Camera, Key, PointCloud, Rays, Rendering
from spnr_jax.method import inference
from spnr_jax.methods import Outcome
from spnr_jax.nn.paper_layers import encode_direction

QUIET = -6.0  # log variance that the encoder begins with: codes are told apart from the first step on


@dataclass(frozen=True, kw_only=True)
class Points2NeRFConfig(NetworkConfig):
    """Sizes of Points2NeRF; the defaults are the published ones."""

    method: ClassVar[str] = "points2nerf"

    kl_weight: float = 1.0
    """Weight of the KL term, a sum over the code, beside the mean squared error of a pixel."""
    materials: tuple[Material, ...] = ("base_color",)
    """Material channels that the points carry into the encoder."""
    point_widths: tuple[int, ...] = (64, 128, 256, 512, 512)
    """Layers of the MLP that sees each point."""
    hidden_width: int = 512
    """Hidden layer after the maximum over the points."""
    code_size: int = 4096
    """Numbers in an object's code."""
    hypernetwork_widths: tuple[int, ...] = (4096, 8192)
    """Hidden layers of the hypernetwork."""
    chunk_size: int = 16384
    """Weights that the hypernetwork writes at once."""
    chunk_embedding: int = 8
    """Numbers that tell the hypernetwork which chunk it writes."""
    frequencies: int = 10
    """Frequencies of the encoding of a position in the NeRF."""
    nerf_width: int = 256
    """Hidden layers of the NeRF."""
    nerf_depth: int = 8
    """Hidden layers of the NeRF after its first one, and after the encoded position joins again, together."""
    num_samples: int = 256
    """Stratified samples along each ray."""
    ray_chunk: int = 1024
    """Rays of an object rendered at once in evaluation."""
    pixel_stride: int = 1
    """Trained on every n-th row and column of a view, at a random offset."""

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = "hidden_width", "code_size", "chunk_size", "chunk_embedding", "nerf_width", "num_samples", "ray_chunk"
        check(self, positive=(*counts, "pixel_stride", "point_widths", "hypernetwork_widths"))
        require(len(set(self.materials)) == len(self.materials), f"materials must be distinct, got {self.materials}")
        require(
            self.nerf_depth >= 2 and self.nerf_depth % 2 == 0,
            f"nerf_depth must be even and at least 2, got {self.nerf_depth}",
        )
        ray_chunks.check_stride(self)


def published_config(size: int) -> TrainConfig:
    """The published training at 128 (ABO) or 200 pixels (ShapeNet), 1024 or 1600 rays a step; meant for one GPU.

    190 million parameters; the authors report two weeks and more per class.
    """
    return TrainConfig(
        preset=f"points2nerf, {size} px, as published",
        model=Points2NeRFConfig(image_resolution=size, pixel_stride={128: 4, 200: 5}[size]),
        loss=ray_chunks.SQUARES,
        optimizer=OptimizerConfig(
            lr_generator=5e-5, warmup_steps=0, algorithm="radam", decay="exponential", final_lr_scale=0.135
        ),
        num_steps=2_254_000,  # 2000 epochs of 1127 cars, the learning rate times 0.999 after each
        batch_objects=1,
    )


def points2nerf_tiny() -> TrainConfig:
    """A hundredth of the size, 64 px, minutes on two cores.

    `spnr train --methods experiments.baselines --preset points2nerf_tiny DATA RUN`

    The encoder sees all materials, as our network does.  The KL weight, 2 * 0.05^2 over an object's 768 numbers in a
    step, is that of pixels with a Gaussian error of 0.05; at 1, beside a mean of squares, the code would say nothing.
    """
    return TrainConfig(
        preset="points2nerf_tiny",
        model=Points2NeRFConfig(
            kl_weight=6.5e-6,
            materials=("base_color", "roughness", "metallic"),
            point_widths=(64, 128, 256),
            hidden_width=256,
            code_size=128,
            hypernetwork_widths=(256, 512),
            chunk_size=2048,
            frequencies=6,
            nerf_width=64,
            nerf_depth=4,
            num_samples=24,
            image_resolution=64,
            pixel_stride=4,
        ),
        loss=ray_chunks.SQUARES,
        optimizer=OptimizerConfig(lr_generator=3e-3, warmup_steps=30, ema_decay=0.995, algorithm="radam"),
        num_steps=1200,
        batch_objects=4,
        max_points=1024,
    )


class Layer(NamedTuple):
    """A dense layer of the NeRF; objects may lead on both."""

    kernel: Array
    bias: Array


Weights = tuple[Layer, ...]


def nerf_layers(frequencies: int, width: int, depth: int) -> tuple[tuple[int, int], ...]:
    """(inputs, outputs) of the NeRF's layers: 1 + depth / 2, as many after the encoded position joins, the head."""
    encoded, half = 3 + 6 * frequencies, [(width, width)] * (depth // 2)
    return ((encoded, width), *half, (width + encoded, width), *half, (width, 4))


def split_weights(flat: Float[Array, "*batch weights"], layers: Sequence[tuple[int, int]]) -> Weights:
    """The NeRF's layers from one vector: of each layer the kernel, row by row, then the bias."""
    split, start = [], 0
    for inputs, outputs in layers:
        middle, stop = start + inputs * outputs, start + (inputs + 1) * outputs
        kernel = flat[..., start:middle].reshape(*flat.shape[:-1], inputs, outputs)
        split.append(Layer(kernel, flat[..., middle:stop]))
        start = stop
    return tuple(split)


def nerf(
    weights: Weights, positions: Float[Array, "*batch 3"]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"]]:
    """Density softplus(raw) and RGB sigmoid(raw) of one object at positions, whatever the view direction."""
    encoded = encode_direction(positions.reshape(-1, 3), (weights[0].kernel.shape[0] - 3) // 6)
    x, half = encoded, len(weights) // 2
    for number, (kernel, bias) in enumerate(weights):
        x = jnp.concatenate([x, encoded], axis=-1) if number == half else x
        x = x @ kernel + per_feature(bias, x)
        x = nn.relu(x) if number + 1 < len(weights) else x
    raw = x.reshape(*positions.shape[:-1], 4)
    return nn.softplus(raw[..., 3]), nn.sigmoid(raw[..., :3])


def kl_divergence(
    mean: Float[Array, "*batch code"], log_variance: Float[Array, "*batch code"]
) -> Float[Array, "*batch"]:
    """KL(N(mean, exp(log_variance)) || N(0, 1)), summed over the code."""
    return 0.5 * jnp.sum(jnp.exp(log_variance) + mean**2 - 1 - log_variance, axis=-1)


class Dense(nn.Module):
    """A dense layer that keeps the size of signals; `bias` is what it adds from the start."""

    width: int
    bias: float = 0.0

    @nn.compact
    def __call__(self, x: Float[Array, "*batch channels"]) -> Float[Array, "*batch {self.width}"]:
        """x times the kernel, plus the bias."""
        bound = (6 / x.shape[-1]) ** 0.5

        def uniform(key, shape):
            return jax.random.uniform(key, shape, minval=-bound, maxval=bound)

        kernel = self.param("kernel", uniform, (x.shape[-1], self.width))
        return x @ kernel + per_feature(self.param("bias", nn.initializers.constant(self.bias), (self.width,)), x)


class Encoder(nn.Module):
    """Mean and log variance of an object's code from its points; their order and what is masked do not matter."""

    config: Points2NeRFConfig

    @nn.compact
    def __call__(
        self, x: Float[Array, "objects points channels"], mask: Bool[Array, "objects points"]
    ) -> tuple[Float[Array, "objects code"], Float[Array, "objects code"]]:
        """The two heads."""
        c = self.config
        for number, width in enumerate(c.point_widths):
            x = nn.relu(x) if number else x
            x = Dense(width, name=f"point_{number}")(x)
        x = jnp.max(x, axis=1, where=mask[..., None], initial=jnp.finfo(x.dtype).min)
        x = jnp.where(jnp.any(mask, axis=1)[:, None], x, 0)  # of no points
        x = nn.relu(Dense(c.hidden_width, name="hidden")(x))
        return Dense(c.code_size, name="mean")(x), Dense(c.code_size, QUIET, name="log_variance")(x)


class Hypernetwork(nn.Module):
    """All weights of each object's NeRF as one vector, chunk by chunk from the code."""

    config: Points2NeRFConfig
    num_weights: int

    @nn.compact
    def __call__(self, code: Float[Array, "objects code"]) -> Float[Array, "objects {self.num_weights}"]:
        """The chunks end to end, without what the last has too much."""
        c = self.config
        objects, chunks = code.shape[0], math.ceil(self.num_weights / c.chunk_size)
        embeddings = self.param("chunks", nn.initializers.normal(1.0), (chunks, c.chunk_embedding))
        codes = jnp.broadcast_to(code[:, None], (objects, chunks, code.shape[-1]))
        x = jnp.concatenate([codes, jnp.broadcast_to(embeddings[None], (objects, *embeddings.shape))], axis=-1)
        for number, width in enumerate(c.hypernetwork_widths):
            x = nn.relu(Dense(width, name=f"hidden_{number}")(x))
        return Dense(c.chunk_size, name="out")(x).reshape(objects, -1)[:, : self.num_weights]


class Points2NeRF(nn.Module):
    """Weights of NeRFs from clouds, pictures from weights."""

    config: Points2NeRFConfig

    def setup(self) -> None:
        """Builds encoder and hypernetwork; the NeRF has no parameters of its own."""
        c = self.config
        self.layers = nerf_layers(c.frequencies, c.nerf_width, c.nerf_depth)
        self.encoder = Encoder(c)
        self.hypernetwork = Hypernetwork(c, sum((inputs + 1) * outputs for inputs, outputs in self.layers))

    def code(self, cloud: PointCloud) -> tuple[Float[Array, "objects code"], Float[Array, "objects code"]]:
        """Mean and log variance of each object's code."""
        materials = [getattr(cloud, name) for name in self.config.materials]
        materials = [m[..., None] if m.ndim < cloud.positions.ndim else m for m in materials]
        return self.encoder(jnp.concatenate([cloud.positions, *materials], axis=-1), jnp.asarray(cloud.mask))

    def weights(self, code: Float[Array, "objects code"]) -> Weights:
        """Each object's NeRF from its code."""
        weights = split_weights(self.hypernetwork(code), self.layers)
        factors = [math.sqrt(2 / inputs) for inputs, _ in self.layers]
        return tuple(jax.tree.map(lambda x, f=f: f * x, layer) for layer, f in zip(weights, factors, strict=True))

    def encode(self, cloud: PointCloud, train: bool = False) -> Weights:
        """Each object's NeRF from the mean of its code."""
        return self.weights(self.code(cloud)[0])

    def render(self, weights: Weights, camera: Camera) -> Rendering:
        """Views of encoded objects, some rays at a time."""
        return ray_chunks.render(self, weights, camera, cameras.view_rays(camera), self.config.ray_chunk)

    def render_rays(
        self, weights: Weights, rays: Rays, key: Key | None = None
    ) -> tuple[Float[Array, "objects rays 3"], Float[Array, "objects rays"], Float[Array, "objects rays"]]:
        """RGB, expected distance and opacity of each ray; a ray beside the box is white."""
        near, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        distances, _ = sampling.stratified(key, near, far, self.config.num_samples)
        positions = rays.origins[..., None, :] + distances[..., None] * rays.directions[..., None, :]
        density, rgb = jax.vmap(nerf)(weights, positions)
        delta = compositing.interval_lengths(distances, far)
        shares, _ = compositing.volume_weights(density, delta)
        depth = compositing.expected_distance(shares, distances, far)
        return compositing.composite(shares, rgb, WHITE), depth, jnp.sum(shares, axis=-1)

    def __call__(self, cloud: PointCloud, camera: Camera, key: Key | None = None, train: bool = False) -> Rendering:
        """Views of each cloud, all rays at once; a key jitters the samples.

        Training draws the codes with the key and adds the KL term.
        """
        code, log_variance = self.code(cloud)
        if train:
            if key is None:
                raise UserError("training draws a code for each object: give a key")
            self.sow("losses", "kl", self.config.kl_weight * jnp.mean(kl_divergence(code, log_variance)))
            code_key, key = jax.random.split(key)
            code = code + jnp.exp(0.5 * log_variance) * jax.random.normal(code_key, code.shape)
        return ray_chunks.as_images(camera, *self.render_rays(self.weights(code), cameras.view_rays(camera), key))


def loss(
    variables: dict, batch: Batch, key: Key | None = None, *, config: TrainConfig
) -> tuple[Float[Array, ""], Outcome]:
    """`inference.loss` of some of the pixels."""
    assert isinstance(config.model, Points2NeRFConfig)
    key, batch = ray_chunks.choose_pixels(key, batch, config.model.pixel_stride)
    return inference.loss(variables, batch, key, config=config)
