"""Normalisations: batch statistics over the real points of padded clouds, and groups of channels of one volume."""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from spnr_jax.kernels.numerics import computed_once, per_feature

EPSILON = 1e-5


class BatchNorm(nn.Module):
    """Each feature to zero mean and unit variance over all points with mask True; running statistics in evaluation.

    The running variance takes the unbiased estimate, as in the reference implementations.  Features beyond 1e18 have a
    variance that float32 cannot hold: the output is the bias.
    """

    momentum: float = 0.9

    @nn.compact
    def __call__(
        self, x: Float[Array, "*batch features"], mask: Bool[Array, "*batch"], train: bool
    ) -> Float[Array, "*batch features"]:
        """Normalised features; with train=True the running statistics move towards those of this batch."""
        shape = (x.shape[-1],)
        scale = self.param("scale", nn.initializers.ones, shape)
        bias = self.param("bias", nn.initializers.zeros, shape)
        running_mean = self.variable("batch_stats", "mean", jnp.zeros, shape)
        running_variance = self.variable("batch_stats", "variance", jnp.ones, shape)
        if train:
            x = jnp.where(mask[..., None], x, 0)  # what fills the padding may be anything
            axes = tuple(range(x.ndim - 1))
            weight = mask[..., None].astype(x.dtype)
            count = jnp.maximum(jnp.sum(weight), 1)
            mean = jnp.sum(x * weight, axis=axes) / count
            variance = jnp.sum(jnp.square(x - per_feature(mean, x)) * weight, axis=axes) / count
            if not self.is_initializing():
                keep, unbiased = self.momentum, variance * count / jnp.maximum(count - 1, 1)
                running_mean.value = keep * running_mean.value + (1 - keep) * mean
                running_variance.value = keep * running_variance.value + (1 - keep) * unbiased
        else:
            mean, variance = running_mean.value, running_variance.value
        slope = scale / jnp.sqrt(variance + EPSILON)
        return (x - per_feature(mean, x)) * per_feature(slope, x) + per_feature(bias, x)


class GroupNorm(nn.Module):
    """Groups of consecutive channels to zero mean and unit variance over space, for each batch entry alone."""

    num_groups: int

    @nn.compact
    def __call__(self, x: Float[Array, "batch *space features"]) -> Float[Array, "batch *space features"]:
        """Normalised features, scaled and shifted per channel."""
        shape = (x.shape[-1],)
        scale = self.param("scale", nn.initializers.ones, shape)
        bias = self.param("bias", nn.initializers.zeros, shape)
        out = group_norm(x.reshape(x.shape[0], -1, x.shape[-1]), scale, bias, self.num_groups)
        return out.reshape(x.shape)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def group_norm(
    x: Float[Array, "batch places features"],
    scale: Float[Array, " features"],
    bias: Float[Array, " features"],
    num_groups: int,
) -> Float[Array, "batch places features"]:
    """(x - mean) / sqrt(variance + 1e-5) * scale + bias, statistics over places and the channels of a group.

    What belongs to a channel is computed once and not in every place, and the gradient is written out: a third of the
    time of the plain form with its derived gradient on a CPU.
    """
    return _group_norm(x, scale, bias, num_groups)[0]


def _group_norm(x, scale, bias, num_groups):
    mean = computed_once(_group_mean(jnp.mean(x, axis=1), num_groups))
    centred = x - mean[:, None]
    inverse = computed_once(1 / jnp.sqrt(_group_mean(jnp.mean(jnp.square(centred), axis=1), num_groups) + EPSILON))
    slope = computed_once(inverse * per_feature(scale, inverse))
    return centred * slope[:, None] + per_feature(bias, x), (x, mean, inverse, scale)


def _group_norm_backward(num_groups, residuals, cotangent):
    """The gradient by x is slope * cotangent, less its part along a constant and along x in each group."""
    x, mean, inverse, scale = residuals
    scale, centred = per_feature(scale, inverse), x - mean[:, None]
    shift_gradient = jnp.sum(cotangent, axis=1)
    scale_gradient = _sum_of_places(cotangent * centred) * inverse
    along_one, along_x = (_group_mean(g * scale, num_groups) / x.shape[1] for g in (shift_gradient, scale_gradient))
    slope, constant, linear = (computed_once(v * inverse) for v in (scale, -along_one, -along_x * inverse))
    gradient = cotangent * slope[:, None] + centred * linear[:, None] + constant[:, None]
    return gradient, jnp.sum(scale_gradient, axis=0), jnp.sum(shift_gradient, axis=0)


def _sum_of_places(x):
    """Sum over axis 1; a single batch entry in two halves, because XLA's CPU loop over one is up to 70 times slower."""
    if len(x) > 1 or x.shape[1] % 2:
        return jnp.sum(x, axis=1)
    return jnp.sum(jnp.sum(x.reshape(2, -1, x.shape[2]), axis=1), axis=0, keepdims=True)


def _group_mean(per_channel, num_groups):
    """Mean of the channels of each group, at every one of them."""
    groups = per_channel.reshape(per_channel.shape[0], num_groups, -1)
    return jnp.broadcast_to(jnp.mean(groups, axis=-1, keepdims=True), groups.shape).reshape(per_channel.shape)


group_norm.defvjp(_group_norm, _group_norm_backward)
