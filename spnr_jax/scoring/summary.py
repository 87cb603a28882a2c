"""Scores of methods on objects as tables: means with intervals, and differences on the same objects.

Means are over images.  A condition PSNR leaves out images in which no input point is visible and counts the others.
None stands where there is no number: a metric that was not measured, an interval from a single object.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from spnr_jax.scoring import intervals
from spnr_jax.scoring.flip import PIXELS_PER_DEGREE

METRICS = ("psnr", "ssim", "cpsnr", "flip", "lpips", "iou")
NO_WEIGHTS = "n/a (no weights)"  # what stands instead of an LPIPS that cannot be measured

Scores = dict[str, np.ndarray]  # metric -> score of each view (views,); cpsnr is NaN where no point is visible


def metric_settings(with_lpips: bool) -> dict[str, str]:
    """What stands beside every table: how its numbers were measured."""
    return {
        "images": "sRGB in [0, 1] over white; means over images",
        "PSNR": "at most 100 dB; cPSNR over the pixels of visible input points, images without any left out",
        "SSIM": "Gaussian window, sigma 1.5, as scikit-image",
        "FLIP": f"LDR, {PIXELS_PER_DEGREE:.2f} pixels per degree, mean of the error map",
        "LPIPS": "AlexNet v0.1, images on [-1, 1]" if with_lpips else NO_WEIGHTS,
        "intervals": f"{100 * intervals.LEVEL:.0f} %, bootstrap over objects, {intervals.RESAMPLES} resamples",
    }


def summarise(results: Sequence[dict[str, Scores]]) -> dict[str, dict]:
    """Mean of each metric over all images of each method, its interval, and the counts behind them."""
    return {method: _row([scores[method] for scores in results]) for method in results[0]}


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
        row[f"{metric}_interval"] = _as_list(intervals.interval(values)) if found else None
    return row


def _row(objects: list[Scores]) -> dict[str, Any]:
    visible = np.concatenate([scores["cpsnr"] for scores in objects])
    counts = {"objects": len(objects), "views": len(visible), "cpsnr_views": int(np.sum(~np.isnan(visible)))}
    return means(objects) | counts


def difference(first: Sequence[Scores], second: Sequence[Scores], metric: str) -> dict[str, Any] | None:
    """Scores of objects minus others of the same ones, view by view: mean, interval, p-value; None without a view."""
    if metric not in first[0] or metric not in second[0]:
        return None
    found = intervals.difference([scores[metric] for scores in first], [scores[metric] for scores in second])
    if found is None:
        return None
    return {"mean": found.mean, "interval": _as_list(found.interval), "p_value": found.p_value}


def _as_list(interval: tuple[float, float] | None) -> list[float] | None:
    """An interval as JSON has it."""
    return None if interval is None else list(interval)
