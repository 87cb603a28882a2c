"""FLIP: how different two pictures look to a person who flips between them on a screen, 0 the same, 1 the most.

Low dynamic range, as published: Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images".  Colours
that the eye resolves at the viewing distance are compared (`_color_error`), and differences at edges and points of the
luminance count more (`_feature_error`).

Images are sRGB in [0, 1], (*batch, height, width, 3); colours are relative to white, which is (1, 1, 1) in XYZ.
All filters are separable; along one axis a filter with the border pixels repeated outwards is a matrix (`_filtering`).
Gradients are finite: they are 0 where the measure has a kink or an infinite slope (equal colours, flat luminance).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.kernels.colors import srgb_to_linear
from spnr_jax.kernels.numerics import clamp

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * np.pi / 180  # 67.02: a 4K screen 0.7 m wide, seen from 0.7 m
# contrast sensitivity: sums of amplitude * sqrt(pi / width) * exp(-pi^2 degrees^2 / width), by channel
SENSITIVITY = {
    "achromatic": [(1.0, 0.0047)],
    "red-green": [(1.0, 0.0053)],
    "blue-yellow": [(34.1, 0.04), (13.5, 0.025)],
}
EDGE_WIDTH = 0.082  # degrees, from peak to trough of the eye's edge detector
COLOR_EXPONENT, FEATURE_EXPONENT = 0.7, 0.5
KNEE, KNEE_ERROR = 0.4, 0.95  # this share of the largest colour difference is an error of 0.95
LAB_LIMIT = (6 / 29) ** 3  # where line and cube root of L*a*b* meet

_RGB_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
RGB_TO_XYZ = _RGB_TO_XYZ / _RGB_TO_XYZ.sum(axis=1, keepdims=True)
# Y, X - Y, Y - Z: the paper's YCxCz up to scale and offset, which filters that sum to 1 do not see
RGB_TO_OPPONENT = np.array([[0.0, 1, 0], [1, -1, 0], [0, 1, -1]]) @ RGB_TO_XYZ


def flip(
    image: Float[Array, "*batch height width 3"],
    reference: Float[Array, "*batch height width 3"],
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> Float[Array, "*batch"]:
    """Mean of the error map."""
    return jnp.mean(flip_map(image, reference, pixels_per_degree), axis=(-2, -1))


def flip_map(
    image: Float[Array, "*batch height width 3"],
    reference: Float[Array, "*batch height width 3"],
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> Float[Array, "*batch height width"]:
    """Error of each pixel in [0, 1]: color_error^(1 - feature_error)."""
    linear = srgb_to_linear(jnp.stack([image, reference]))
    opponent = _mixed(RGB_TO_OPPONENT, linear)
    feature = _feature_error(opponent[..., 0], pixels_per_degree)
    return _power(_color_error(opponent, pixels_per_degree), 1 - feature)


def _color_error(
    opponent: Float[Array, "2 *batch height width 3"], pixels_per_degree: float
) -> Float[Array, "*batch height width"]:
    """Distance of the colours that the eye resolves, redistributed to [0, 1]."""
    seen = [
        sum(share * _filtered(opponent[..., i], taps, taps) for share, taps in _sensitivity(channel, pixels_per_degree))
        for i, channel in enumerate(SENSITIVITY)
    ]
    linear = _mixed(np.linalg.inv(RGB_TO_OPPONENT), jnp.stack(seen, axis=-1))
    distance = _distance(*_hunt_lab(clamp(linear, 0.0, 1.0)))
    green, blue = _hunt_lab(jnp.eye(3, dtype=linear.dtype)[1:])
    error, largest = _power(distance, COLOR_EXPONENT), _power(_distance(green, blue), COLOR_EXPONENT)
    knee = KNEE * largest
    beyond = KNEE_ERROR + (1 - KNEE_ERROR) * (error - knee) / (largest - knee)
    return jnp.where(error < knee, KNEE_ERROR * error / knee, beyond)


def _feature_error(
    luminance: Float[Array, "2 *batch height width"], pixels_per_degree: float
) -> Float[Array, "*batch height width"]:
    """Difference of the strengths of edges, or of points where that is larger, in [0, 1]."""
    smooth, edge, point = _feature_taps(pixels_per_degree)
    differences = []
    for taps in (edge, point):
        image, reference = _norm(_filtered(luminance, taps, smooth), _filtered(luminance, smooth, taps))
        differences.append(jnp.abs(image - reference))
    return _power(jnp.maximum(*differences) / np.sqrt(2), FEATURE_EXPONENT)


def _sensitivity(channel: str, pixels_per_degree: float) -> list[tuple[float, np.ndarray]]:
    """Shares (they sum to 1) and taps of the Gaussians whose sum is the eye's response to a channel."""
    widest = max(width for terms in SENSITIVITY.values() for _, width in terms)
    radius = int(np.ceil(3 * np.sqrt(widest / (2 * np.pi**2)) * pixels_per_degree))
    degrees = np.arange(-radius, radius + 1) / pixels_per_degree
    terms = []
    for amplitude, width in SENSITIVITY[channel]:
        taps = np.exp(-((np.pi * degrees) ** 2) / width)
        terms.append((amplitude * np.sqrt(np.pi / width) * taps.sum() ** 2, taps / taps.sum()))
    total = sum(mass for mass, _ in terms)
    return [(mass / total, taps) for mass, taps in terms]


