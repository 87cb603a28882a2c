"""3^n convolutions in the form that each platform computes fastest; the map never depends on the form.

Layout is channels last: inputs (batch, *space, in), kernels (3, ..., 3, in, out).  Strided convolutions pad one voxel on
every side, like the stride-1 ones (a SAME rule would pad the far side only).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

# Row p holds, for each of the two coarse taps, which of the three fine taps fall on it when a row of pixels was
# repeated twice and the output has parity p: output 2i + p reads fine 2i + p - 1 .. 2i + p + 1, coarse i - 1 + p, i + p.
REPEAT_FOLD = np.array([[[1, 0, 0], [0, 1, 1]], [[1, 1, 0], [0, 0, 1]]], np.float32)


def conv(
    x: Float[Array, "batch *space in"], kernel: Float[Array, "*window in out"], stride: int = 1, padding: int = 1
) -> Float[Array, "batch *out_space out"]:
    """Convolution (correlation) in 2D or 3D with equal stride and padding on every axis."""
    if x.ndim == 4:
        return _native(x, kernel, stride, padding)
    return lax.platform_dependent(
        x,
        kernel,
        cpu=lambda x, kernel: _conv3d_cpu(x, kernel, stride, padding),
        default=lambda x, kernel: _native(x, kernel, stride, padding),
    )


def _native(x, kernel, stride, padding):
    n = x.ndim - 2
    axes = "DHW"[-n:]
    return lax.conv_general_dilated(
        x, kernel, (stride,) * n, [(padding, padding)] * n, dimension_numbers=(f"N{axes}C", f"{axes}IO", f"N{axes}C")
    )


def _conv3d_cpu(x, kernel, stride, padding):
    """As a sum over depth taps of a 2D convolution; tiny volumes as one matrix product.

    XLA's native 3D convolution on CPU takes 2 to 7 times as long, its strided gradient 40 times (docs/performance.md).
    """
    taps = kernel.shape[0]
    x = jnp.pad(x, ((0, 0), (padding, padding), *[(0, 0)] * 3))
    depth = (x.shape[1] - taps) // stride + 1
    slices = [lax.slice_in_dim(x, k, k + (depth - 1) * stride + 1, stride, axis=1) for k in range(taps)]
    if x.shape[2] <= 4:
        return _conv3d_matmul(slices, kernel, stride, padding)
    parts = (
        _native(part.reshape(-1, *part.shape[2:]), tap, stride, padding) for part, tap in zip(slices, kernel, strict=True)
    )
    out = sum(parts)
    return out.reshape(x.shape[0], depth, *out.shape[1:])


def _conv3d_matmul(slices, kernel, stride, padding):
    taps = kernel.shape[0]
    columns = []
    for part in slices:
        part = jnp.pad(part, ((0, 0), (0, 0), (padding, padding), (padding, padding), (0, 0)))
        size = (part.shape[2] - taps) // stride + 1
        stop = (size - 1) * stride + 1
        columns += [
            part[:, :, i : i + stop : stride, j : j + stop : stride] for i in range(taps) for j in range(taps)
        ]
    return jnp.concatenate(columns, axis=-1) @ kernel.reshape(-1, kernel.shape[-1])


def upsample_conv(
    x: Float[Array, "batch *space in"], kernel: Float[Array, "*window in out"]
) -> Float[Array, "batch *double_space out"]:
    """conv(nearest x2 of x, kernel), computed at the low resolution: 2^n instead of 3^n taps per output.

    The repeated pixels under a 3-tap window are two distinct ones; their taps are added up once per output parity, all
    parities are channels of one convolution, and its results are interleaved.
    """
    n = x.ndim - 2
    features_in, features_out = kernel.shape[-2:]
    for axis in range(n):  # (..., 3, ...) -> (..., 2, ...), the parity appended
        kernel = jnp.moveaxis(jnp.tensordot(kernel, REPEAT_FOLD, axes=([axis], [2])), -1, axis)
    kernel = jnp.moveaxis(kernel, range(n + 2, 2 * n + 2), range(n + 1, 2 * n + 1)).reshape(*[2] * n, features_in, -1)
    out = conv(x, kernel, padding=1).reshape(x.shape[0], *[s + 1 for s in x.shape[1:-1]], *[2] * n, features_out)
    return _interleave(out, x.shape[1:-1])


def _interleave(out, space):
    """Picks for each parity its own shift of the n + 1 window positions and weaves the parities together."""
    n = len(space)
    for axis in range(1, n + 1):
        parity_axis = n + 1 + (axis - 1)
        even, odd = (
            lax.slice_in_dim(lax.index_in_dim(out, p, parity_axis, keepdims=True), p, p + space[axis - 1], axis=axis)
            for p in (0, 1)
        )
        out = jnp.concatenate([even, odd], axis=parity_axis)
    order = [0]
    for axis in range(1, n + 1):
        order += [axis, axis + n]
    out = jnp.transpose(out, [*order, 2 * n + 1])
    return out.reshape(out.shape[0], *[2 * s for s in space], out.shape[-1])


kernel_init = jax.nn.initializers.he_normal(in_axis=-2, out_axis=-1)
