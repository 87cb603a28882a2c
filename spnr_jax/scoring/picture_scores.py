"""Scores of pictures, and statistics over objects: means with intervals, paired differences.

Pictures are sRGB in [0, 1] on white, (*batch, height, width, 3); lengths are pixels.  FLIP (Andersson et al. 2020, low
dynamic range) compares what the eye resolves at PIXELS_PER_DEGREE, by the package `flip-evaluator`.  LPIPS (Zhang et
al. 2018, version 0.1, AlexNet) compares features of a trained network; it is measured where the package `lpips` is
installed and finds its weights.  Both are 0 for the same picture.

Scores are an array (views,) for each object; a NaN is a view without a score and is left out; None stands for a missing
number.  Intervals are those of the mean over views, by a cluster bootstrap over objects (views of one object are not
independent): percentile intervals at an expanded level that is exact for means of normal scores (Hesterberg 2015), none
below FEWEST_OBJECTS.  Differences are paired by view; their p-value is that of a sign-flip test over objects.  Objects
are sorted first, so their order does not matter.
"""

import importlib
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import numpy as np
from flip_evaluator import evaluate
from jaxtyping import Float, Int

from spnr_jax.kernels.records import AnyArray

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * np.pi / 180  # 67.02: a 4K screen 0.7 m wide, seen from 0.7 m
NO_LPIPS = "n/a (pip install lpips)"
SMALLEST = 32  # pixels along a side that AlexNet takes


def flip(
    image: Float[AnyArray, "*batch height width 3"], reference: Float[AnyArray, "*batch height width 3"]
) -> Float[np.ndarray, "*batch"]:
    """Mean of FLIP's error map."""
    pairs = zip(_views(reference), _views(image), strict=True)
    options = {"applyMagma": False, "computeMeanError": False, "parameters": {"ppd": PIXELS_PER_DEGREE}}
    means = [evaluate(wanted, shown, "LDR", **options)[0].mean(dtype=np.float64) for wanted, shown in pairs]
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


# --- means and intervals ----------------------------------------------------------------------------------------------


METRICS = ("psnr", "ssim", "cpsnr", "flip", "lpips", "iou")
RESAMPLES, LEVEL, SEED = 10_000, 0.95, 0
FEWEST_OBJECTS = 5  # objects, below which no percentile of resampled means is as wide as an interval should be

Scores = dict[str, np.ndarray]  # metric -> score of each view (views,); cpsnr is NaN where no point is visible


def metric_settings() -> dict[str, str]:
    """How the metrics were measured; shown beside every table."""
    return {
        "images": "sRGB in [0, 1] over white; means over images",
        "PSNR": "at most 100 dB; cPSNR over the pixels of visible input points, images without any left out",
        "SSIM": "Gaussian window, sigma 1.5, as scikit-image",
        "FLIP": f"LDR, {PIXELS_PER_DEGREE:.2f} pixels per degree, mean of the error map",
        "LPIPS": NO_LPIPS if lpips_network() is None else "AlexNet v0.1, images on [-1, 1]",
        "intervals": f"{100 * LEVEL:.0f} %, bootstrap over objects, {RESAMPLES} resamples",
    }


def summarise(results: Sequence[dict[str, Scores]]) -> dict[str, dict]:
    """Mean of each metric over all images of each method, its interval, and the counts behind them."""
    table = {}
    for method in results[0]:
        objects = [scores[method] for scores in results]
        visible = np.concatenate([scores["cpsnr"] for scores in objects])
        counts = {"objects": len(objects), "views": len(visible), "cpsnr_views": int(np.sum(~np.isnan(visible)))}
        table[method] = means(objects) | counts
    return table


def differences(results: Sequence[dict[str, Scores]], method: str = "ours") -> dict[str, dict]:
    """The method minus each other one, view by view: mean, interval and p-value of each metric."""
    own = [scores[method] for scores in results]
    return {
        other: {metric: difference(own, [scores[other] for scores in results], metric) for metric in METRICS}
        for other in results[0]
        if other != method
    }


def means(objects: Sequence[Scores], metrics: Iterable[str] = METRICS) -> dict[str, Any]:
    """Mean of each metric over all images, and its interval, None where there is no number."""
    row: dict[str, Any] = {}
    for metric in metrics:
        values = [scores[metric] for scores in objects if metric in scores]
        found = bool(values) and not np.isnan(np.concatenate(values)).all()
        row[metric] = float(np.nanmean(np.concatenate(values))) if found else None
        row[f"{metric}_interval"] = interval(values) if found else None
    return row


def difference(first: Sequence[Scores], second: Sequence[Scores], metric: str) -> dict[str, Any] | None:
    """Scores of objects minus others of the same ones, view by view: mean, interval, p-value; None without a view."""
    from scipy.stats import permutation_test  # here, so that importing the package stays light

    if metric not in first[0] or metric not in second[0]:
        return None
    changes = [np.subtract(a[metric], b[metric], dtype=np.float64) for a, b in zip(first, second, strict=True)]
    sums, counts = _by_object(changes)
    if not len(sums):
        return None
    p_value = None
    if len(sums) > 1:
        generator = np.random.default_rng(SEED)
        given = (sums, np.zeros_like(sums))  # to exchange the two is to change the sign of their difference
        options = {"permutation_type": "samples", "n_resamples": RESAMPLES, "vectorized": True, "rng": generator}
        p_value = float(permutation_test(given, lambda x, y, axis: np.sum(x - y, axis=axis), **options).pvalue)
    return {"mean": float(sums.sum() / counts.sum()), "interval": interval(changes), "p_value": p_value}


def interval(scores: Sequence[np.ndarray]) -> list[float] | None:
    """Ends of the bootstrap interval of the mean over all views; None of fewer than FEWEST_OBJECTS with a score."""
    from scipy.stats import bootstrap

    sums, counts = _by_object(scores)
    if len(sums) < FEWEST_OBJECTS:
        return None
    found = bootstrap(
        (sums, counts),
        lambda x, n, axis: x.sum(axis=axis) / n.sum(axis=axis),
        paired=True,
        vectorized=True,
        n_resamples=RESAMPLES,
        confidence_level=confidence_level(len(sums)),
        method="percentile",
        rng=np.random.default_rng(SEED),
    )
    return [float(end) for end in found.confidence_interval]


def confidence_level(objects: int) -> float:
    """Level of the percentile bootstrap that is exact for the mean of so many normal scores: LEVEL of infinitely many.

    The bootstrap's spread is sqrt((n - 1) / n) times the standard error, and its shape normal instead of Student's t.
    """
    from scipy.stats import norm, t

    quantile = np.sqrt(objects / (objects - 1)) * t.ppf((1 + LEVEL) / 2, objects - 1)
    return float(2 * norm.cdf(quantile) - 1)


def _by_object(scores: Sequence[np.ndarray]) -> tuple[Float[np.ndarray, " objects"], Int[np.ndarray, " objects"]]:
    """Sum and number of the scores of each object that has any, sorted."""
    pairs = sorted((float(np.nansum(x, dtype=np.float64)), int(np.sum(~np.isnan(x)))) for x in scores)
    sums, counts = (np.array(column) for column in zip(*pairs, strict=True))
    return sums[counts > 0], counts[counts > 0]
