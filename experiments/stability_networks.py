"""The networks that `experiments.stability` sweeps, with random weights that are the same in every format.

`bf16` lets the convolutions of the float32 run be bfloat16; the float64 run is the reference and stays what it is.
"""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from experiments.stability_kernels import Rng, box_at_distance
from spnr_jax.kernels.records import Rays, Scene
from spnr_jax.method.renderer import Renderer
from spnr_jax.model_config import ModelConfig, SamplingConfig
from spnr_jax.nn.discriminator import Discriminator
from spnr_jax.nn.normalization import BatchNorm, GroupNorm
from spnr_jax.nn.unet3d import UNet3D
from spnr_jax.nn.upsampler import Upsampler


def batch_norm(x):
    """BatchNorm in training, all points real."""
    inputs = (x, jnp.ones(x.shape[:-1], bool), True)
    return BatchNorm().apply(initial(BatchNorm(), *inputs), *inputs, mutable=["batch_stats"])[0]


def group_norm(x):
    """GroupNorm of one volume, one group."""
    return GroupNorm(1).apply(initial(GroupNorm(1), x[None]), x[None])[0]


def initial(module: nn.Module, x, *others):
    """The ones and zeros that a normalisation starts with, in the format of x."""
    return jax.tree.map(lambda leaf: leaf.astype(x.dtype), module.init(jax.random.key(0), x, *others))


def norm_twin(x, axis):
    """Zero mean, unit variance."""
    return ((x - x.mean(axis, keepdims=True)) / np.sqrt(x.var(axis, keepdims=True) + 1e-5),)


def weights_of(module: nn.Module, dtype, *inputs, method=None):
    """Random parameters of a module, the same in every format."""
    shapes = jax.eval_shape(partial(module.init, method=method), jax.random.key(0), *inputs)
    rng = np.random.default_rng(7)

    def draw(shape):
        fan_in = max(int(np.prod(shape.shape[:-1])), 1)
        return jnp.asarray(np.float32(rng.normal(size=shape.shape) / np.sqrt(fan_in)), dtype)

    return jax.tree.map(draw, shapes)


def unet(values, bf16):
    """A 3D U-Net of one stage on 200 occupied voxels of 16^3."""
    rows = jnp.asarray(np.random.default_rng(1).choice(16**3, (1, 200), replace=False), jnp.int32)
    module = UNet3D(16, 8, 1, 1, bf16 and values.dtype == jnp.float32)
    return module.apply(weights_of(module, values.dtype, rows, values), rows, values)


def upsampler(x, bf16):
    """The 2D upsampler."""
    module = Upsampler(16, bf16 and x.dtype == jnp.float32)
    return module.apply(weights_of(module, x.dtype, x), x)


def discriminator(image, bf16):
    """Logits of the discriminator."""
    module, mask = Discriminator(8, 1, bf16 and image.dtype == jnp.float32), jnp.ones(image.shape[:-1], bool)
    return module.apply(weights_of(module, image.dtype, image, image, mask), image, image, mask)


def render(volume, origins, directions, bias, samples=16):
    """Features, depth and opacity of rays through a volume; `bias` moves every density."""
    counts = SamplingConfig(num_coarse=samples, num_fine=samples)
    config = ModelConfig(field_width=8, num_features=4, direction_frequencies=1, sampling=counts)
    module, rays = Renderer(config), Rays(origins=origins, directions=directions)
    encoded = Scene(volume=volume, occupied=jnp.ones(volume.shape[:-1], bool))
    variables = weights_of(module, volume.dtype, encoded, rays, method="render_rays")
    head = variables["params"]["field"]["head"]
    # no gradient by the bias: one number for all rays, whose gradients would cancel
    head["bias"] = head["bias"] + jnp.concatenate([jax.lax.stop_gradient(bias), jnp.zeros(3, bias.dtype)])
    return module.apply(variables, encoded, rays, method="render_rays")


def scene(rng: Rng, density: float = 3.0, distance: float = 3.0):
    """A random volume of about that density, seen from that far away."""
    origins, directions = box_at_distance(rng, distance)
    bias = np.array([1 + (density if density > 30 else np.log(np.expm1(density)))])
    return rng.normal(size=(1, 8, 8, 8, 16)), origins[None], directions[None], bias
