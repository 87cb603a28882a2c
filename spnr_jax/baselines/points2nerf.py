"""Points2NeRF: a hypernetwork writes the weights of one NeRF per object (Zimny et al., 2022, as its code has it).

    cloud -> shared MLP, max over points -> mean and log scale of a code -> hypernetwork -> weights -> NeRF along rays

The NeRF is a pure function of a tree of weights, `nerf(weights, positions)`; the scene that a cloud encodes to is
such a tree with objects first on every array, and rendering is `jax.vmap` over it.  The hypernetwork writes all weights
as one vector, chunk by chunk: one MLP sees the code and a learnt embedding of the chunk's number.  The chunks are laid
end to end and cut into kernel and bias, layer after layer (`split_weights`); what is left of the last one is dropped.

Two modes, because the published code departs from a variational autoencoder (`l` is the second head of the encoder):
    faithful  scale exp(l); the KL term takes exp(l) for the log variance, so it is smallest without noise; the last
              interval of a ray is 1e10 long, so its sample is opaque and has to paint the background
    fixed     scale exp(l / 2) and the KL term of that; finite intervals, white where nothing stops the ray
A picture is made from the mean of the code; training draws the code around it.

Two initialisations: published (all uniform in +-1/sqrt(inputs): the NeRF begins with weights near 0.006 and hardly sees
its input), or scaled (He et al., 2015, a small scale of the code, and the NeRF's layers times sqrt(2 / inputs)).
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from spnr_jax.baselines import ray_chunks
from spnr_jax.baselines.sizes import Points2NeRFConfig
from spnr_jax.config import RenderOptions
from spnr_jax.errors import UserError
from spnr_jax.kernels import cameras, compositing, sampling
from spnr_jax.kernels.numerics import per_feature, softplus
from spnr_jax.kernels.records import Camera, Key, PointCloud, Rays, Rendering
from spnr_jax.nn.encoding import encode_direction

PAINTED = 1e10  # length of a ray's last interval in faithful mode
QUIET = -6.0  # log variance that a scaled encoder begins with: codes are told apart from the first step on

Mode = Literal["faithful", "fixed"]


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
    return softplus(raw[..., 3]), nn.sigmoid(raw[..., :3])


def code_scale(mode: Mode, log_scale: Float[Array, "*batch code"]) -> Float[Array, "*batch code"]:
    """Standard deviation of the code: exp(l), or exp(l / 2) of a log variance l."""
    return jnp.exp(log_scale if mode == "faithful" else 0.5 * log_scale)


def kl_divergence(
    mode: Mode, mean: Float[Array, "*batch code"], log_scale: Float[Array, "*batch code"]
) -> Float[Array, "*batch"]:
    """0.5 sum(exp(v) + mean^2 - 1 - v) over the code; v is l, which makes it KL(N(mean, exp l) || N(0, 1)), or exp(l).

    The latter (faithful) falls with l without end: what remains is an autoencoder whose means are kept small.
    """
    v = jnp.exp(log_scale) if mode == "faithful" else log_scale
    return 0.5 * jnp.sum(jnp.exp(v) + mean**2 - 1 - v, axis=-1)


class Dense(nn.Module):
    """A dense layer that starts as published or scaled; `bias` is what a scaled one adds from the start."""

    width: int
    scaled: bool
    bias: float = 0.0

    @nn.compact
    def __call__(self, x: Float[Array, "*batch channels"]) -> Float[Array, "*batch {self.width}"]:
        """x times the kernel, plus the bias."""
        bound = (6.0 if self.scaled else 1.0) ** 0.5 * x.shape[-1] ** -0.5

        def uniform(key, shape):
            return jax.random.uniform(key, shape, minval=-bound, maxval=bound)

        first_bias = nn.initializers.constant(self.bias) if self.scaled else uniform
        kernel = self.param("kernel", uniform, (x.shape[-1], self.width))
        return x @ kernel + per_feature(self.param("bias", first_bias, (self.width,)), x)


class Encoder(nn.Module):
    """Mean and log scale of an object's code from its points; their order and what is masked do not matter."""

    config: Points2NeRFConfig

    @nn.compact
    def __call__(
        self, x: Float[Array, "objects points channels"], mask: Bool[Array, "objects points"]
    ) -> tuple[Float[Array, "objects code"], Float[Array, "objects code"]]:
        """The two heads."""
        c, scaled = self.config, self.config.initialization == "scaled"
        for number, width in enumerate(c.point_widths):
            x = nn.relu(x) if number else x
            x = Dense(width, scaled, name=f"point_{number}")(x)
        x = jnp.max(x, axis=1, where=mask[..., None], initial=jnp.finfo(x.dtype).min)
        x = nn.relu(Dense(c.hidden_width, scaled, name="hidden")(x))
        quiet = QUIET / 2 if c.mode == "faithful" else QUIET
        return Dense(c.code_size, scaled, name="mean")(x), Dense(c.code_size, scaled, quiet, name="log_scale")(x)


