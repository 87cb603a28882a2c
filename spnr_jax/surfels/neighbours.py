"""The nearest points of each point, and what follows from them alone; blocks of points bound the memory.

NumPy in, NumPy out; neighbours come from SciPy's k-d tree.  Lengths are in units of the box, or in spacings.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from spnr_jax.surfels.visibility import tangents

NEIGHBOURS = 20  # of a point, itself among them
FIRST_DISC = 6  # neighbours within the disc whose area gives a first spacing
REACH = 1.2  # spacings, standard deviation of the weight of a neighbour's distance
LEAST_SPACING = 1e-5  # in units of the box, for points that coincide
ALONE = 0.1  # of the box, the spacing of a single point
BLOCK = 2**12  # points that are worked on at once: they stay in a core's cache
THREADS = 4


class Near(NamedTuple):
    """Neighbours of a block of points: which points these are, their neighbours' numbers, distances, the way there."""

    rows: slice
    number: Int[np.ndarray, "block k"]
    distance: Float[np.ndarray, "block k"]
    offset: Float[np.ndarray, "block k 3"]


def neighbourhoods(positions: Float[np.ndarray, "points 3"]) -> list[Near]:
    """The neighbours of all points, block by block."""
    tree = cKDTree(positions)

    def of_block(first: int) -> Near:
        own = positions[first : first + BLOCK]
        distance, index = tree.query(own, min(NEIGHBOURS, len(positions)))
        distance, index = (x.reshape(len(own), -1) for x in (distance, index))
        rows = slice(first, first + len(own))
        return Near(rows, index.astype(np.int32), distance.astype(np.float32), positions[index] - own[:, None])

    return each(of_block, range(0, len(positions), BLOCK))


def each(work: Callable[..., Any], *blocks: Iterable) -> list:
    """What the work gives for each block, in order; blocks are shared by the cores."""
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, *blocks))


def joined(work: Callable[..., Any], *blocks: Iterable) -> Any:
    """Arrays of all points from those that the work gives for blocks, or a tuple of arrays from tuples."""
    parts = each(work, *blocks)
    if isinstance(parts[0], tuple):
        return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))
    return np.concatenate(parts)


def first_spacing(near: Near) -> np.ndarray:
    """From the area of the disc that holds some neighbours, whatever layer they are on."""
    count = min(FIRST_DISC, near.number.shape[1] - 1)
    if count == 0:  # a single point stands for a tenth of the box
        return np.full(len(near.number), ALONE, np.float32)
    return np.maximum(np.sqrt(np.pi / count) * near.distance[:, count], LEAST_SPACING)


def close(near: Near, spacing: np.ndarray) -> np.ndarray:
    """Weights of the neighbours by their distance."""
    return np.exp(-0.5 * (near.distance / (REACH * spacing[:, None])) ** 2)


def in_plane(near: Near, normal: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates of the neighbours along two tangents and the normal, in spacings."""
    scaled = near.offset / spacing[:, None, None]
    one, two, three = (np.einsum("nki,ni->nk", scaled, axis) for axis in (*tangents(normal), normal))
    return one, two, three


def spread(near: Near, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variances, rising, and axes of the weighted neighbours."""
    weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    centred = near.offset - np.einsum("nk,nki->ni", weight, near.offset)[:, None]
    return np.linalg.eigh(np.einsum("nk,nki,nkj->nij", weight, centred, centred, optimize=True))
