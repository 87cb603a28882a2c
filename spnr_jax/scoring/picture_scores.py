"""Scores of pictures as people see them: FLIP, LPIPS, outline, holes, detail, and two objects with a known answer.

Pictures are sRGB in [0, 1] on white, (*batch, height, width, 3); lengths are pixels.  FLIP (Andersson et al. 2020, low
dynamic range) compares what the eye resolves at PIXELS_PER_DEGREE, by the package `flip-evaluator`.  LPIPS (Zhang et
al. 2018, version 0.1, AlexNet) compares features of a trained network; it is measured where the package `lpips` is
installed and finds its weights.  Both are 0 for the same picture.  The others take references as RGBA with straight
alpha, float in [0, 1].
"""

import importlib
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from flip_evaluator import evaluate
from jaxtyping import Float
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, gaussian_filter

from spnr_jax.formats.columns import srgb_to_linear
from spnr_jax.kernels.cloud_arrays import plain_cloud
from spnr_jax.kernels.records import AnyArray, PointCloud

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * np.pi / 180  # 67.02: a 4K screen 0.7 m wide, seen from 0.7 m
NO_LPIPS = "n/a (pip install lpips)"
SMALLEST = 32  # pixels along a side that AlexNet takes


def flip(
    image: Float[AnyArray, "*batch height width 3"], reference: Float[AnyArray, "*batch height width 3"]
) -> Float[np.ndarray, "*batch"]:
    """Mean of FLIP's error map."""
    pairs = zip(_views(reference), _views(image), strict=True)
    asked = {"applyMagma": False, "computeMeanError": False, "parameters": {"ppd": PIXELS_PER_DEGREE}}
    means = [evaluate(wanted, shown, "LDR", **asked)[0].mean(dtype=np.float64) for wanted, shown in pairs]
    return np.array(means).reshape(np.shape(image)[:-3])


def lpips(
    image: Float[AnyArray, "*batch height width 3"], reference: Float[AnyArray, "*batch height width 3"]
) -> Float[np.ndarray, "*batch"] | None:
    """LPIPS; None where it cannot be measured."""
    network = lpips_network()
    if network is None or min(np.shape(image)[-3:-1]) < SMALLEST:
        return None
    torch = importlib.import_module("torch")
    shown, wanted = (torch.from_numpy(2 * np.moveaxis(_views(x), -1, 1) - 1) for x in (image, reference))
    with torch.no_grad():
        return network(shown, wanted).numpy().reshape(np.shape(image)[:-3])


@cache
def lpips_network() -> Any:
    """The network of the package `lpips`; None without the package or without its weights."""
    try:
        return importlib.import_module("lpips").LPIPS(net="alex", verbose=False).eval()
    except (ImportError, OSError):  # the weights of AlexNet are downloaded once
        return None


def _views(pictures: AnyArray) -> Float[np.ndarray, "views height width 3"]:
    """The pictures one after the other, float32, in memory that may be written to, as the packages want it."""
    return np.array(pictures, np.float32, order="C").reshape(-1, *np.shape(pictures)[-3:])


OUTLINE = 3  # pixels to both sides of the true outline
WELL_INSIDE = 4  # pixels from the outline
SOLID = 0.9  # opacity below which a pixel well inside is a hole
COVERED = 0.3  # opacity from which on a picture's colour is told
DETAIL = 3.0  # standard deviation of the Gaussian whose residue is detail
WAVES = 8.0  # the same for the ball
GREY = 0.5  # base colour of the ball
PLATE = (2.0, 1.4, 0.03)  # sides


class Sharpness(NamedTuple):
    """Of one picture: decibels, a root mean square, per cent, a correlation."""

    psnr: float
    psnr_inside: float
    outline_rmse: float
    holes: float
    detail: float


def sharpness(
    image: Float[np.ndarray, "height width 3"],
    opacity: Float[np.ndarray, "height width"],
    reference: Float[np.ndarray, "height width 4"],
) -> Sharpness:
    """The scores of a picture; NaN where the reference has no pixel that a score is of."""
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


def under_true_opacity(
    image: Float[np.ndarray, "height width 3"],
    opacity: Float[np.ndarray, "height width"],
    reference: Float[np.ndarray, "height width 4"],
) -> Float[np.ndarray, "height width 3"]:
    """The picture's own colours under the reference's opacity: what it would be with perfect outlines, no holes.

    Where the picture shows little or nothing it takes the colour of the nearest pixel that it covers.
    """
    color = (image - 1 + opacity[..., None]) / np.maximum(opacity[..., None], COVERED)
    shown = opacity >= COVERED
    if shown.any():
        color = color[tuple(distance_transform_edt(~shown, return_distances=False, return_indices=True))]
    alpha = reference[..., 3:]
    return np.clip(color, 0, 1) * alpha + 1 - alpha


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def _decibels(squared: np.ndarray) -> float:
    mean = _mean(squared)
    return float(min(-10 * np.log10(mean), 100.0)) if mean > 0 else (100.0 if mean == 0 else mean)


def _residue(image: np.ndarray, sigma: float) -> np.ndarray:
    """What a Gaussian takes away of the mean of the colours."""
    grey = image.mean(axis=-1)
    return grey - gaussian_filter(grey, sigma)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    if one.size < 2 or one.std() == 0 or other.std() == 0:
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])


def ball(count: int, seed: int = 0) -> PointCloud:
    """Random points of a grey ball: its picture should be smooth."""
    towards = np.random.default_rng(seed).standard_normal((count, 3))
    towards = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
    return plain_cloud(towards, GREY, towards)


def ball_waves(image: Float[np.ndarray, "height width 3"], opacity: Float[np.ndarray, "height width"]) -> float:
    """Root mean square of what a wide Gaussian takes away of the ball, away from its outline."""
    inside = binary_erosion(opacity > 0.5, iterations=int(3 * WAVES))
    return _mean(_residue(image, WAVES)[inside] ** 2) ** 0.5


def plate(count: int, seed: int = 0) -> PointCloud:
    """Random points of a thin plate, red in front (+z) and blue behind and at the rims."""
    generator = np.random.default_rng(seed)
    width, height, depth = PLATE
    areas = np.array([width * height] * 2 + [width * depth] * 2 + [height * depth] * 2)
    side = generator.choice(6, count, p=areas / areas.sum())
    places = generator.uniform(-0.5, 0.5, (count, 3))
    axis, sign = np.array([2, 2, 1, 1, 0, 0])[side], np.where(side % 2 == 0, 0.5, -0.5)
    places[np.arange(count), axis] = sign
    normals = np.zeros((count, 3), np.float32)
    normals[np.arange(count), axis] = 2 * sign
    color = np.where((side == 0)[:, None], [0.8, 0.05, 0.05], [0.05, 0.05, 0.8])
    return plain_cloud((places * PLATE).astype(np.float32), color.astype(np.float32), normals)


def blue_share(image: Float[np.ndarray, "height width 3"], opacity: Float[np.ndarray, "height width"]) -> float:
    """Share of blue in the colour of the plate's front, in linear light; .077 is true (its rims are not seen)."""
    inside = binary_erosion(opacity > 0.5, iterations=WELL_INSIDE)
    if not inside.any():
        return float("nan")
    red, _, blue = srgb_to_linear(image)[inside].mean(axis=0)
    return float(blue / (red + blue))
