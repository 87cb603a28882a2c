"""Image quality, one number per image.

Images are float RGB in [0, 1] on white, (*batch, height, width, 3); ValueError for others, or of different shapes.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from spnr_jax.errors import UserError
from spnr_jax.kernels.numerics import check_alike, safe_divide

PSNR_CAP = 100.0  # dB, of identical images
SSIM_SIGMA, SSIM_RADIUS = 1.5, 5  # gaussian window of Wang et al. 2004, cut at 3.5 sigma as scikit-image does
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def _decibel(mean_squared_error):
    floor = 10 ** (-PSNR_CAP / 10)
    return -10 * jnp.log10(jnp.maximum(mean_squared_error, floor))


def psnr(
    image: Float[Array, "*batch height width 3"], reference: Float[Array, "*batch height width 3"]
) -> Float[Array, "*batch"]:
    """Peak signal-to-noise ratio in dB, at most 100."""
    check_alike("psnr", image, reference)
    return _decibel(jnp.mean((image - reference) ** 2, axis=(-3, -2, -1)))


def conditional_psnr(
    image: Float[Array, "*batch height width 3"],
    reference: Float[Array, "*batch height width 3"],
    mask: Bool[Array, "*batch height width"],
) -> Float[Array, "*batch"]:
    """PSNR over the condition pixels, at which a visible input point lies; NaN if there is none (skip and count it)."""
    check_alike("conditional_psnr", image, reference)
    if np.shape(mask) != np.shape(image)[:-1]:
        raise UserError(f"conditional_psnr: expected a mask {np.shape(image)[:-1]}, got {np.shape(mask)}")
    squared = jnp.sum(jnp.where(mask[..., None], (image - reference) ** 2, 0), axis=(-3, -2, -1))
    count = 3 * jnp.sum(mask, axis=(-2, -1))
    return jnp.where(count > 0, _decibel(safe_divide(squared, count.astype(squared.dtype))), jnp.nan)


def ssim(
    image: Float[Array, "*batch height width 3"], reference: Float[Array, "*batch height width 3"]
) -> Float[Array, "*batch"]:
    """Structural similarity, mean over channels; scikit-image's with gaussian weights, sigma 1.5, data range 1.

    Its `use_sample_covariance` is False.  Off by up to 1e-3 where both images are bright and flat: a small variance is
    the difference of large squares.
    """
    check_alike("ssim", image, reference)
    if min(image.shape[-3:-1]) < 2 * SSIM_RADIUS + 1:
        raise UserError(f"ssim needs images of at least {2 * SSIM_RADIUS + 1} pixels, got {image.shape[-3:-1]}")
    taps = np.exp(-0.5 * (np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) / SSIM_SIGMA) ** 2)
    taps = (taps / taps.sum()).tolist()

    def blur(x):  # the border, where the window extends beyond the image, is cropped
        for axis in (x.ndim - 3, x.ndim - 2):
            shifted = (jax.lax.slice_in_dim(x, i, x.shape[axis] - 2 * SSIM_RADIUS + i, axis=axis) for i in range(11))
            x = sum(tap * part for tap, part in zip(taps, shifted, strict=True))
        return x

    mean_x, mean_y = blur(image), blur(reference)
    variance_x, variance_y = blur(image**2) - mean_x**2, blur(reference**2) - mean_y**2
    covariance = blur(image * reference) - mean_x * mean_y
    score = (2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)
    score = score / ((mean_x**2 + mean_y**2 + SSIM_C1) * (variance_x + variance_y + SSIM_C2))
    return jnp.mean(score, axis=(-3, -2, -1))


def opacity_iou(
    acc: Float[Array, "*batch height width"], alpha: Float[Array, "*batch height width"]
) -> Float[Array, "*batch"]:
    """Intersection over union of the pixels that are more than half opaque; 1 if neither image has any."""
    ours, theirs = acc > 0.5, alpha > 0.5
    union = jnp.sum(ours | theirs, axis=(-2, -1))
    return jnp.where(union > 0, safe_divide(1.0 * jnp.sum(ours & theirs, axis=(-2, -1)), 1.0 * union), 1.0)
