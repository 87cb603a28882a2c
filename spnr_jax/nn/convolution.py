"""Convolutions in the form that each platform computes fastest; the map never depends on the form.

Layout is channels last: inputs (batch, *space, in), kernels (*window, in, out) with equal sides.  Strided convolutions
pad one voxel on every side, like the stride-1 ones (a SAME rule would pad the far side only).  On a GPU the native
convolutions of XLA are right; on a CPU (measurements: docs/performance.md)
  3D   a sum over depth taps of 2D convolutions, or one matrix product for tiny volumes
  2D   native, but as matrix products the gradients of 2-wide windows, the kernel's of 4-wide windows and of few output
       features; 128 input features or more in one matrix product
"""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

FEW_FEATURES = 4  # of a convolution's output, for which XLA's gradient of the kernel is slow
FEW_PIXELS = 2  # an axis, for which a kernel is larger than what it is folded for
MANY_FEATURES = 128  # of its input, for which one matrix product is faster than a convolution

kernel_init = jax.nn.initializers.he_normal(in_axis=-2, out_axis=-1)


def conv(
    x: Float[Array, "batch *space in"],
    kernel: Float[Array, "*window in out"],
    stride: int = 1,
    padding: int = 1,
    bf16: bool = False,
) -> Float[Array, "batch *out_space out"]:
    """Convolution (correlation) in 2D or 3D with equal stride and padding on every axis.

    With bf16 the convolution and its gradients run in bfloat16; what goes in and comes out keeps its own format.
    """
    on_cpu, result = _conv2d_cpu if x.ndim == 4 else _conv3d_cpu, x.dtype
    if bf16:
        x, kernel = x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16)
    out = lax.platform_dependent(
        x, kernel, cpu=lambda x, k: on_cpu(x, k, stride, padding), default=lambda x, k: _native(x, k, stride, padding)
    )
    return out.astype(result)


def _native(x, kernel, stride, padding):
    n = x.ndim - 2
    axes = "DHW"[-n:]
    return lax.conv_general_dilated(
        x, kernel, (stride,) * n, [(padding, padding)] * n, dimension_numbers=(f"N{axes}C", f"{axes}IO", f"N{axes}C")
    )


def _windows(x, window: int, stride: int):
    """For each place in a window of the trailing spatial axes: what it sees in every window, (batch, *out, in)."""
    stops = [(s - window) // stride * stride + 1 for s in x.shape[1:-1]]
    for place in itertools.product(range(window), repeat=x.ndim - 2):
        corner = (0, *place, 0)
        end = (x.shape[0], *(p + s for p, s in zip(place, stops, strict=True)), x.shape[-1])
        yield lax.slice(x, corner, end, (1, *[stride] * len(stops), 1))


def _pad(x, padding: int):
    return jnp.pad(x, ((0, 0), *[(padding, padding)] * (x.ndim - 2), (0, 0)))


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _conv2d_products(x, kernel, stride, padding):
    return _native(x, kernel, stride, padding)


def _conv2d_backward(stride, padding, inputs, cotangent):
    """XLA's gradient for the input, or one matrix product; for the kernel one per place in the window, or one for all.

    With few output features the cotangents that every input pixel meets in the window are put side by side.
    """
    x, kernel = inputs
    if kernel.shape[0] == 2 and (stride, padding) == (1, 1):
        dx = _input_gradient_of_pairs(x, kernel, cotangent)
    else:
        (dx,) = jax.linear_transpose(lambda x: _native(x, kernel, stride, padding), x)(cotangent)
    window, (features_in, features_out) = kernel.shape[0], kernel.shape[2:]
    if stride == 1 and features_out <= FEW_FEATURES:
        met = list(_windows(_pad(cotangent, window - 1 - padding), window, 1))
        columns = jnp.concatenate(met[::-1], axis=-1)
        dk = x.reshape(-1, features_in).T @ columns.reshape(-1, window**2 * features_out)
        return dx, dk.reshape(features_in, window, window, features_out).transpose(1, 2, 0, 3)
    flat = cotangent.reshape(-1, features_out)
    seen = _windows(_pad(x, padding), window, stride)
    dk = jnp.stack([s.reshape(flat.shape[0], -1).T @ flat for s in seen])
    return dx, dk.reshape(kernel.shape)


def _input_gradient_of_pairs(x, kernel, cotangent):
    """What each place of a window of 2 gives to its input, by one matrix product, and the sum of the four."""
    height, width, features_in = x.shape[1:]
    given = cotangent @ jnp.moveaxis(kernel, -1, 0).reshape(kernel.shape[-1], -1)
    given = given.reshape(*cotangent.shape[:3], 2, 2, features_in)
    return sum(given[:, 1 - i : 1 - i + height, 1 - j : 1 - j + width, i, j] for i in (0, 1) for j in (0, 1))


_conv2d_products.defvjp(lambda x, k, stride, padding: (_native(x, k, stride, padding), (x, k)), _conv2d_backward)


def _conv2d_cpu(x, kernel, stride, padding):
    window, (features_in, features_out) = kernel.shape[0], kernel.shape[2:]
    if features_in >= MANY_FEATURES and features_out > FEW_FEATURES:
        return _columns(x, kernel, stride, padding)
    form = _conv2d_products if window != 3 or features_out <= FEW_FEATURES else _native
    return form(x, kernel, stride, padding)


def _columns(x, kernel, stride, padding):
    """One matrix product of everything that each window sees."""
    columns = jnp.concatenate(list(_windows(_pad(x, padding), kernel.shape[0], stride)), axis=-1)
    return columns @ kernel.reshape(-1, kernel.shape[-1])


def _conv3d_cpu(x, kernel, stride, padding):
    taps = kernel.shape[0]
    if x.shape[1] <= 4:
        return _columns(x, kernel, stride, padding)
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
