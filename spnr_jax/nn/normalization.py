"""Normalisations: batch statistics over the real points of padded clouds, and groups of channels of one volume."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from spnr_jax.numerics import per_feature

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
        features = x.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (features,))
        bias = self.param("bias", nn.initializers.zeros, (features,))
        grouped = x.reshape(x.shape[0], -1, self.num_groups, features // self.num_groups)
        mean = jnp.mean(grouped, axis=(1, 3), keepdims=True)
        variance = jnp.mean(jnp.square(grouped - mean), axis=(1, 3), keepdims=True)
        inverse = 1 / jnp.sqrt(variance + EPSILON)
        spread = (x.shape[0], *[1] * (x.ndim - 2), features)
        per_channel = jnp.broadcast_to(inverse, (x.shape[0], 1, *grouped.shape[2:])).reshape(spread) * per_feature(
            scale, x
        )
        mean = jnp.broadcast_to(mean, (x.shape[0], 1, *grouped.shape[2:])).reshape(spread)
        return (x - mean) * per_channel + per_feature(bias, x)
