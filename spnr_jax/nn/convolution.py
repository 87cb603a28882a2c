"""Normalisations, and convolutions in the form that each platform computes fastest (the result is the same).

Layout is channels last: inputs (batch, *space, in), kernels (*window, in, out) with equal sides.  Strided convolutions
pad one voxel on every side, like the stride-1 ones (a SAME rule would pad the far side only).  On a GPU these are XLA's
native convolutions.  On a CPU (measurements: docs/lab/cpu_forms.md):
  3D   a sum over depth taps of 2D convolutions, or one matrix product for tiny volumes
  2D   native, but for matrix products for the kernel gradients of 2-wide and 4-wide windows; one matrix product for
       128 input features or more

Normalisations are batch statistics over the real points of padded clouds, and groups of channels of one volume.
"""

import itertools
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from spnr_jax.kernels.numerics import per_feature

FEW_PIXELS = 2  # along an axis, up to which folding the kernel takes longer than the convolution
MANY_FEATURES = 128  # of the input, from which one matrix product is faster than a convolution

kernel_init = jax.nn.initializers.he_normal(in_axis=-2, out_axis=-1)


def conv(
    x: Float[Array, "batch *space in"],
    kernel: Float[Array, "*window in out"],
    stride: int = 1,
    padding: int = 1,
    bf16: bool = False,
) -> Float[Array, "batch *out_space out"]:
    """Convolution (correlation) in 2D or 3D with equal stride and padding on every axis; derivatives of both modes.

    With bf16, the convolution and its gradients run in bfloat16; inputs and outputs keep their own type.
    """
    result = x.dtype
    if bf16:
        x, kernel = x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16)
    on_cpu, native = (
        partial(form, stride=stride, padding=padding) for form in (_conv2d_cpu if x.ndim == 4 else _conv3d_cpu, _native)
    )
    return lax.platform_dependent(x, kernel, cpu=on_cpu, default=native).astype(result)


class Conv(nn.Module):
    """3 x 3 convolution of pictures with a bias; its weights have the names and shapes of Flax's own."""

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "batch height width in"]) -> Float[Array, "batch height width features"]:
        """A picture of the same size."""
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (3, 3, x.shape[-1], self.features))
        y = conv(x, jnp.asarray(kernel, x.dtype))
        return y + per_feature(self.param("bias", nn.initializers.zeros, (self.features,)), y)


def _native(x, kernel, stride, padding):
    n = x.ndim - 2
    return _general_conv(x, kernel, (stride,) * n, [(padding, padding)] * n)


def _general_conv(x, kernel, stride, padding, x_dilation=None, kernel_dilation=None):
    axes = "DHW"[-(x.ndim - 2) :]
    numbering = f"N{axes}C", f"{axes}IO", f"N{axes}C"
    return lax.conv_general_dilated(x, kernel, stride, padding, x_dilation, kernel_dilation, numbering)


