"""Sharpness of a picture beside its reference: error inside the silhouette and along it, holes, detail.

Pictures are sRGB in [0, 1] on white; references are RGBA with straight alpha, float in [0, 1]; lengths are pixels.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter

OUTLINE = 3  # pixels to both sides of the true outline
WELL_INSIDE = 4  # pixels from the outline
SOLID = 0.9  # opacity below which a pixel well inside is a hole
DETAIL = 3.0  # standard deviation of the Gaussian whose residue is detail


class Sharpness(NamedTuple):
    """Of one picture: decibels, a root mean square, per cent, a correlation."""

    psnr: float
    psnr_inside: float
    outline_rmse: float
    holes: float
    detail: float


def measure_sharpness(
    image: Float[np.ndarray, "height width 3"],
    opacity: Float[np.ndarray, "height width"],
    reference: Float[np.ndarray, "height width 4"],
) -> Sharpness:
    """The scores of a picture; NaN where the reference has no pixel for a score."""
    alpha = reference[..., 3]
    white = reference[..., :3] * alpha[..., None] + 1 - alpha[..., None]
    squared, body = (image - white) ** 2, alpha > 0.5
    outline = binary_dilation(body, iterations=OUTLINE) & ~binary_erosion(body, iterations=OUTLINE)
    deep = binary_erosion(body, iterations=WELL_INSIDE)
    return Sharpness(
        psnr=_decibels(squared),
        psnr_inside=_decibels(squared[alpha > 0.999]),
        outline_rmse=_mean((opacity - alpha)[outline] ** 2) ** 0.5,
        holes=100 * _mean(opacity[deep] < SOLID),
        detail=_correlation(_residue(image, DETAIL)[deep], _residue(white, DETAIL)[deep]),
    )


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def _decibels(squared: np.ndarray) -> float:
    mean = _mean(squared)
    return float(min(-10 * np.log10(mean), 100.0)) if mean > 0 else (100.0 if mean == 0 else mean)


def _residue(image: np.ndarray, sigma: float) -> np.ndarray:
    """Difference between the mean of the colours and its Gaussian blur."""
    grey = image.mean(axis=-1)
    return grey - gaussian_filter(grey, sigma)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    if one.size < 2 or one.std() == 0 or other.std() == 0:
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])
