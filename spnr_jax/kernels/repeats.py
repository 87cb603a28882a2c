"""Points that say the same twice: equal and nearly equal ones are merged, and what then is no surface is refused.

Nearly equal are points within NEAR of the median spacing.  The spacing is told by many neighbours, so that a scan
written out several times does not hide it.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError

Values = dict[str, np.ndarray]
NEAR = 1e-3  # of the median spacing
AROUND, SAMPLE = 128, 1024  # neighbours that tell the spacing, at so many points
FEW = 8  # distinct points, of which a spacing says nothing
PLACE = 1e-6  # of the extent: what lies closer is one place
LINE = 1e-13  # of the variance along a line, that there may be across it
CANCELLED = 0.5  # length of a mean of unit normals below which they contradict each other


def merge_repeats(positions: Float[np.ndarray, "points 3"], values: Values) -> tuple[np.ndarray, Values, int]:
    """The points without repeats, the means of their other columns (points, ...), and how many were merged.

    Of points that are merged the first stays where it is; a cloud without repeats comes back itself.
    """
    labels = _labels(positions)
    _, first, group = np.unique(labels, return_index=True, return_inverse=True)
    merged = len(positions) - len(first)
    if not merged:
        return positions, values, 0
    kept = np.sort(first)
    values = {name: _means(column, group)[group[kept]] for name, column in values.items()}
    if "normals" in values:
        values["normals"] = unit_means(values["normals"])
    return positions[kept], values, merged


def unit_means(normals: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Means of unit normals at length 1, 0 where these contradict each other."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > CANCELLED, normals / np.maximum(length, CANCELLED), 0)


def _labels(positions: np.ndarray) -> np.ndarray:
    """A number (points,) for each place; the same for points that are equal or nearly so."""
    distinct, rows = find_distinct(positions)
    if len(distinct) < FEW:
        return rows
    tree = cKDTree(distinct)
    pairs = tree.query_pairs(NEAR * spacing(tree), output_type="ndarray")
    if not len(pairs):
        return rows
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(distinct),) * 2)
    return connected_components(graph, directed=False)[1][rows]


def find_distinct(
    positions: Float[np.ndarray, "points 3"],
) -> tuple[Float[np.ndarray, "places 3"], Int[np.ndarray, " points"]]:
    """Positions without repetitions, sorted, which also keeps neighbours close in memory; the row of each."""
    order = np.lexsort(positions.T)
    ranked = positions[order]
    new = np.ones(len(ranked), bool)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    rows = np.empty(len(ranked), np.int64)
    rows[order] = np.cumsum(new) - 1
    return ranked[new], rows


def spacing(tree: cKDTree) -> float:
    """Median side of the square that a point stands for, from the distance of many neighbours."""
    count = max(2, min(AROUND, tree.n // 4))
    radius = tree.query(tree.data[:: -(-tree.n // SAMPLE)], [count])[0]
    return float(np.median(radius)) * float(np.sqrt(np.pi / count))


def _means(column: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Means (groups, ...) of the rows of each group."""
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    counts = np.diff(np.append(starts, len(group)))
    sums = np.add.reduceat(np.asarray(column, np.float64)[order], starts, axis=0)
    return sums / counts.reshape(-1, *(1,) * (column.ndim - 1))


def require_surface(positions: Float[np.ndarray, "points 3"], before: int) -> None:
    """ValueError where points (n, 3), of which there were `before`, are no surface: one place, two, or a line."""
    extent = float(np.ptp(positions, axis=0).max())
    steps = np.round((positions - positions.min(axis=0)) / max(PLACE * extent, np.finfo(np.float64).tiny))
    places = 1 if extent == 0 else len(np.unique(steps, axis=0)) if len(positions) < FEW**4 else FEW
    if places < 3:
        raise UserError(f"holds {before} points in {places} place{'s' * (places > 1)}: no object can be drawn")
    centred = (positions - positions.mean(axis=0)) / extent
    variance = np.linalg.eigvalsh(centred.T @ centred)
    if variance[1] < LINE * variance[2]:
        raise UserError(f"holds {before} points on one straight line: no object can be drawn")
