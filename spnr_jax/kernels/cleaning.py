"""Cleaning of scans: outliers are removed, noisy points are averaged; clean clouds are unchanged.

    outliers    score: the mean distance of a point to its neighbours over the median of its neighbours' mean distances,
                as in the local outlier factor (Breunig et al. 2000), so that smoothly varying density removes nothing.
                The limit is robust: a multiple of the median absolute deviation (MAD), and never below a fixed ratio
    noise       distance of the neighbours from the plane that most of them are close to (least quantile of squares,
                Rousseeuw 1984).  At an edge or a thin wall, that plane is one of the faces, so neither counts as noise.
                The noise is that of a noisy plane with the same distances.  In thick noise the neighbourhood grows
    averaging   each point moves to its most likely true position, and then along the normal onto the plane of the
                points around it (moving least squares, Alexa et al. 2001), within a radius that depends on the noise.
                Only points of similar colour count (Tomasi & Manduchi 1998), so that letters stay and two layers do not
                merge.  Materials become the mean over the points that are then close.  The true position is given by
                Tweedie's formula (Efron 2011): x + sigma^2 times the gradient of the log density.  That gradient is
                C^-1 (m - x), with mean m and covariance C of the points in a window around x (Hjort & Jones 1996).  A
                plane becomes flat, and a thin bar keeps its thickness
    fringe      remaining noise is removed where sparse points lie beside dense ones

NumPy in, NumPy out, nearly linear in the number of points; the order of the points does not matter.
"""

import dataclasses
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError
from spnr_jax.kernels.cloud_arrays import Columns, check_cloud_kind, find_distinct, unit_means, voxel_keys
from spnr_jax.kernels.records import PointCloud

Strength = Literal["auto", "strong"]
Clean = Literal["auto", "off", "strong"]

LEAST_POINTS = 100  # with fewer points, outliers cannot be told from the surface
NEIGHBORS = 8  # whose mean distance is a point's score
SPARSE = 3.0  # times the median score: above it, the neighbours may be outliers themselves
WIDE = 64  # neighbours considered in that case
# a point is in a volume if more than this share of the variance of its 16 neighbours is along their narrowest axis
ROUND = 16, 0.05
MOST_ROUND = 0.1  # sparse points in a volume are outliers, unless they are more than this share of all points
UNLISTED = 0.6  # factor on the limit for a point that is not a neighbour of any other
FEW, CHANCE = 4, 3e-4  # number and share of points that random sampling may isolate
SURE = 2.0  # factor on the limit above which even these are outliers
ROUNDS = 3  # repeated, because outliers hide others behind them
DEVIATIONS = {"auto": 7.0, "strong": 5.0}  # limit in standard deviations (from the MAD) of the logarithm of the score
LEAST_RATIO = {"auto": 2.0, "strong": 1.6}  # the limit on the score is never below this: corners reach it
LEAST_DENSE = 1500  # points; with fewer, curvature would count as noise, and a bar as points in space
NOISY = {"auto": 0.45, "strong": 0.25}  # spacings of noise above which points are averaged
SAMPLE = 2048  # points at which the noise is measured
PLANES = 48  # candidate planes, each through three neighbours
HEIGHTS = 32  # neighbours whose heights above a plane are measured
SHARE = 0.35  # quantile of the heights that the best plane minimises
FLATTEST = 0.25  # share of the places from which the noise is estimated: elsewhere edges and thin walls add to it
# calibration on simulated noisy planes: deviation of the noise over the neighbourhood's radius -> largest height above
# the best plane over the radius; it saturates, because a thick layer looks like a ball
NOISES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)
THICKNESS = (0.0, 0.012, 0.024, 0.0355, 0.047, 0.0556, 0.0624, 0.0681, 0.0726, 0.0766, 0.0798, 0.0822, 0.0836)
THICKEST = 0.08  # of a neighbourhood that determines the noise; thicker ones are enlarged
WIDER, MOST_WIDE = 2, 16  # factor on the number of neighbours; upper bound as a share of all points
RADIUS = 1.0  # standard deviation of a neighbour's weight over that of the noise; wider ones erode thin parts
LEAST_RADIUS = 1.0  # the same in spacings, at least
AROUND = 64  # points in a local fit
ALIKE, COLOR_NOISE = 0.1, 2.0  # standard deviation of the weight by colour (square roots): least, over the noise
MEAN, MEANT = 0.7, 32  # radius of the mean of the materials, over the noise or the spacing; points in it
ROWS = 2**13  # points that are moved at a time: their neighbours fit into the cache
CELL = 1.0, 3.0  # side of a voxel for the fringe: the larger of these standard deviations of the noise and spacings
CELLS = 27  # neighbouring voxels that are compared
THIN = 0.3  # a voxel is fringe with fewer points than this share of the mean in the voxels of its neighbours
MOST_MOVED = 2**17  # points that are moved; of more points, a part


