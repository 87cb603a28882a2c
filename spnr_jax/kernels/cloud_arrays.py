"""A cloud's arrays before a network sees them: padding, repeated points, thinning.  NumPy in, NumPy out.

repeats     points closer than NEAR times the median spacing are merged; a cloud that then has no surface is refused.
            The spacing is estimated from many neighbours, so that repeated copies of a scan do not bias it
thinning    a random sample while reading, then voxels, then farthest-point sampling.  A voxel keeps its first point in
            file order; voxels are halved around a fixed corner, so that the result depends only on the points and
            their order.  Voxels bound the memory and time of the farthest-point sampling
"""

from collections.abc import Iterable
from dataclasses import MISSING, fields
from functools import reduce
from operator import add
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError, check_kind
from spnr_jax.kernels.numerics import array_namespace
from spnr_jax.kernels.records import AnyArray, PointCloud

Columns = dict[str, np.ndarray]  # arrays of a cloud by name, (points, ...)
SMALLEST_BUCKET = 512
NEEDED = {x.name for x in fields(PointCloud) if x.default is MISSING}  # fields of a cloud that are never None
VECTORS = ("positions", "base_color", "normals")  # fields of a cloud with three numbers a point


def pad(cloud: PointCloud, size: int) -> PointCloud:
    """The cloud (points, ...), padded with zeros to `size` points; `mask` is False for padding.  Pure."""
    missing = size - len(cloud.mask)
    if missing < 0:
        raise UserError(f"a cloud of {len(cloud.mask)} points does not fit into {size}; thin it out first")

    def extend(values):
        xp = array_namespace(values)
        return xp.concatenate([values, xp.zeros((missing, *values.shape[1:]), values.dtype)])

    return jax.tree.map(extend, cloud)


def check_cloud_kind(cloud: Any, where: str) -> None:
    """ValueError, which names the function, for what is no cloud."""
    check_kind(cloud, PointCloud, f"{where}: expected a PointCloud, as of read_cloud or make_cloud")


def check_cloud(cloud: PointCloud, where: str, *, batched: bool = False) -> None:
    """ValueError, which names the function and the field, for a field that does not fit the mask (points,)."""
    check_cloud_kind(cloud, where)
    shape, kind = np.shape(cloud.mask), getattr(cloud.mask, "dtype", None) or np.asarray(cloud.mask).dtype
    if kind != np.bool_:
        raise UserError(f"{where}: cloud.mask is of type {kind}, expected bool")
    if len(shape) != 1 and not (batched and shape):
        raise UserError(f"{where}: cloud.mask has the shape {shape}, expected (points,); use jax.vmap for more clouds")
    for name, values in vars(cloud).items():
        wanted = (*shape, 3) if name in VECTORS else shape
        if values is None and name in NEEDED:
            raise UserError(f"{where}: cloud.{name} is None, expected an array {wanted}")
        if values is not None and np.shape(values) != wanted:
            raise UserError(f"{where}: cloud.{name} has the shape {np.shape(values)}, expected {wanted}")
    if not shape[-1]:
        raise UserError(f"{where}: the cloud has no points; give at least one")


def check_finite(cloud: PointCloud, where: str) -> None:
    """ValueError, which names the function and the field, for points with NaN or infinity; of traced arrays none."""
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(cloud)):
        return
    mask = np.asarray(cloud.mask)
    for name, values in vars(cloud).items():
        if values is not None and not np.isfinite(np.asarray(values)[mask]).all():
            raise UserError(f"{where}: cloud.{name} has NaN or infinity; remove those points")


def refuse_tracers(arrays: Any, where: str) -> None:
    """ValueError, which names the function, for arrays that JAX traces: what runs on the host needs their values."""
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(arrays)):
        raise UserError(f"{where}: runs on the host, so jit, vmap and grad cannot trace it; call it before them")


def refuse_jit(where: str) -> None:
    """ValueError, which names the function, inside `jit`: programs with options of their own cannot be called there."""
    refuse_tracers(jax.numpy.add(0, 0), where)


def strip(cloud: PointCloud) -> PointCloud:
    """The cloud (points, ...) without its padding."""
    mask = np.asarray(cloud.mask)
    return jax.tree.map(lambda x: np.asarray(x)[mask], cloud)


def bucket(count: int, least: int = SMALLEST_BUCKET) -> int:
    """`least`, a power of two, doubled until it holds `count`: few sizes, so few compilations."""
    return max(least, 1 << (count - 1).bit_length())


def normalization(positions: np.ndarray) -> tuple[np.ndarray, np.float32]:
    """(centre (3,), scale ()): (positions - centre) * scale has its bounding box around 0, with half diagonal 1.

    The scale is 1 if all points coincide.
    """
    low, high = (np.asarray(bound, np.float64) for bound in (positions.min(axis=0), positions.max(axis=0)))
    diagonal = np.linalg.norm(high - low)
    return ((low + high) / 2).astype(np.float32), np.float32(2 / diagonal if diagonal > 0 else 1)