def _windows(x, window: int, stride: int):
    """For each position in a window over the spatial axes: its values in all windows, (batch, *out, in)."""
    stops = [(s - window) // stride * stride + 1 for s in x.shape[1:-1]]
    for place in itertools.product(range(window), repeat=x.ndim - 2):
        corner = (0, *place, 0)
        end = (x.shape[0], *(p + s for p, s in zip(place, stops, strict=True)), x.shape[-1])
        yield lax.slice(x, corner, end, (1, *[stride] * len(stops), 1))


def _pad(x, padding: int):
    return jnp.pad(x, ((0, 0), *[(padding, padding)] * (x.ndim - 2), (0, 0)))


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _conv2d(x, kernel, stride, padding):
    return _native(x, kernel, stride, padding)


def _conv2d_jvp(stride, padding, primals, tangents):
    """The transposes of gradients that are fast on a CPU; reverse mode transposes them again."""
    out = _conv2d(*primals, stride, padding)
    tangents_out = [
        jax.linear_transpose(lambda cotangent, of=of: of(*primals, cotangent, stride, padding), out)(tangent)[0]
        for of, tangent in zip((_input_gradient, _kernel_gradient), tangents, strict=True)
        if not isinstance(tangent, SymbolicZero)
    ]
    return out, sum(tangents_out[1:], tangents_out[0])


_conv2d.defjvp(_conv2d_jvp, symbolic_zeros=True)


def _input_gradient(x, kernel, cotangent, stride, padding):
    """The convolution of the cotangents with the flipped kernel, input and output features exchanged.

    JAX's own gradient is the same sum with the axes in another order.  XLA's CPU compiler makes a fast program of it
    only outside of loops: within `lax.scan` or `lax.map` it took 5 to 29 times as long, and the kernel's gradient 46 to
    97 times.
    """
    window = kernel.shape[0]
    first = window - 1 - padding
    last = [n + padding - (m - 1) * stride - 1 for n, m in zip(x.shape[1:3], cotangent.shape[1:3], strict=True)]
    flipped = jnp.swapaxes(jnp.flip(kernel, (0, 1)), 2, 3)
    return _general_conv(cotangent, flipped, (1, 1), [(first, n) for n in last], x_dilation=(stride,) * 2)


def _kernel_gradient(x, kernel, cotangent, stride, padding):
    """The convolution of the input, with features as the batch, with the cotangents as one large window.

    Windows of other sizes than 3 take one matrix product per position.
    """
    window = kernel.shape[0]
    if window != 3:
        flat = cotangent.reshape(-1, kernel.shape[-1])
        windows = _windows(_pad(x, padding), window, stride)
        return jnp.stack([s.reshape(flat.shape[0], -1).T @ flat for s in windows]).reshape(kernel.shape)
    sizes = zip(x.shape[1:3], cotangent.shape[1:3], strict=True)
    pads = [(padding, (m - 1) * stride + window - n - padding) for n, m in sizes]
    large = jnp.transpose(cotangent, (1, 2, 0, 3))
    dk = _general_conv(jnp.transpose(x, (3, 1, 2, 0)), large, (1, 1), pads, kernel_dilation=(stride,) * 2)
    return jnp.transpose(dk, (1, 2, 0, 3))


def _conv2d_cpu(x, kernel, stride, padding):
    if kernel.shape[-2] >= MANY_FEATURES:
        return _im2col(x, kernel, stride, padding)
    return _conv2d(x, kernel, stride, padding)


def _im2col(x, kernel, stride, padding):
    """One matrix product over all windows (im2col)."""
    columns = jnp.concatenate(list(_windows(_pad(x, padding), kernel.shape[0], stride)), axis=-1)
    return columns @ kernel.reshape(-1, kernel.shape[-1])


def _conv3d_cpu(x, kernel, stride, padding):
    taps = kernel.shape[0]
    if x.shape[1] <= 4:
        return _im2col(x, kernel, stride, padding)
    x = jnp.pad(x, ((0, 0), (padding, padding), *[(0, 0)] * 3))
    depth = (x.shape[1] - taps) // stride + 1
    slices = (lax.slice_in_dim(x, k, k + (depth - 1) * stride + 1, stride, axis=1) for k in range(taps))
    out = sum(
        _conv2d_cpu(part.reshape(-1, *part.shape[2:]), tap, stride, padding)
        for part, tap in zip(slices, kernel, strict=True)
    )
    return out.reshape(x.shape[0], depth, *out.shape[1:])


def upsample_conv(
    x: Float[Array, "batch *space in"], kernel: Float[Array, "*window in out"], bf16: bool = False
) -> Float[Array, "batch *double_space out"]:
    """conv(nearest x2 of x, kernel) for a 3-wide kernel, computed at the low resolution: 2^n instead of 3^n taps.

    The repeated pixels under a window are two distinct ones; their taps are added up once per output parity, all
    parities are channels of one convolution, and its results are interleaved.  Of the coarsest grids every pixel is
    repeated: adding up the kernel would take longer than its products.
    """
    n, space = x.ndim - 2, x.shape[1:-1]
    if max(space) <= FEW_PIXELS:
        for axis in range(1, n + 1):
            x = jnp.repeat(x, 2, axis=axis)
        return conv(x, kernel, bf16=bf16)
    features_in, features_out = kernel.shape[-2:]
    for axis in range(n):  # 3 fine taps -> 2 coarse taps in place, the parity appended
        # output 2i + p reads the fine pixels 2i + p - 1 .. 2i + p + 1, which are the coarse ones i - 1 + p and i + p
        first, middle, last = (lax.slice_in_dim(kernel, k, k + 1, axis=axis) for k in range(3))
        parities = (first, middle + last), (first + middle, last)
        kernel = jnp.stack([jnp.concatenate(taps, axis=axis) for taps in parities], axis=-1)
    kernel = jnp.moveaxis(kernel, range(n + 2, 2 * n + 2), range(n + 1, 2 * n + 1))
    out = conv(x, kernel.reshape(*[2] * n, features_in, -1), bf16=bf16)
    parts = out.reshape(*out.shape[:-1], *[2] * n, features_out)  # parities stand in axes n + 1 .. 2n
    for axis, size in enumerate(space):
        # an output of parity p at i is the window that begins at i - 1 + p: position i + p of the padded input
        even, odd = (
            lax.slice_in_dim(lax.slice_in_dim(parts, p, p + 1, axis=n + 1 + axis), p, p + size, axis=1 + axis)
            for p in (0, 1)
        )
        parts = jnp.concatenate([even, odd], axis=n + 1 + axis)
    woven = [axis for pair in zip(range(1, n + 1), range(n + 1, 2 * n + 1), strict=True) for axis in pair]
    return jnp.transpose(parts, (0, *woven, 2 * n + 1)).reshape(x.shape[0], *(2 * s for s in space), features_out)


# --- normalisation ----------------------------------------------------------------------------------------------------


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
            x = jnp.where(mask[..., None], x, 0)  # padding may hold any values
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
        scale, bias = (
            self.param(name, start, (x.shape[-1],))
            for name, start in (("scale", nn.initializers.ones), ("bias", nn.initializers.zeros))
        )
        groups = x.reshape(x.shape[0], -1, self.num_groups, x.shape[-1] // self.num_groups)
        centred = groups - jnp.mean(groups, axis=(1, 3), keepdims=True)
        variance = jnp.mean(jnp.square(centred), axis=(1, 3), keepdims=True)
        normalised = (centred / jnp.sqrt(variance + EPSILON)).reshape(x.shape)
        return normalised * per_feature(scale, x) + per_feature(bias, x)