class Cleaned(NamedTuple):
    """The remaining points and their other columns; one line per change; the standard deviation of the removed noise.

    `noise` is in the units of the positions, 0 where no points were averaged.
    """

    positions: Float[np.ndarray, "left 3"]
    values: Columns
    lines: list[str]
    noise: float


def clean(cloud: PointCloud, strength: Strength = "auto") -> tuple[PointCloud, list[str]]:
    """The cloud without outliers and, where it is noisy, averaged; and one line per change.

    A clean cloud is returned unchanged; otherwise masked points are dropped, too.  "strong" removes and averages at
    smaller deviations.  ValueError for a batch of clouds or an unknown strength.
    """
    if strength not in NOISY:
        raise UserError(f"strength must be one of {', '.join(NOISY)}, got {strength!r}")
    check_cloud_kind(cloud, "clean")
    if np.ndim(cloud.positions) != 2:
        raise UserError(f"clean takes one cloud, positions (points, 3); got shape {np.shape(cloud.positions)}")
    real = np.asarray(cloud.mask)
    columns = {name: np.asarray(x)[real] for name, x in vars(cloud).items() if x is not None and name != "mask"}
    positions, values, lines, _ = clean_columns(columns.pop("positions"), columns, strength)
    if not lines:
        return cloud, []
    values = {name: np.asarray(x, np.float32) for name, x in (values | {"positions": positions}).items()}
    return dataclasses.replace(cloud, mask=np.ones(len(positions), bool), **values), lines


def clean_columns(positions: Float[np.ndarray, "points 3"], values: Columns, strength: Strength = "auto") -> Cleaned:
    """Points and other columns (points, ...) without outliers, and averaged; clean columns are not copied."""
    lines = []
    outlier = find_outliers(positions, strength)
    if outlier.any():
        lines.append(f"removed {outlier.sum():,} outliers of {len(positions):,} points")
        positions, values = positions[~outlier], {name: x[~outlier] for name, x in values.items()}
    sigma, spacing = measure_noise(positions)
    averages = bool(sigma > NOISY[strength] * spacing > 0)
    if averages:
        before = len(positions)
        positions, values = denoise(positions, values, sigma, spacing)
        kept = ~find_fringe(positions, max(CELL[0] * sigma, CELL[1] * spacing))
        positions, values = positions[kept], {name: x[kept] for name, x in values.items()}
        lines.append(f"averaged {before:,} points to {len(positions):,}: noise of {sigma / spacing:.1f} spacings")
    return Cleaned(positions, values, lines, sigma if averages else 0.0)


def find_outliers(positions: Float[np.ndarray, "points 3"], strength: Strength = "auto") -> Bool[np.ndarray, " points"]:
    """True for points that are much farther from their neighbours than their neighbours are from theirs."""
    distinct, copies = find_distinct(positions)
    left = np.arange(len(distinct))
    if len(left) >= LEAST_POINTS:
        tree = cKDTree(distinct)
        distances, near = tree.query(distinct, NEIGHBORS + 1, workers=-1)
    for _ in range(ROUNDS):
        if len(left) < LEAST_POINTS:
            break
        outlier = _is_outlier(tree, distances[:, 1:], near[:, 1:], strength)
        if not outlier.any():
            break
        left, tree = left[~outlier], cKDTree(distinct[left[~outlier]])
        distances, near = _drop_points(outlier, tree, distances, near)
    removed = np.ones(len(distinct), bool)
    removed[left] = False
    return removed[copies]


