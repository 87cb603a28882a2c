"""Sharpness of a picture beside its reference: error inside the silhouette and along it, holes, detail.

Pictures are sRGB in [0, 1] on white; references are 8-bit RGBA with straight alpha; lengths are pixels.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter

from spnr_jax.formats.data_sets import on_white

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
    reference: UInt8[np.ndarray, "height width 4"],
) -> Sharpness:
    """The scores of a picture; NaN where the reference has no pixel for a score."""
    alpha, white = reference[..., 3].astype(np.float32) / 255, on_white(reference)
    squared, body = (image - white) ** 2, alpha > 0.5
    outline = binary_dilation(body, iterations=OUTLINE) & ~binary_erosion(body, iterations=OUTLINE)
    deep = binary_erosion(body, iterations=WELL_INSIDE)
    return Sharpness(
        psnr=_decibels(squared),
        psnr_inside=_decibels(squared[reference[..., 3] == 255]),
        outline_rmse=mean((opacity - alpha)[outline] ** 2) ** 0.5,
        holes=100 * mean(opacity[deep] < SOLID),
        detail=_correlation(_residue(image)[deep], _residue(white)[deep]),
    )


def mean(values: np.ndarray) -> float:
    """The mean; NaN of nothing."""
    return float(np.mean(values)) if values.size else float("nan")


def _decibels(squared: np.ndarray) -> float:
    error = mean(squared)
    return float(min(-10 * np.log10(error), 100.0)) if error > 0 else (100.0 if error == 0 else error)


def _residue(image: np.ndarray) -> np.ndarray:
    """Difference between the mean of the colours and its Gaussian blur."""
    grey = image.mean(axis=-1)
    return grey - gaussian_filter(grey, DETAIL)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    if one.size < 2 or one.std() == 0 or other.std() == 0:
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])


SILENT = 1e-10  # spectral energy per pixel below which there is only rounding; 8-bit steps have 5e-7


def compare_high_frequencies(
    image: Float[np.ndarray, "*batch height width 3"], reference: Float[np.ndarray, "*batch height width 3"]
) -> Float[np.ndarray, "*batch"]:
    """Energy of the image over that of the reference above half of the Nyquist frequency; 1 is equally sharp.

    Spectra of all channels in a Hann window; a constant does not count.  NaN where the reference has no such energy.
    """
    height, width = image.shape[-3:-1]
    rows, columns = (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n) for n in (height, width))
    window = rows[:, None, None] * columns[:, None]
    high = np.hypot(2 * np.fft.fftfreq(height)[:, None, None], 2 * np.fft.fftfreq(width)[:, None]) >= 0.5

    def energy(x: np.ndarray) -> np.ndarray:
        centred = x - x.mean(axis=(-3, -2), keepdims=True, dtype=np.float64)
        spectrum = np.fft.fft2(centred * window, axes=(-3, -2), norm="ortho")
        return (np.abs(spectrum) ** 2 * high).sum(axis=(-3, -2, -1))

    ours, theirs = energy(image), energy(reference)
    known = theirs > SILENT * height * width
    return np.where(known, ours / np.where(known, theirs, 1), np.nan)