def make_cloud(
    positions: Float[AnyArray, "points 3"],
    base_color: Float[AnyArray, "points 3"] | Float[AnyArray, "3"] | tuple[float | jax.Array, ...] | float = 0.5,
    roughness: Float[AnyArray, " points"] | float | None = None,
    metallic: Float[AnyArray, " points"] | float | None = None,
    normals: Float[AnyArray, "points 3"] | None = None,
) -> PointCloud:
    """The cloud of these arrays, without padding; one value holds for all points.  Pure; NumPy or JAX.

    Base colours are linear.  Without roughness and metallic, 0.5 and 0 are taken and marked as unknown.  Normals have
    any length, 0 where unknown.  Files of points say more (`read_cloud`): for arrays nothing is merged or cleaned.
    ValueError for shapes that do not fit.
    """
    xp = array_namespace(positions, base_color, roughness, metallic, normals)
    if len(shape := np.shape(positions)) != 2 or shape[1] != 3:
        raise UserError(f"make_cloud: positions has the shape {shape}, expected (points, 3)")
    kind = np.float32 if xp is np else xp.promote_types(xp.asarray(positions).dtype, np.float32)

    def column(name: str, values: Any) -> AnyArray:
        wanted = shape if name in VECTORS else shape[:1]
        if name == "base_color" and np.issubdtype(getattr(values, "dtype", float), np.integer):
            raise UserError("make_cloud: base_color holds whole numbers; expected linear floats from 0 to 1")
        values = xp.asarray(values, kind)
        if values.shape not in (wanted, wanted[1:], ()):
            raise UserError(f"make_cloud: {name} has the shape {values.shape}, expected {wanted}")
        return xp.broadcast_to(values, wanted)

    return PointCloud(
        positions=column("positions", positions),
        base_color=column("base_color", base_color),
        roughness=column("roughness", 0.5 if roughness is None else roughness),
        metallic=column("metallic", 0.0 if metallic is None else metallic),
        mask=xp.ones(shape[0], bool),
        normals=None if normals is None else column("normals", normals),
        materials_known=column("materials_known", 0.0) if roughness is None and metallic is None else None,
    )


# --- repeated points --------------------------------------------------------------------------------------------------


NEAR = 1e-3  # times the median spacing
AROUND, SAMPLE = 128, 1024  # neighbours that determine the spacing; points at which it is estimated
FEW = 8  # distinct points: with fewer, the spacing is meaningless
PLACE = 1e-6  # of the extent: closer points share one place
CROWDED = 64  # nearly equal points around each, above which one stands for all in a voxel
LINE = 1e-11  # largest variance of a line across it, as a share of that along it
CANCELLED = 0.5  # length of a mean of unit normals below which they contradict each other


def merge_repeats(positions: Float[np.ndarray, "points 3"], values: Columns) -> tuple[np.ndarray, Columns, int]:
    """The points without repeats, the means of their other columns (points, ...), and the number of merged points.

    Of merged points, the first keeps its position.  A cloud without repeats is returned unchanged.
    """
    labels = _label_repeats(positions)
    _, first, group = np.unique(labels, return_index=True, return_inverse=True)
    merged = len(positions) - len(first)
    if not merged:
        return positions, values, 0
    kept = np.sort(first)
    values = {name: _group_means(column, group)[group[kept]] for name, column in values.items()}
    if "normals" in values:
        values["normals"] = unit_means(values["normals"])
    return positions[kept], values, merged


def unit_means(normals: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Means of unit normals, rescaled to length 1; 0 where they cancel."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > CANCELLED, normals / np.maximum(length, CANCELLED), 0)


def _label_repeats(positions: np.ndarray) -> np.ndarray:
    """A label (points,) for each position; equal and nearly equal points share one."""
    distinct, rows = find_distinct(positions)
    if len(distinct) < FEW:
        return rows
    tree = cKDTree(distinct)
    near = NEAR * measure_spacing(tree)
    if tree.count_neighbors(tree, near) > CROWDED * len(distinct):  # more pairs than fit into the memory
        voxels = np.floor((distinct - distinct.min(axis=0)) / (near / 2))
        _, first, of_voxel = np.unique(voxels, axis=0, return_index=True, return_inverse=True)
        tree, rows = cKDTree(distinct[first]), of_voxel.ravel()[rows]
    pairs = tree.query_pairs(near, output_type="ndarray")
    if not len(pairs):
        return rows
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(tree.n,) * 2)
    return connected_components(graph, directed=False)[1][rows]


