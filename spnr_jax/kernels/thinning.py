"""Fewer points that still cover the shape evenly: a random sample while reading, voxels, then farthest points.

A voxel keeps the first of its points in the order of the file.  Voxels are halved around a fixed corner, so that the
result depends on the points and their order alone.  Memory and time of the farthest points are bounded by thinning with
voxels first.
"""

from collections.abc import Iterable

import numpy as np
from scipy.spatial import cKDTree

Columns = dict[str, np.ndarray]

THINNING = 16  # farthest-point sampling starts from at most this many times the points that it keeps
INNER = (0.05, 0.95)  # quantiles along each axis between which the extent of a cloud is measured: outliers do not count
HALVINGS = 20  # of the extent, to the smallest voxel that is tried
SMALLEST_EXTENT = 1e-30  # where all points coincide
FARTHEST = 1e18  # from the middle, in the file's units, up to which distances are squared as they are
FIRST = 256  # farthest points that are found among all; after them a new one is the nearest of few
FAR = 0.95  # of the largest squared distance, from which on points are looked at for the farthest
BEYOND = 1 + 1e-5  # times the distance within which points are asked for, whatever single precision makes of it
KEY_BITS = 21  # of a voxel's index along an axis
SCATTER = np.uint64(0x9E3779B97F4A7C15)  # odd, 2^64 over the golden ratio: multiples of it are spread over 0..2^64 - 1


def sample_stream(pieces: Iterable[Columns], most: int) -> tuple[Columns, int]:
    """Columns of at most `most` rows of all pieces, each with the same chance, and how many rows there are.

    All where there are no more, else at least half as many.  Whether a row is kept depends on its number alone, and no
    more than the kept rows and one piece are in memory.
    """
    kept: Columns = {}
    keys, seen, halvings = np.zeros(0, np.uint64), 0, 0
    for piece in pieces:
        rows = np.arange(seen + 1, seen + 1 + len(piece["x"]), dtype=np.uint64) * SCATTER
        seen += len(rows)
        if halvings:
            piece, rows = _rows_below(piece, rows, halvings)
        kept = {name: np.concatenate([kept[name], piece[name]]) for name in piece} if kept else dict(piece)
        keys = np.concatenate([keys, rows])
        while len(keys) > most:
            halvings += 1
            kept, keys = _rows_below(kept, keys, halvings)
    return kept, seen


def _rows_below(columns: Columns, keys: np.ndarray, halvings: int) -> tuple[Columns, np.ndarray]:
    """Columns and keys of the rows whose key is in the lowest 1 / 2^halvings of all numbers."""
    taken = keys >> np.uint64(64 - halvings) == 0
    return {name: values[taken] for name, values in columns.items()}, keys[taken]


def stacked(columns: Columns) -> np.ndarray:
    """Positions (points, 3) float64 of columns x, y, z."""
    return np.stack([np.asarray(columns[axis], np.float64) for axis in "xyz"], axis=-1)


def first_in_voxels(positions: np.ndarray, voxel: float) -> np.ndarray:
    """Sorted indices of the first point of positions (n, 3) in each cube of side `voxel`."""
    return np.sort(np.unique(voxel_keys(positions, voxel), return_index=True)[1])


def voxel_keys(positions: np.ndarray, voxel: float) -> np.ndarray:
    """A number for each of positions (n, 3), the same for those in one cube of side `voxel`.

    What lies more than 2^20 voxels from 0 falls into the outermost ones.
    """
    half = 2.0 ** (KEY_BITS - 1)
    x, y, z = (np.clip(np.floor(positions.T / voxel), -half, half - 1) + half).astype(np.int64)
    return (x << 2 * KEY_BITS) | (y << KEY_BITS) | z


def frame(positions: np.ndarray) -> tuple[np.ndarray, float]:
    """Corner (3,) and side of a cube that holds most of the positions (n, 3)."""
    low, high = np.quantile(positions, INNER, axis=0)
    return low, max(float((high - low).max()), SMALLEST_EXTENT)


def candidates(positions: np.ndarray, count: int) -> np.ndarray:
    """Sorted indices of at most THINNING * count points, at least `count`: those of the finest voxels that fit.

    Points that coincide share every voxel; where voxels leave too few, the first others are added.
    """
    if len(positions) <= THINNING * count:
        return np.arange(len(positions))
    corner, extent = frame(positions)
    chosen = np.arange(1)
    for halving in range(HALVINGS):
        finer = first_in_voxels(positions - corner, extent / 2**halving)
        if len(finer) > THINNING * count:
            break
        chosen = finer
    missing = max(0, count - len(chosen))
    others = np.setdiff1d(np.arange(len(positions)), chosen)[:missing] if missing else chosen[:0]
    return np.sort(np.concatenate([chosen, others]))


def farthest_points(positions: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Indices (count,) of points (n, 3), each the farthest from those before it; n >= count.

    So any first ones of them are evenly spread.  The seed chooses the very first; of points equally far the first in
    the file comes first.  Beyond THINNING * count points voxels thin them before: the time is near count log count.
    """
    among = candidates(positions, count)
    centred = positions[among] - positions.mean(axis=0)
    largest = np.abs(centred).max(initial=0)
    if largest > FARTHEST:  # else the squares leave float32
        centred = centred / largest
    columns = np.ascontiguousarray(centred.T, np.float32)
    squared = np.full(len(among), np.inf, np.float32)
    chosen = np.empty(count, np.int64)
    chosen[0] = np.random.default_rng(seed).integers(len(among))
    for step in range(1, min(count, FIRST)):
        last = chosen[step - 1]
        np.minimum(squared, _squares(columns, columns[:, last]), out=squared)
        squared[last] = -1
        chosen[step] = np.argmax(squared)
    if count > FIRST:
        _go_on(chosen, columns, squared)
    return among[chosen]


def _squares(columns: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Squared distances (n,) of points, as columns (3, n), from a place (3,)."""
    (x, y, z), (a, b, c) = columns, place
    return (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2


def _go_on(chosen: np.ndarray, columns: np.ndarray, squared: np.ndarray) -> None:
    """Chooses points from FIRST on: a new point changes the distances of those alone that are nearer to it than it was
    to the ones before.

    Distances only shrink, so while one of the far points is still far, the farthest of all is among them.
    """
    rows = np.ascontiguousarray(columns.T)
    tree = cKDTree(rows)
    far, least = np.arange(0), np.inf
    for step in range(FIRST, len(chosen)):
        last = chosen[step - 1]
        reach = max(float(squared[last]), 0.0) ** 0.5
        near = np.array(tree.query_ball_point(rows[last], BEYOND * reach), np.int64)
        squared[near] = np.minimum(squared[near], _squares(columns[:, near], rows[last]))
        squared[last] = -1  # never again, not even where points coincide
        among = squared[far]
        if not (among >= least).any():
            least = FAR * squared.max()
            if least == 0:  # what is left coincides with what is chosen
                chosen[step:] = np.flatnonzero(squared == 0)[: len(chosen) - step]
                return
            far = np.flatnonzero(squared >= least)
            among = squared[far]
        chosen[step] = far[np.argmax(among)]
