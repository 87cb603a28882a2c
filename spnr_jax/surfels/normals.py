"""Normals of points from all points of a dense cloud, and the points that are visible to one sensor.

A thinned cloud gets its normals from the dense one: the kept points alone give worse normals.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from spnr_jax.devices.runtime import QUICKEST
from spnr_jax.kernels import cloud_arrays
from spnr_jax.kernels.cleaning import Cleaned
from spnr_jax.kernels.records import PointCloud
from spnr_jax.surfels import geometry
from spnr_jax.surfels.geometry import PointColumns
from spnr_jax.surfels.neighbors import order_in_space

NEIGHBORS = 16  # of a point, for the spacing
REACH = 2.0  # times the larger of spacing and noise: standard deviation of a neighbour's weight by distance
DISCS = 2.5  # times the points in a disc of that radius: number of neighbours
MOST = 128  # neighbours at most
THICK = 0.15, 0.7  # standard deviation of the weight by height: the larger of these spacings and noise deviations
FLAT, ROUGH = 32, 4.0  # neighbours from whose thickness a sensor's noise is estimated; factor on that thickness
ROUNDS = 3  # of robust reweighting
ROWS = 2**12  # points per block: their neighbours fit into the cache
CELL = 2.0  # width of a sensor's pixel, in spacings
SAMPLE = 2048  # points at which the spacing is measured
TINY = np.finfo(np.float64).tiny


def estimate_normals(
    positions: Float[np.ndarray, "points 3"], tree: cKDTree, noise: float = 0.0
) -> Float[np.ndarray, "points 3"]:
    """Unit normals, of either sign, at some points, from the k-d tree of all points of their cloud.

    Each is the normal of the least-squares plane of the neighbours.  Each round gives less weight to neighbours off the
    previous plane, so that a point at an edge gets one of its faces (robust moving least squares, Fleishman et al.
    2005). `noise` is the standard deviation of the points before they were averaged: it enlarges the neighbourhood.
    """
    spacing = measure_spacing(tree)
    radius, thick = REACH * max(noise, spacing), max(THICK[0] * spacing, THICK[1] * noise)
    count = DISCS * np.pi * (radius / spacing) ** 2 if spacing > 0 else MOST
    ranks = list(range(1, round(min(count, MOST, tree.n)) + 1))

    def of_rows(points: np.ndarray) -> np.ndarray:
        distance, near = tree.query(points, ranks, workers=-1)
        offset = tree.data[near] - points[:, None]
        weight = close = np.exp(-0.5 * (distance / max(radius, TINY)) ** 2)
        for _ in range(ROUNDS):
            height = np.einsum("nki,ni->nk", offset, _find_narrowest(offset, weight))
            weight = close * np.exp(-0.5 * (height / max(thick, TINY)) ** 2)
        return _find_narrowest(offset, weight)

    return np.concatenate([of_rows(positions[i : i + ROWS]) for i in range(0, len(positions), ROWS)])


def _find_narrowest(offset: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) of least variance of weighted neighbours (n, k, 3)."""
    share = weight / weight.sum(axis=1, keepdims=True)
    centred = offset - (share[:, None] @ offset)
    return np.linalg.eigh(np.swapaxes(centred * share[..., None], 1, 2) @ centred)[1][..., 0]


def face_sensor(
    positions: Float[np.ndarray, "points 3"],
    among: Float[np.ndarray, "all 3"],
    sensor: Float[np.ndarray, "3"],
    noise: float = 0.0,
) -> Float[np.ndarray, "points 3"]:
    """The normals of `estimate_normals`, turned to the position of the sensor that saw the points.

    One sensor sees only one side of each surface, so all heights above the planes count as noise, depth steps included.
    """
    tree = cKDTree(among)
    normals = estimate_normals(positions, tree, max(noise, ROUGH * _measure_thickness(tree)))
    towards = np.einsum("ni,ni->n", normals, sensor - positions)
    return np.where(towards[:, None] < 0, -normals, normals)