def _feature_taps(pixels_per_degree: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gaussian, and its first and second derivative with positive taps that sum to 1 and negative ones to -1."""
    deviation = 0.5 * EDGE_WIDTH * pixels_per_degree
    x = np.arange(-int(np.ceil(3 * deviation)), int(np.ceil(3 * deviation)) + 1)
    gaussian = np.exp(-(x**2) / (2 * deviation**2))

    def balanced(taps):
        return np.where(taps > 0, taps / taps[taps > 0].sum(), -taps / taps[taps < 0].sum())

    return gaussian / gaussian.sum(), balanced(-x * gaussian), balanced((x**2 / deviation**2 - 1) * gaussian)


def _filtered(
    plane: Float[Array, "*batch height width"], down: np.ndarray, across: np.ndarray
) -> Float[Array, "*batch height width"]:
    """The plane correlated with taps along its height and its width."""
    height, width = plane.shape[-2:]
    filters = (jnp.asarray(_filtering(taps, size), plane.dtype) for taps, size in ((down, height), (across, width)))
    return jnp.einsum("ij,lk,...jk->...il", *filters, plane, precision="highest")


def _filtering(taps: np.ndarray, size: int) -> np.ndarray:
    """Matrix (size, size) that correlates a line with the taps, its ends repeated outwards."""
    matrix = np.zeros((size, size))
    offsets = np.arange(len(taps)) - len(taps) // 2
    for i in range(size):
        np.add.at(matrix[i], np.clip(i + offsets, 0, size - 1), taps)
    return matrix


def _hunt_lab(linear: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """L*a*b* of linear RGB, a* and b* times L*/100: colours matter less in the dark (the Hunt effect)."""
    xyz = _mixed(RGB_TO_XYZ, linear)
    curved = xyz > LAB_LIMIT
    t = jnp.where(curved, jnp.cbrt(jnp.where(curved, xyz, 1)), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = t[..., 0], t[..., 1], t[..., 2]
    lightness = 116 * y - 16
    return jnp.stack([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)], axis=-1)


def _distance(first: Float[Array, "*batch 3"], second: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """HyAB: difference in lightness plus Euclidean distance in chroma."""
    change = first - second
    return jnp.abs(change[..., 0]) + _norm(change[..., 1], change[..., 2])


def _mixed(matrix: np.ndarray, colors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    return jnp.einsum("ij,...j->...i", jnp.asarray(matrix, colors.dtype), colors, precision="highest")


def _norm(x: Float[Array, "*batch"], y: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """sqrt(x^2 + y^2), with gradient 0 at 0."""
    squared = x**2 + y**2
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)


def _power(x: Float[Array, "*batch"], exponent: Float[Array, "*batch"] | float) -> Float[Array, "*batch"]:
    """x^exponent of a number that is not negative, 0 with gradient 0 at 0."""
    return jnp.where(x > 0, jnp.where(x > 0, x, 1) ** exponent, 0)
