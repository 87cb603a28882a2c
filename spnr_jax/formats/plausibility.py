"""What looks wrong with a cloud's numbers: a line about each, and what is left out for it.

Rounded positions, degrees, places without data, missing colours, plates seen from both sides, and normals that
contradict the points.
"""

from collections.abc import Iterable

import numpy as np
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import Columns, Report
from spnr_jax.formats.orientation import FARTHEST
from spnr_jax.kernels.cloud_arrays import inner_box, measure_spacing, stack_columns
from spnr_jax.surfels.normals import estimate_normals

LOST_STEP = 1e-3  # of the extent of an axis: above it, the rounding of the file's numbers is reported
MOST_LOST = 5e-3  # of the extent: above it rounding has destroyed the shape
ROUNDED = 0.02  # of the extent: distance between values of an axis above which it may have been rounded
SIX_DIGITS = 1e4  # distance from the origin, in extents of an axis: six digits leave at most a hundred values there
NO_DATA = (-9999, -32767, -32768, -99999)  # heights that mean "unknown" in grids
SOME = 10  # points at 0 0 0 that mean "unknown"
SAMPLE = 512  # points at which the file's normals are checked against the points
LEAST_POINTS = 100  # from which normals and missing colours can be checked
OPPOSED = 0.15  # share of normals opposite to that of the nearest point, above which their signs mean nothing
AGREEING = 0.6  # median cosine between given and estimated normals, below which the given ones are ignored
PARALLEL = 0.9  # cosine to a constant normal, and the share of the points that must have it
DEGREES, NEEDLE = 0.5, 100.0  # largest width in degrees; ratio of height to width above which degrees are suspected
THIN = 0.1, 1.0  # thickness, in spacings, of a plate whose two sides cannot be told apart


def drop_no_data(columns: Columns, report: Report) -> Columns:
    """The points without those that mean "no data": many at 0 0 0 among others, or at a height of NO_DATA."""
    positions = stack_columns(columns)
    nowhere, low = np.asarray(~positions.any(axis=1)), np.isin(positions[:, 2], NO_DATA)
    places, heights = positions[~nowhere], positions[~low, 2]
    nowhere &= bool(nowhere.sum() > SOME and len(places) and np.ptp(places, axis=0).any())
    low &= bool(len(heights) and heights.min() - NO_DATA[0] >= np.ptp(heights))
    for what, mask in (("place is 0 0 0", nowhere), (f"height is {positions[:, 2].min():g}", low)):
        if number := np.count_nonzero(mask):
            report(f"{number:,} points left out: their {what}, no data")
    kept = ~(nowhere | low)
    return {name: column[kept] for name, column in columns.items()} if not kept.all() else columns


def check_steps(positions: np.ndarray, columns: Iterable[np.ndarray], report: Report) -> None:
    """Reports axes that the file rounds coarsely, and degrees; ValueError if rounding has destroyed the shape."""
    low, high = inner_box(positions)
    x, y, z = extent = high - low
    farthest = np.maximum(np.abs(low), np.abs(high))
    short = [column.dtype if column.dtype.kind == "f" and column.dtype.itemsize <= 4 else None for column in columns]
    steps = np.array([np.spacing(kind.type(far)) if kind else 0.0 for kind, far in zip(short, farthest, strict=True)])
    if extent.max() > FARTHEST:
        raise UserError(f"holds points {extent.max():.2g} apart: a broken file, or one of another byte order")
    if steps.max() > MOST_LOST * extent.max() > 0:
        kind = short[int(steps.argmax())]
        found = f"{steps.max():g} apart at best in {kind and kind.name}, for an extent of {extent.max():g}"
        raise UserError(f"holds points {found}; move them to the origin")
    for axis, step, width, far, column in zip("xyz", steps, extent, farthest, positions.T, strict=True):
        fits = (column % 1).any() and (column == column.astype(np.float32)).all()  # text of numbers that were float32
        step = step or fits * np.spacing(np.float32(far))
        if step > LOST_STEP * width > 0:
            report(f"only {len(np.unique(column))} distinct values along {axis}: the file's numbers are {step:g} apart")
    on_earth = farthest[:2].min() <= 90 and farthest[:2].max() <= 180
    if on_earth and 0 < max(x, y) < DEGREES and z > NEEDLE * max(x, y):
        size = f"{max(x, y):.2g} wide and {z:.3g} high"
        report(f"x and y look like degrees of longitude and latitude: {size}; project them to metres first")