def _measure_thickness(tree: cKDTree) -> float:
    """Median thickness of a sample of neighbourhoods about their least-squares planes."""
    sample = tree.data[:: -(-tree.n // SAMPLE)]
    near = tree.data[tree.query(sample, list(range(1, min(FLAT, tree.n) + 1)), workers=-1)[1]]
    offset = near - near.mean(axis=1, keepdims=True)
    return float(np.sqrt(np.median((np.linalg.svd(offset, compute_uv=False)[:, -1] ** 2) / near.shape[1])))


def find_visible(
    positions: Float[np.ndarray, "points 3"], sensor: Float[np.ndarray, "3"], spacing: float | int, behind: float | int
) -> Bool[np.ndarray, " points"]:
    """True for points visible from the sensor: the first in each pixel, and others up to `behind` spacings behind it.

    The sensor looks at the middle of the points; its pixels are CELL spacings wide there.
    """
    towards = positions.mean(axis=0) - sensor
    distance = float(np.linalg.norm(towards))
    if not distance > 0 or not spacing > 0:
        return np.zeros(len(positions), bool)
    forward = towards / distance
    right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    x, y, depth = np.stack([right, np.cross(right, forward), forward]) @ (positions - sensor).T
    before = np.flatnonzero(depth > spacing)
    pixels = np.floor(np.stack([x, y])[:, before] / depth[before] * (distance / (CELL * spacing)))
    _, rows = np.unique(pixels, axis=1, return_inverse=True)
    first = np.full(len(before), np.inf)
    np.minimum.at(first, rows.ravel(), depth[before])
    visibility = np.zeros(len(positions), bool)
    visibility[before] = depth[before] < first[rows.ravel()] + behind * spacing
    return visibility


def measure_spacing(tree: cKDTree) -> float:
    """Median side of the square that a point represents, from 16 neighbours; 0 for fewer than two points."""
    return 0.0 if tree.n < 2 else cloud_arrays.measure_spacing(tree, min(NEIGHBORS, tree.n), SAMPLE)


# --- thinned clouds ---------------------------------------------------------------------------------------------------


VOTERS = 2**15  # points that take part in the votes, the kept points included


def thin_cloud(points: Cleaned, kept: Int[np.ndarray, " points"]) -> PointCloud:
    """The points with these indices, (points, ...) float32; without given normals, they get normals from all points.

    If all points are kept, no normals are computed: the renderer estimates them from the same points.
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
    """Unit normals of the points with these indices, outward by the votes of directions and thin walls (sides.py).

    Linear colors split surfaces that nearly touch; `noise` is that of `estimate_normals`.
    """
    rest = np.setdiff1d(np.arange(len(positions)), kept)
    others = max(0, VOTERS - len(kept))
    voters = np.concatenate([kept, np.random.default_rng(0).permutation(rest)[:others]])
    centre, scale = cloud_arrays.normalization(positions)
    in_box = np.asarray((positions[voters] - centre) * scale, np.float32)
    order, near = order_in_space(in_box)
    size = cloud_arrays.bucket(len(order))

    def columns(values: np.ndarray, fill: int = 0) -> Array:
        return jnp.asarray(np.pad(values.T, [(0, 0), (0, size - len(order))], constant_values=fill))

    color = np.asarray(base_color[voters], np.float32)
    normal = np.asarray(estimate_normals(positions[voters], cKDTree(positions), noise), np.float32)
    points = PointColumns(
        neighbors=columns(near, -1),
        mask=jnp.arange(size) < len(order),
        oriented=jnp.zeros(size, bool),  # whether the given normal is oriented
        position=columns(in_box[order]),
        color=columns(color[order]),
    )
    found = np.empty_like(in_box)
    found[order] = np.asarray(_orient(points, columns(normal[order])))[:, : len(order)].T
    return found[: len(kept)]


@partial(jax.jit, compiler_options=QUICKEST)
def _orient(points: PointColumns, normals: Float[Array, "3 points"]) -> Float[Array, "3 points"]:
    """The given normals turned outward; two-sided ones are kept."""
    raw_spacing, layer = geometry.find_layers(points, normals, split_by_color=True)
    visibility = geometry.estimate_visibility(points, layer.normal, raw_spacing)
    return geometry.orient_layers(points, raw_spacing, layer, visibility)[0]