class Hypernetwork(nn.Module):
    """All weights of each object's NeRF as one vector, chunk by chunk from the code."""

    config: Points2NeRFConfig
    num_weights: int

    @nn.compact
    def __call__(self, code: Float[Array, "objects code"]) -> Float[Array, "objects {self.num_weights}"]:
        """The chunks end to end, without what the last has too much."""
        c, scaled = self.config, self.config.initialization == "scaled"
        objects, chunks = code.shape[0], math.ceil(self.num_weights / c.chunk_size)
        embeddings = self.param("chunks", nn.initializers.normal(1.0), (chunks, c.chunk_embedding))
        codes = jnp.broadcast_to(code[:, None], (objects, chunks, code.shape[-1]))
        x = jnp.concatenate([codes, jnp.broadcast_to(embeddings[None], (objects, *embeddings.shape))], axis=-1)
        for number, width in enumerate(c.hypernetwork_widths):
            x = nn.relu(Dense(width, scaled, name=f"hidden_{number}")(x))
        return Dense(c.chunk_size, scaled, name="out")(x).reshape(objects, -1)[:, : self.num_weights]


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
        """Mean and log scale of each object's code."""
        materials = [getattr(cloud, name) for name in self.config.materials]
        materials = [m[..., None] if m.ndim < cloud.positions.ndim else m for m in materials]
        return self.encoder(jnp.concatenate([cloud.positions, *materials], axis=-1), jnp.asarray(cloud.mask))

    def weights(self, code: Float[Array, "objects code"]) -> Weights:
        """Each object's NeRF from its code."""
        weights = split_weights(self.hypernetwork(code), self.layers)
        if self.config.initialization == "published":
            return weights
        factors = [math.sqrt(2 / inputs) for inputs, _ in self.layers]
        return tuple(jax.tree.map(lambda x, f=f: f * x, layer) for layer, f in zip(weights, factors, strict=True))

    def encode(self, cloud: PointCloud, train: bool = False) -> Weights:
        """Each object's NeRF from the mean of its code."""
        return self.weights(self.code(cloud)[0])

    def render(self, weights: Weights, camera: Camera, options: RenderOptions | None = None) -> Rendering:
        """Views of encoded objects, some rays at a time; there is nothing to choose."""
        return ray_chunks.render(self, weights, camera, self.config.ray_chunk)

    def whole(self, weights: Weights, camera: Camera, key: Key | None) -> Rendering:
        """Views of encoded objects, all rays at once; a key jitters the samples (training)."""
        return cameras.as_images(camera, *self.render_rays(weights, self.rays(camera), key))

    def rays(self, camera: Camera) -> Rays:
        """Rays of all views of an object in one axis, (objects, views * height * width, 3)."""
        return cameras.view_rays(camera)

    def render_rays(
        self, weights: Weights, rays: Rays, key: Key | None = None
    ) -> tuple[Float[Array, "objects rays 3"], Float[Array, "objects rays"], Float[Array, "objects rays"]]:
        """RGB, expected distance and opacity of each ray; a ray beside the box is white."""
        near, far, hit = cameras.intersect_box(rays.origins, rays.directions)
        distances, _ = sampling.stratified(key, near, far, self.config.num_samples)
        positions = rays.origins[..., None, :] + distances[..., None] * rays.directions[..., None, :]
        density, rgb = jax.vmap(nerf)(weights, positions)
        delta = compositing.interval_lengths(distances, far)
        if self.config.mode == "faithful":
            delta = delta.at[..., -1].set(jnp.where(hit, PAINTED, 0.0))
        shares, _ = compositing.volume_weights(density, delta)
        depth = compositing.expected_distance(shares, distances, far)
        return compositing.composite(shares, rgb, compositing.WHITE), depth, jnp.sum(shares, axis=-1)

    def __call__(self, cloud: PointCloud, camera: Camera, key: Key | None = None, train: bool = False) -> Rendering:
        """Views of each cloud from its cameras; training draws the codes with the key and adds the KL term."""
        mean, log_scale = self.code(cloud)
        if not train:
            return self.whole(self.weights(mean), camera, key)
        if key is None:
            raise UserError("training draws a code for each object: give a key")
        mode = self.config.mode
        self.sow("losses", "kl", self.config.kl_weight * jnp.mean(kl_divergence(mode, mean, log_scale)))
        code_key, key = jax.random.split(key)
        code = mean + code_scale(mode, log_scale) * jax.random.normal(code_key, mean.shape)
        return self.whole(self.weights(code), camera, key)