def check_rounding(positions: np.ndarray, report: Report, of_mesh: bool = False) -> None:
    """Reports axes with few distinct values, far apart; of meshes, whose walls have few, only far from the origin."""
    extent = float(np.ptp(positions, axis=0).max())
    for axis, column in zip("xyz", positions.T, strict=True):
        far, count = np.abs(column).max() > SIX_DIGITS * extent, len(np.unique(column))
        apart = far if count == 1 else np.ptp(column) > ROUNDED * (count - 1) * extent and (far or not of_mesh)
        if apart and count < len(column) / 10:
            values = "value" if count == 1 else "values"
            report(f"only {count} distinct {values} along {axis} of {len(column):,} points: is it rounded?")


def check_values(positions: np.ndarray, values: dict[str, np.ndarray], report: Report) -> None:
    """Fills in missing colours (black among others) and removes normals that contradict the points."""
    if len(positions) < LEAST_POINTS:
        return
    tree, black = cKDTree(positions), np.asarray(~values["base_color"].any(axis=1))
    if 0.1 < (share := black.mean()) < 0.9:
        rows = np.flatnonzero(black)
        near = tree.query(positions[rows[:: -(-len(rows) // SAMPLE)]], range(2, 10))[1]
        if black[near].mean() < share + 0.25 * (1 - share):  # they lie among the others at random
            of_all = f"{len(rows):,} of {len(black):,} points"
            report(f"{of_all} have no colour (0 0 0): that of their neighbours is taken")
            near = cKDTree(positions[~black]).query(positions[black], 3)[1]
            values["base_color"] = values["base_color"].copy()
            values["base_color"][black] = values["base_color"][~black][near].mean(axis=1)
    thickness = np.ptp(positions @ np.linalg.eigh(np.cov(positions.T))[1][:, 0]) / max(measure_spacing(tree), 1e-300)
    if THIN[0] < thickness < THIN[1]:
        report(f"the points lie in a plate {thickness:.2g} spacings thick: if both sides were seen, their colours mix")
    if "normals" in values and (reason := _doubt(positions, tree, values["normals"])):
        report(f"normals of the file left out: {reason}")
        del values["normals"]


def _doubt(positions: np.ndarray, tree: cKDTree, normals: np.ndarray) -> str:
    """Why normals (n, 3), 0 where unknown, cannot be those of the surface; empty if they can."""
    known = np.flatnonzero(normals.any(axis=1))
    if len(known) < LEAST_POINTS:
        return ""
    rows = known[:: -(-len(known) // SAMPLE)]
    surface = estimate_normals(positions[rows], tree)
    if np.abs(normals[rows] @ normals[rows[0]]).min() > 1 - 1e-6:
        fits = float(np.mean(np.abs(surface @ normals[rows[0]]) > PARALLEL))
        return "all are the same, and the points lie in no plane" if fits < PARALLEL else ""
    cosine = float(np.median(np.abs(np.sum(surface * normals[rows], axis=1))))
    if cosine < AGREEING:
        return f"they lie across the surface of the points (cosine {cosine:.2f})"
    beside = tree.query(positions[rows], [2])[1][:, 0]
    opposed = np.sum(normals[rows] * normals[beside], axis=1) < 0
    # the two sides of a thin wall face away from each other
    outwards = np.sum((positions[rows] - positions[beside]) * (normals[rows] - normals[beside]), axis=1) > 0
    return "those of neighbours have opposite signs" if np.mean(opposed & ~outwards) > OPPOSED else ""
