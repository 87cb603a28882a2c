"""Normals of points from all the points around them, and the points that are visible to one sensor.

A thinned cloud gets its normals from all points of the dense one: the kept points alone give worse normals.
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
from spnr_jax.surfels.geometry import Points, order_in_space

NEIGHBOURS = 16  # of a point, for the spacing
REACH = 2.0  # standard deviation of the weight of a neighbour's distance: spacings, or as many deviations of the noise
DISCS = 2.5  # of this radius, that hold the neighbours that are asked
MOST = 128  # neighbours
THICK = 0.15, 0.7  # standard deviation of the weight of a height over the plane: spacings, deviations of the noise
FLAT, ROUGH = 32, 4.0  # neighbours whose thickness tells what a sensor's noise is, and times that thickness
ROUNDS = 3  # in which neighbours that lie off the plane before count less
ROWS = 2**12  # points that are worked on at a time: their neighbours fit into the cache
CELL = 2.0  # spacings: pixel of a sensor
SAMPLE = 2048  # points at which the spacing is measured
TINY = np.finfo(np.float64).tiny


def planes(
    positions: Float[np.ndarray, "points 3"], among: Float[np.ndarray, "all 3"], noise: float = 0.0
) -> Float[np.ndarray, "points 3"]:
    """Unit normals, of either sign, of the surface at some points from all points of their cloud.

    Each is that of the plane of least squares through the neighbours, in rounds: those that lie off the plane before
    count less, so that an edge gets one of its faces (moving least squares with robust weights, Fleishman et al. 2005).
    `noise` is the standard deviation that the points had before they were averaged: it makes the neighbourhood wider.
    """
    return _planes(positions, cKDTree(among), noise)


def _planes(positions: np.ndarray, tree: cKDTree, noise: float) -> np.ndarray:
    """The normals of `planes` from a tree of all points."""
    spacing = _spacing(tree)
    radius, thick = REACH * max(noise, spacing), max(THICK[0] * spacing, THICK[1] * noise)
    count = DISCS * np.pi * (radius / spacing) ** 2 if spacing > 0 else MOST
    ranks = list(range(1, round(min(count, MOST, tree.n)) + 1))

    def of_rows(points: np.ndarray) -> np.ndarray:
        distance, near = tree.query(points, ranks, workers=-1)
        offset = tree.data[near] - points[:, None]
        weight = close = np.exp(-0.5 * (distance / max(radius, TINY)) ** 2)
        for _ in range(ROUNDS):
            height = np.einsum("nki,ni->nk", offset, _narrowest(offset, weight))
            weight = close * np.exp(-0.5 * (height / max(thick, TINY)) ** 2)
        return _narrowest(offset, weight)

    return np.concatenate([of_rows(positions[i : i + ROWS]) for i in range(0, len(positions), ROWS)])


def _narrowest(offset: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) along which weighted neighbours (n, k, 3) spread least."""
    share = weight / weight.sum(axis=1, keepdims=True)
    centred = offset - (share[:, None] @ offset)
    return np.linalg.eigh(np.swapaxes(centred * share[..., None], 1, 2) @ centred)[1][..., 0]


def facing(
    positions: Float[np.ndarray, "points 3"],
    among: Float[np.ndarray, "all 3"],
    place: Float[np.ndarray, "3"],
    noise: float = 0.0,
) -> Float[np.ndarray, "points 3"]:
    """The normals of `planes`, turned to the place of the sensor that saw the points.

    One sensor sees one side of everything, so that all heights over the planes count as noise, steps of depth as well.
    """
    tree = cKDTree(among)
    normals = _planes(positions, tree, max(noise, ROUGH * _thickness(tree)))
    towards = np.einsum("ni,ni->n", normals, place - positions)
    return np.where(towards[:, None] < 0, -normals, normals)


