"""Normals of the points that are kept of a dense cloud, from all of it: thinned points alone know them worse."""

import numpy as np
from jaxtyping import Float, Int

from spnr_jax.kernels.cleaning import Cleaned
from spnr_jax.kernels.facing import planes
from spnr_jax.kernels.records import PointCloud
from spnr_jax.surfels import layers, sheets, sides
from spnr_jax.surfels.neighbours import each, first_spacing, joined, neighbourhoods

VOTERS = 2**15  # points that votes are taken of, those that are kept among them


def thinned(points: Cleaned, kept: Int[np.ndarray, " points"]) -> PointCloud:
    """The points of these numbers, (points, ...) float32; with normals from all where the columns have none.

    Where all are kept normals are not looked for: what draws the cloud estimates them from the same points.
    """
    values = {name: column[kept] for name, column in points.values.items()}
    if "normals" not in values and len(kept) < len(points.positions):
        values["normals"] = outward_normals(points.positions, points.values["base_color"], kept, points.noise)
    columns = {name: np.asarray(column, np.float32) for name, column in values.items()}
    positions = points.positions[kept].astype(np.float32)
    return PointCloud(positions=positions, mask=np.ones(len(kept), bool), **columns)


def outward_normals(
    positions: Float[np.ndarray, "all 3"],
    base_color: Float[np.ndarray, "all 3"],
    kept: Int[np.ndarray, " points"],
    noise: float = 0.0,
) -> Float[np.ndarray, "points 3"]:
    """Unit normals of the points of these numbers; outward by the votes of directions and walls (sides.py).

    Linear colours tell sheets apart that nearly touch; `noise` is that of `planes`.
    """
    rest = np.setdiff1d(np.arange(len(positions)), kept)
    others = max(0, VOTERS - len(kept))
    voters = np.concatenate([kept, np.random.default_rng(0).permutation(rest)[:others]])
    low, high = positions.min(axis=0), positions.max(axis=0)
    half = np.linalg.norm(high - low) / 2 or 1.0
    places = np.asarray((positions[voters] - (low + high) / 2) / half, np.float32)  # in the box
    normal = np.asfortranarray(planes(positions[voters], positions, noise), np.float32)
    near = neighbourhoods(places)
    raw = joined(first_spacing, near)
    color = np.asfortranarray(base_color[voters], np.float32)
    spacings, normals, unsided, firm = ([x] * len(near) for x in (raw, normal, False, True))
    layer = each(layers.fitted, near, spacings, normals, unsided, firm)
    layer = sheets.parted(near, layer, raw, color)
    return sides.outward(near, layer, raw, False, places, float(np.median(raw)))[0][: len(kept)]