def _drop_points(
    outlier: np.ndarray, tree: cKDTree, distances: np.ndarray, near: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances and rows of the neighbours of all remaining points, themselves first; the tree holds these points."""
    distances, near = distances[~outlier], near[~outlier]
    lost = outlier[near].any(axis=1)
    near = (np.cumsum(~outlier) - 1)[near]
    if lost.any():
        distances[lost], near[lost] = tree.query(tree.data[lost], near.shape[1], workers=-1)
    return distances, near


def _is_outlier(tree: cKDTree, distances: np.ndarray, near: np.ndarray, strength: Strength) -> np.ndarray:
    """Mask (n,) of outliers among distinct points (n, 3), n >= LEAST_POINTS, from their neighbours (n, NEIGHBORS)."""
    positions = tree.data
    mean = distances.mean(axis=1)
    expected = np.median(mean[near], axis=1)
    sparse = np.flatnonzero(mean > SPARSE * np.median(mean))
    around = tree.query(positions[sparse], min(WIDE, len(positions)), workers=-1)[1]
    expected[sparse] = np.minimum(expected[sparse], np.median(mean[around], axis=1))
    score = np.log(mean / expected)
    middle = np.median(score)
    deviation = 1.4826 * np.median(np.abs(score - middle))  # of a normal distribution with this MAD
    unlisted = np.bincount(near.ravel(), minlength=len(positions)) == 0
    limit = np.where(unlisted, UNLISTED, 1.0) * max(DEVIATIONS[strength] * deviation, np.log(LEAST_RATIO[strength]))
    outlier = score > middle + limit
    if outlier.sum() <= FEW + CHANCE * len(positions):
        outlier = score > middle + SURE * limit
    in_space = sparse[_measure_thickness(positions[around[:, : ROUND[0]]]) > ROUND[1]]
    if len(positions) >= LEAST_DENSE and len(in_space) <= MOST_ROUND * len(positions):
        outlier[in_space] = True
    return outlier


def _measure_thickness(near: np.ndarray) -> np.ndarray:
    """Share (n,) of the variance of points (n, k, 3) along their narrowest axis: 0 for a plane, 1/3 for a ball."""
    offset = near - near.mean(axis=1, keepdims=True)
    squared = np.linalg.eigvalsh(np.swapaxes(offset, 1, 2) @ offset)
    return squared[:, 0] / np.maximum(squared.sum(axis=1), np.finfo(np.float64).tiny)


def measure_noise(positions: Float[np.ndarray, "points 3"]) -> tuple[float, float]:
    """Standard deviation of the points' heights above their surface, and their spacing; (0, 0) for too few points.

    Below LEAST_DENSE points, noise cannot be told from curvature.  In the units of the positions.
    """
    distinct, _ = find_distinct(positions)
    if len(distinct) < LEAST_DENSE:
        return 0.0, 0.0
    tree = cKDTree(distinct)
    sample = distinct[:: -(-len(distinct) // SAMPLE)]
    count = HEIGHTS
    while True:
        distances, near = tree.query(sample, [1 + count * i // HEIGHTS for i in range(1, HEIGHTS + 1)], workers=-1)
        radius = float(np.median(distances[:, -1]))
        thickness = float(np.quantile(_measure_heights(distinct[near]), FLATTEST)) / radius
        if thickness < THICKEST or MOST_WIDE * count > len(distinct):
            return radius * float(np.interp(thickness, THICKNESS, NOISES)), radius * np.sqrt(np.pi / (count + 1))
        count *= WIDER


def _measure_heights(near: np.ndarray) -> np.ndarray:
    """Height (n,) within which SHARE of the neighbours (n, HEIGHTS, 3) lie of the best plane through three."""
    rng = np.random.default_rng(0)
    best = np.full(len(near), np.inf)
    for a, b, c in (rng.choice(HEIGHTS, 3, replace=False) for _ in range(PLANES)):
        normal = np.cross(near[:, b] - near[:, a], near[:, c] - near[:, a])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = normal / np.where(length > 0, length, np.inf)
        offset = np.abs(np.einsum("nkc,nc->nk", near - near[:, a, None], normal))
        reach = np.partition(offset, int(SHARE * HEIGHTS), axis=1)[:, int(SHARE * HEIGHTS)]
        best = np.where(length[:, 0] > 0, np.minimum(best, reach), best)
    return np.where(np.isfinite(best), best, 0)  # three collinear neighbours span no plane


def denoise(
    positions: Float[np.ndarray, "points 3"], values: Columns, sigma: float, spacing: float
) -> tuple[Float[np.ndarray, "moved 3"], Columns]:
    """Points moved to remove noise of this standard deviation, at most MOST_MOVED, and the local means of their values.

    Normals keep unit length, or are 0 where they contradict each other.
    """
    radius = max(RADIUS * sigma, LEAST_RADIUS * spacing)
    order = np.lexsort(positions.T)  # a part is then spread over the cloud, and independent of the order of the points
    within = 2 * np.pi * (radius / spacing) ** 2  # points whose weight counts
    basis, rows = order[:: max(1, int(within / AROUND))], order[:: -(-len(order) // MOST_MOVED)]
    start, known = positions[rows].astype(np.float64), positions[basis].astype(np.float64)
    color = np.sqrt(np.maximum(values.get("base_color", np.zeros((len(positions), 1))), 0))
    tree, own, others = cKDTree(known), color[rows], color[basis]
    color_sigma = _choose_color_sigma(tree, others)

    def moved_of(piece: slice) -> np.ndarray:
        return _denoise_step(start[piece], own[piece], tree, others, sigma, radius, color_sigma)

    moved = np.concatenate([moved_of(slice(i, i + ROWS)) for i in range(0, len(start), ROWS)])
    means = _local_means(moved, {name: column[rows] for name, column in values.items()}, MEAN * max(sigma, spacing))
    if "normals" in means:
        means["normals"] = unit_means(means["normals"])
    return moved, means


def _choose_color_sigma(tree: cKDTree, color: np.ndarray) -> float:
    """Standard deviation of a neighbour's weight by colour: wider than the noise of the colours (n, channels)."""
    sample = slice(None, None, -(-tree.n // SAMPLE))
    near = tree.query(tree.data[sample], list(range(1, min(AROUND, tree.n) + 1)), workers=-1)[1]
    outlier = np.linalg.norm(color[near] - color[sample, None], axis=-1)
    return max(ALIKE, COLOR_NOISE * float(np.median(np.quantile(outlier, 0.25, axis=1))))


def _denoise_step(
    start: np.ndarray,
    own: np.ndarray,
    tree: cKDTree,
    color: np.ndarray,
    sigma: float,
    radius: float,
    color_sigma: float,
) -> np.ndarray:
    """Points (n, 3) after one step, from the points of similar colour around them."""

    def spread(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        near, weights = _query_neighbors(points, tree, radius, AROUND)
        weights *= np.exp(-0.5 * np.sum(((color[near] - own[:, None]) / color_sigma) ** 2, axis=-1))
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)
        return _find_local_axes(points, tree.data[near], weights)

    towards, squared, axes = spread(start)
    squared = np.maximum(squared, 1 / (1 / sigma**2 + 1 / radius**2))  # least variance of a window of pure noise
    moved = start + np.einsum("nij,nj->ni", axes, sigma**2 / squared * towards)
    towards, _, axes = spread(moved)
    return moved + towards[:, :1] * axes[..., 0]


def _local_means(positions: np.ndarray, columns: Columns, radius: float) -> Columns:
    """Local means of the columns, over the points around each position."""
    tree = cKDTree(positions)
    pieces = [_query_neighbors(positions[i : i + ROWS], tree, radius, MEANT) for i in range(0, len(positions), ROWS)]
    return {
        name: np.concatenate([np.einsum("nk,nk...->n...", weights, column[near]) for near, weights in pieces])
        for name, column in columns.items()
    }


def _query_neighbors(points: np.ndarray, tree: cKDTree, radius: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows (n, k) of at most `most` neighbours of points (n, 3), and their weights, which sum to 1."""
    distances, near = tree.query(points, list(range(1, min(most, tree.n) + 1)), workers=-1)
    weights = np.exp(-0.5 * (distances / radius) ** 2)
    return near, weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)


def _find_local_axes(
    points: np.ndarray, near: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offset to the mean of the neighbours (n, k, 3) along the axes of their covariance, the eigenvalues, the axes."""
    offset = near - points[:, None]
    mean = (weights[:, None] @ offset)[:, 0]
    offset = (offset - mean[:, None]) * np.sqrt(weights)[..., None]
    squared, axes = np.linalg.eigh(np.swapaxes(offset, 1, 2) @ offset)
    return np.einsum("nij,ni->nj", axes, mean), squared, axes


def find_fringe(positions: Float[np.ndarray, "points 3"], side: float) -> Bool[np.ndarray, " points"]:
    """True for points in voxels of this side that hold far fewer points than the voxels around them."""
    _, first, rows, count = np.unique(
        voxel_keys(positions - positions.min(axis=0), side), return_index=True, return_inverse=True, return_counts=True
    )
    centres = positions[first]
    near = cKDTree(centres).query(centres, list(range(1, min(CELLS, len(centres)) + 1)), workers=-1)[1]
    return (count < THIN * (count[near] ** 2).sum(axis=1) / count[near].sum(axis=1))[rows.ravel()]
