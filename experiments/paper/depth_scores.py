"""How wrong a depth map is: errors inside the true silhouette, what is missing there, and what floats outside.

A pixel of a method is opaque where its opacity is above a half, and lies in the silhouette where the pixel's ray meets
the object.  Distances are along the rays, in half diagonals of the object's box.

error, median, bias   mean and median of |depth - truth|, and mean of depth - truth, where opaque in the silhouette
surface               as error, of the depth without the share of what shines through (`without_background`)
missed                share of the silhouette that is not opaque
floaters              opaque pixels outside the silhouette, for each 1000 pixels outside
far_floaters          the same, of those farther from it than 1/32 of the picture: not its blurred edge
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from spnr_jax.scoring.summary import means

OPAQUE = 0.5
EDGE = 1 / 32  # of the picture's width
METRICS = {  # head, decimals, and what the numbers are multiplied by
    "error": ("Mean error", 4, 1),
    "median": ("Median error", 4, 1),
    "bias": ("Mean signed error", 4, 1),
    "surface": ("Mean error of what is opaque", 4, 1),
    "missed": ("Missed, %", 2, 100),
    "floaters": ("Floaters, per 1000", 2, 1),
    "far_floaters": ("of them far, per 1000", 2, 1),
}

Maps = Float[np.ndarray, "views height width"]


def scores(depth: Maps, acc: Maps, far: Maps, truth: Maps) -> dict[str, np.ndarray]:
    """Each metric for each view (views,), NaN where there is nothing to measure; the truth is inf beside the object."""
    views = [score(*maps) for maps in zip(depth, acc, far, truth, strict=True)]
    return {name: np.array([view[name] for view in views]) for name in METRICS}


def score(depth: np.ndarray, acc: np.ndarray, far: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """The metrics of one view (height, width)."""
    inside, opaque = np.isfinite(truth), acc > OPAQUE
    both, outside = inside & opaque, np.sum(~inside)
    off = depth[both].astype(np.float64) - truth[both]
    surface = without_background(depth[both], acc[both], far[both])
    distant = distance_transform_edt(~inside) > EDGE * truth.shape[1] if inside.any() else ~inside
    return {
        "error": mean(np.abs(off)),
        "median": float(np.median(np.abs(off))) if off.size else np.nan,
        "bias": mean(off),
        "surface": mean(np.abs(surface - truth[both])),
        "missed": mean(~opaque[inside]),
        "floaters": 1000 * float(np.sum(opaque & ~inside) / outside) if outside else np.nan,
        "far_floaters": 1000 * float(np.sum(opaque & distant) / outside) if outside else np.nan,
    }


def without_background(depth: np.ndarray, acc: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Mean distance of what stops the ray, where the opacity is above 0.

    A rendered depth (`compositing.expected_distance`) counts the light that nothing stops at the far side of the box.
    """
    return (depth.astype(np.float64) - (1 - acc) * far) / acc


def mean(values: np.ndarray) -> float:
    """The mean, NaN of nothing."""
    return float(np.mean(values)) if values.size else np.nan


def summarise(objects: Sequence[dict[str, np.ndarray]]) -> dict[str, dict]:
    """Mean of each metric over all views, with its bootstrap interval over objects; None where nothing was measured."""
    found = means(objects, METRICS)
    return {name: {"mean": found[name], "interval": found[f"{name}_interval"]} for name in METRICS}