def _thickness(tree: cKDTree) -> float:
    """Median over a sample of the points of how thick their neighbours lie about the plane of least squares."""
    sample = tree.data[:: -(-tree.n // SAMPLE)]
    near = tree.data[tree.query(sample, list(range(1, min(FLAT, tree.n) + 1)), workers=-1)[1]]
    offset = near - near.mean(axis=1, keepdims=True)
    return float(np.sqrt(np.median((np.linalg.svd(offset, compute_uv=False)[:, -1] ** 2) / near.shape[1])))


def find_visible(
    positions: Float[np.ndarray, "points 3"], place: Float[np.ndarray, "3"], spacing: float | int, behind: float | int
) -> Bool[np.ndarray, " points"]:
    """True for points that no other hides from the place: the first in each pixel, and up to so many spacings behind.

    The sensor looks at the middle of the points; its pixels are CELL spacings wide there.
    """
    way = positions.mean(axis=0) - place
    distance = float(np.linalg.norm(way))
    if not distance > 0 or not spacing > 0:
        return np.zeros(len(positions), bool)
    forward = way / distance
    right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    x, y, depth = np.stack([right, np.cross(right, forward), forward]) @ (positions - place).T
    before = np.flatnonzero(depth > spacing)
    pixels = np.floor(np.stack([x, y])[:, before] / depth[before] * (distance / (CELL * spacing)))
    _, rows = np.unique(pixels, axis=1, return_inverse=True)
    first = np.full(len(before), np.inf)
    np.minimum.at(first, rows.ravel(), depth[before])
    seen = np.zeros(len(positions), bool)
    seen[before] = depth[before] < first[rows.ravel()] + behind * spacing
    return seen


def spacing_of(positions: Float[np.ndarray, "points 3"]) -> float:
    """Median side of the square that a point stands for, at a sample of the points; 0 of fewer than two."""
    return _spacing(cKDTree(positions))


def _spacing(tree: cKDTree) -> float:
    if tree.n < 2:
        return 0.0
    count = min(NEIGHBOURS, tree.n)
    radius = tree.query(tree.data[:: -(-tree.n // SAMPLE)], [count], workers=-1)[0]
    return float(np.median(radius)) * float(np.sqrt(np.pi / count))


# --- thinned clouds ---------------------------------------------------------------------------------------------------


VOTERS = 2**15  # points that votes are taken of, those that are kept among them


def thin_cloud(points: Cleaned, kept: Int[np.ndarray, " points"]) -> PointCloud:
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

    Linear colors tell sheets apart that nearly touch; `noise` is that of `planes`.
    """
    rest = np.setdiff1d(np.arange(len(positions)), kept)
    others = max(0, VOTERS - len(kept))
    voters = np.concatenate([kept, np.random.default_rng(0).permutation(rest)[:others]])
    low, high = positions.min(axis=0), positions.max(axis=0)
    half = np.linalg.norm(high - low) / 2 or 1.0
    places = np.asarray((positions[voters] - (low + high) / 2) / half, np.float32)  # in the box
    order, near = order_in_space(places)
    size = cloud_arrays.bucket(len(order))

    def columns(values: np.ndarray, fill: int = 0) -> Array:
        return jnp.asarray(np.pad(values.T, [(0, 0), (0, size - len(order))], constant_values=fill))

    color = np.asarray(base_color[voters], np.float32)
    normal = np.asarray(planes(positions[voters], positions, noise), np.float32)
    points = Points(
        number=columns(near, -1),
        mask=jnp.arange(size) < len(order),
        given=jnp.zeros(size, bool),  # with a side
        position=columns(places[order]),
        color=columns(color[order]),
    )
    found = np.empty_like(places)
    found[order] = np.asarray(_turn(points, columns(normal[order])))[:, : len(order)].T
    return found[: len(kept)]


@partial(jax.jit, compiler_options=QUICKEST)
def _turn(points: Points, normals: Float[Array, "3 points"]) -> Float[Array, "3 points"]:
    """The normals that are given, but for those of sheets, outward."""
    raw, layer = geometry.find_layers(points, normals, sided=False, sheets=True)
    seen = geometry.look(points, layer.normal, raw)
    return geometry.find_sides(points, raw, layer, seen)[0]
