"""The nearest points of each point: topology, found once on the host by a k-d tree; data without a gradient."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from spnr_jax.kernels.records import PointCloud
from spnr_jax.surfels.rules import NEIGHBORS

BLOCK = 2**14  # points that are asked for at once


def neighbors(cloud: PointCloud) -> Int[np.ndarray, "*batch points 20"]:
    """Numbers of the 20 nearest points of each point, itself first; -1 where there are fewer, and of padding.

    NumPy on the host: cannot be traced.  Clouds may have leading batch axes.
    """
    positions, mask = np.asarray(cloud.positions), np.asarray(cloud.mask)
    found = np.full((*mask.shape, NEIGHBORS), -1, np.int32)
    for cloud_index in np.ndindex(mask.shape[:-1]):
        real = np.flatnonzero(mask[cloud_index])
        if len(real):
            near = nearest(positions[cloud_index][real])
            found[cloud_index][real] = np.where(near < 0, -1, real[near])
    return found


def nearest(positions: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, "points 20"]:
    """Numbers of the nearest of real points, -1 where there are fewer; each point is its own first neighbor."""
    return _ask(cKDTree(positions), np.arange(len(positions)))


def order_in_space(
    positions: Float[np.ndarray, "points 3"],
) -> tuple[Int[np.ndarray, " points"], Int[np.ndarray, "points 20"]]:
    """An order of the points in which close ones follow each other, and the neighbors of the points so ordered.

    Caches hold what a block of points that are so ordered gathers.
    """
    tree = cKDTree(positions)
    order = tree.indices
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    near = _ask(tree, order)
    return order, np.where(near < 0, np.int32(-1), place[near])


def _ask(tree: cKDTree, asked: Int[np.ndarray, " some"]) -> Int[np.ndarray, "some 20"]:
    """Neighbors of the tree's points of these numbers, -1 for none; a point comes first among those at its place."""
    ranks = list(range(1, min(NEIGHBORS, tree.n) + 1))
    blocks = [asked[i : i + BLOCK] for i in range(0, len(asked), BLOCK)]
    found = np.concatenate([tree.query(tree.data[rows], ranks, workers=-1)[1].astype(np.int32) for rows in blocks])
    wrong = np.flatnonzero(found[:, 0] != asked)
    if len(wrong):
        own = found[wrong] == asked[wrong, None]
        lost = ~own.any(axis=1)  # among too many at its place
        own[lost, -1], found[wrong[lost], -1] = True, asked[wrong[lost]]
        found[wrong] = np.take_along_axis(found[wrong], np.argsort(~own, axis=1, kind="stable"), axis=1)
    return np.pad(found, [(0, 0), (0, NEIGHBORS - found.shape[1])], constant_values=-1)