def find_distinct(
    positions: Float[np.ndarray, "points 3"],
) -> tuple[Float[np.ndarray, "places 3"], Int[np.ndarray, " points"]]:
    """Distinct positions, sorted (which keeps neighbours close in memory), and the row of each point among them."""
    order = np.lexsort(positions.T)
    ranked = positions[order]
    new = np.ones(len(ranked), bool)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    rows = np.empty(len(ranked), np.int64)
    rows[order] = np.cumsum(new) - 1
    return ranked[new], rows


def measure_spacing(tree: cKDTree, neighbors: int | None = None, sample: int = SAMPLE) -> float:
    """Median side of the square that a point represents, from the distance to its nth nearest point, itself included.

    By default n is AROUND, at most a quarter of the points, so that repeated copies of a scan do not bias it.
    """
    count = neighbors or max(2, min(AROUND, tree.n // 4))
    radius = tree.query(tree.data[:: -(-tree.n // sample)], [count], workers=-1)[0]
    return float(np.median(radius)) * float(np.sqrt(np.pi / count))


def _group_means(column: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Means (groups, ...) of the rows of each group."""
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    counts = np.diff(np.append(starts, len(group)))
    sums = np.add.reduceat(np.asarray(column, np.float64)[order], starts, axis=0)
    return sums / counts.reshape(-1, *(1,) * (column.ndim - 1))


def require_surface(positions: Float[np.ndarray, "points 3"], before: int) -> None:
    """ValueError if points (n, 3), originally `before`, span no surface: one place, two places, or a line."""
    positions = np.clip(positions, *inner_box(positions))
    extent = float(np.ptp(positions, axis=0).max())
    steps = np.round((positions - positions.min(axis=0)) / max(PLACE * extent, np.finfo(np.float64).tiny))
    places = 1 if extent == 0 else len(np.unique(steps, axis=0)) if len(positions) < FEW**4 else FEW
    if places < 3:
        found = f"{before} point{'s' * (before > 1)} in {places} place{'s' * (places > 1)}"
        raise UserError(f"holds {found}: no object can be drawn")
    centred = (positions - positions.mean(axis=0)) / extent
    variance = np.linalg.eigvalsh(centred.T @ centred)
    if variance[1] < LINE * variance[2]:
        raise UserError(f"holds {before} points on one straight line: no object can be drawn")


# --- thinning ---------------------------------------------------------------------------------------------------------


THINNING = 16  # farthest-point sampling starts from at most this many times the number of points to keep
INNER = (0.05, 0.95)  # quantiles along each axis that define the extent of a cloud: outliers do not count
HALVINGS = 20  # of the extent, to the smallest voxel that is tried
SMALLEST_EXTENT = 1e-30  # where all points coincide
FARTHEST = 1e18  # distance from the middle, in the file's units, up to which squared distances fit float32
BY_NORMAL = 0.6  # squared distances get (0.6 spacings)^2 |n - n'|^2 added, so both sides of a thin wall are sampled
FIRST = 256  # farthest points that are searched among all points; later ones among few candidates
FAR = 0.95  # of the largest squared distance: points above it are candidates for the farthest
BEYOND = 1 + 1e-5  # factor on query radii that covers rounding in single precision
KEY_BITS = 21  # of a voxel's index along an axis
SCATTER = np.uint64(0x9E3779B97F4A7C15)  # odd, 2^64 over the golden ratio: multiples of it are spread over 0..2^64 - 1


def sample_stream(pieces: Iterable[Columns], most: int) -> tuple[Columns, int]:
    """Columns of at most `most` rows of all pieces, each with the same chance, and the total number of rows.

    All rows if there are no more than that, otherwise about half of `most` or more.  Whether a row is kept depends only
    on its number.  At any time, only the kept rows and one piece are in memory.
    """
    kept: Columns = {}
    keys, num_rows, halvings = np.zeros(0, np.uint64), 0, 0
    for piece in pieces:
        rows = np.arange(num_rows + 1, num_rows + 1 + len(piece["x"]), dtype=np.uint64) * SCATTER
        num_rows += len(rows)
        if halvings:
            piece, rows = _rows_below(piece, rows, halvings)
        kept = {name: np.concatenate([kept[name], piece[name]]) for name in piece} if kept else dict(piece)
        keys = np.concatenate([keys, rows])
        while len(keys) > most:
            halvings += 1
            kept, keys = _rows_below(kept, keys, halvings)
    return kept, num_rows


def _rows_below(columns: Columns, keys: np.ndarray, halvings: int) -> tuple[Columns, np.ndarray]:
    """Columns and keys of the rows with a key in the lowest 1 / 2^halvings of the range."""
    taken = keys >> np.uint64(64 - halvings) == 0
    return {name: values[taken] for name, values in columns.items()}, keys[taken]


def stack_columns(columns: Columns, names: Iterable[str] = "xyz") -> np.ndarray:
    """Columns (points, names) as one float64 array; the positions by default."""
    return np.stack([np.asarray(columns[name], np.float64) for name in names], axis=-1)


def first_in_voxels(positions: np.ndarray, voxel: float) -> np.ndarray:
    """Sorted indices of the first point of positions (n, 3) in each cube of side `voxel`."""
    return np.sort(np.unique(voxel_keys(positions, voxel), return_index=True)[1])


def voxel_keys(positions: np.ndarray, voxel: float) -> np.ndarray:
    """A key for each of positions (n, 3), the same for all in one cube of side `voxel`.

    Positions more than 2^20 voxels from 0 are clipped to the outermost voxels.
    """
    half = 2.0 ** (KEY_BITS - 1)
    x, y, z = (np.clip(np.floor(positions.T / voxel), -half, half - 1) + half).astype(np.int64)
    return (x << 2 * KEY_BITS) | (y << KEY_BITS) | z


def inner_box(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) of the box that holds most of the positions (n, 3); all, where most of them coincide."""
    low, high = np.quantile(positions, INNER, axis=0)
    return (low, high) if (high > low).any() else (positions.min(axis=0), positions.max(axis=0))


def find_extent(positions: np.ndarray) -> tuple[np.ndarray, float]:
    """Corner (3,) and side of a cube that holds most of the positions (n, 3)."""
    low, high = inner_box(positions)
    return low, max(float((high - low).max()), SMALLEST_EXTENT)


def candidates(positions: np.ndarray, count: int) -> np.ndarray:
    """Sorted indices of count to THINNING * count points: the first points of the finest voxels that fit.

    Points that coincide share every voxel; if voxels leave too few points, the first of the others are added.
    """
    if len(positions) <= THINNING * count:
        return np.arange(len(positions))
    corner, extent = find_extent(positions)
    chosen = np.arange(1)
    for halving in range(HALVINGS):
        finer = first_in_voxels(positions - corner, extent / 2**halving)
        if len(finer) > THINNING * count:
            break
        chosen = finer
    missing = max(0, count - len(chosen))
    others = np.setdiff1d(np.arange(len(positions)), chosen)[:missing] if missing else chosen[:0]
    return np.sort(np.concatenate([chosen, others]))


def farthest_points(positions: np.ndarray, count: int, seed: int, normals: np.ndarray | None = None) -> np.ndarray:
    """Indices (count,) of points (n, 3), each the farthest from those before it; n >= count.

    So any prefix is evenly spread.  The seed chooses the first point; ties go to the first in the file.  Beyond
    THINNING * count points, voxels thin them first: the time is close to count log count.  With normals (n, 3), of unit
    length or 0, a distance includes the angle between them, so that both sides of a thin wall are covered evenly.
    """
    among = candidates(positions, count)
    centred = positions[among] - positions.mean(axis=0)
    largest = np.abs(centred).max(initial=0)
    if largest > FARTHEST:  # else the squares leave float32
        centred = centred / largest
    if normals is not None and len(among) > 1:
        spacing = measure_spacing(cKDTree(centred)) * float(np.sqrt(len(among) / count))
        centred = np.concatenate([centred, BY_NORMAL * spacing * normals[among]], axis=1)
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
        _continue_farthest(chosen, columns, squared)
    return among[chosen]


def _squares(columns: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Squared distances (n,) of points, as columns (d, n), to a place (d,)."""
    return reduce(add, ((column - value) ** 2 for column, value in zip(columns, place, strict=True)))


def _continue_farthest(chosen: np.ndarray, columns: np.ndarray, squared: np.ndarray) -> None:
    """Chooses points from FIRST on: a new point changes only the distances of points that it is nearest to.

    Distances only shrink, so as long as one of the candidates is still far, the farthest point is among them.
    """
    rows = np.ascontiguousarray(columns.T)
    tree = cKDTree(rows)
    far, least = np.arange(0), np.inf
    for step in range(FIRST, len(chosen)):
        last = chosen[step - 1]
        reach = max(float(squared[last]), 0.0) ** 0.5
        near = np.array(tree.query_ball_point(rows[last], BEYOND * reach), np.int64)
        squared[near] = np.minimum(squared[near], _squares(columns[:, near], rows[last]))
        squared[last] = -1  # never again, even where points coincide
        among = squared[far]
        if not (among >= least).any():
            least = FAR * squared.max()
            if least == 0:  # the remaining points coincide with chosen ones
                chosen[step:] = np.flatnonzero(squared == 0)[: len(chosen) - step]
                return
            far = np.flatnonzero(squared >= least)
            among = squared[far]
        chosen[step] = far[np.argmax(among)]
