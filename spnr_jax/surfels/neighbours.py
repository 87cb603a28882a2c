"""The nearest points of each point, and what follows from them alone; blocks of points bound the memory.

NumPy in, NumPy out; neighbours come from SciPy's k-d tree.  Lengths are in units of the box, or in spacings.  The
points of a block are the last axis of its arrays, so passes run along memory; arrays of all points are (points, ...).
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
BLOCK = 2**11  # points that are worked on at once: they stay in a core's cache
THREADS = 2  # four wait for Python's lock


class Near(NamedTuple):
    """Neighbours of a block of points: which points these are, their neighbours' numbers, distances, the way there."""

    rows: slice
    number: Int[np.ndarray, "k block"]
    distance: Float[np.ndarray, "k block"]
    offset: Float[np.ndarray, "3 k block"]


def in_order_of_space(positions: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
    """Numbers of the points, close ones after each other: caches hold the neighbours of a block that is so ordered."""
    return cKDTree(positions).indices


def neighbourhoods(positions: Float[np.ndarray, "points 3"]) -> list[Near]:
    """The neighbours of all points, block by block."""
    tree, columns = cKDTree(positions), np.ascontiguousarray(positions.T)

    def of_block(first: int) -> Near:
        rows = slice(first, min(first + BLOCK, len(positions)))
        found = tree.query(positions[rows], min(NEIGHBOURS, len(positions)))
        distance, number = (x.reshape(rows.stop - first, -1).T for x in found)
        number = number.astype(np.int32, order="C")
        offset = np.take(columns, number, axis=1) - columns[:, None, rows]
        return Near(rows, number, distance.astype(np.float32, order="C"), offset)

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
    count = min(FIRST_DISC, len(near.number) - 1)
    if count == 0:  # a single point stands for a tenth of the box
        return np.full(near.number.shape[1], ALONE, np.float32)
    return np.maximum((np.pi / count) ** 0.5 * near.distance[count], LEAST_SPACING)


def close(near: Near, spacing: np.ndarray) -> np.ndarray:
    """Weights of the neighbours by their distance."""
    return np.exp(near.distance**2 * (-0.5 / (REACH * spacing) ** 2))


def around(near: Near, vectors: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "3 k block"]:
    """Vectors of the neighbours from those of all points, which are stored component by component."""
    assert vectors.flags.f_contiguous
    return np.take(vectors.T, near.number, axis=1)


def along(vectors: Float[np.ndarray, "3 k block"], axis: Float[np.ndarray, "3 block"]) -> Float[np.ndarray, "k block"]:
    """Components of the vectors along one axis for each point."""
    return np.einsum("ikn,in->kn", vectors, axis)


def frame(normal: Float[np.ndarray, "3 block"]) -> Float[np.ndarray, "3 3 block"]:
    """Two tangents and the normal, component by component."""
    return np.array([*(axis.T for axis in tangents(normal.T)), normal])


def covariance(near: Near, weight: np.ndarray) -> Float[np.ndarray, "3 3 block"]:
    """Of the weighted neighbours; of float64."""
    weight = weight / np.maximum(weight.sum(axis=0), 1e-9)
    centred = near.offset - np.einsum("kn,ikn->in", weight, near.offset)[:, None]
    return np.einsum("ikn,jkn->ijn", weight * centred, centred).astype(np.float64)
