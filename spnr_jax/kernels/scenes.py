"""Parts of a scene: points inside a box, the dominant plane, clusters.

    voxel       side of the cubes that hold CROWD points on average: about three spacings, for any pattern of points
    clusters    connected components of voxels that share a face, an edge or a corner
    plane       RANSAC (Fischler and Bolles 1981) over one point of each voxel, so that area counts, not the density of
                the scan; refitted to its inliers

NumPy in, NumPy out, nearly linear in the number of points; the seed chooses the candidate planes.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from spnr_jax.errors import UserError
from spnr_jax.kernels.cloud_arrays import find_extent, first_in_voxels

Box = Sequence[float | int]

CROWD = 4.0  # points per voxel, on average
COARSEST, FINER, TRIES = 4.0, 2**0.5, 40  # fewest voxels along the extent; ratio and number of the sides tried
NEIGHBORS = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)]  # half
SAMPLE, PLANES, ROUNDS = 4096, 512, 3  # points that vote, candidate planes, refits
CLOSE = 0.5  # voxels: largest distance of an inlier from the plane
THICK = 3.0  # standard deviations of the inliers, at most a voxel: removing the plane removes its noise
LEAST_PLANE = 0.1  # least share of the area of a plane


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plane:
    """Points within `thickness` of normal . position = offset."""

    normal: Float[np.ndarray, "3"]
    offset: float
    thickness: float

    def holds(self, positions: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
        """True for points that belong to it."""
        return np.abs(positions @ self.normal - self.offset) <= self.thickness


def is_inside(positions: Float[np.ndarray, "points 3"], box: Box) -> Bool[np.ndarray, " points"]:
    """True for points in the box with corners xmin ymin zmin and xmax ymax zmax, borders included."""
    return np.all((positions >= np.asarray(box[:3])) & (positions <= np.asarray(box[3:])), axis=-1)


def describe_crop(kept: int, total: int, box: Box, low: np.ndarray, high: np.ndarray) -> str:
    """The message about a cropped box whose points lie from low (3,) to high (3,); ValueError if it is empty."""
    if not kept:
        corners = " ".join(f"{value:g}" for value in box)
        raise UserError(f"--crop {corners}: none of the {total:,} points, they lie in the box {_format_box(low, high)}")
    return f"--crop: {kept:,} of {total:,} points lie inside"


def _format_box(low: np.ndarray, high: np.ndarray) -> str:
    """A box in the format of --crop, rounded to a thousandth of its size."""
    size = float(np.max(high - low, initial=np.finfo(np.float64).tiny))
    decimals = int(np.clip(3 - np.floor(np.log10(size)), 0, 12))
    return " ".join(f"{value + 0.0:.{decimals}f}" for value in (*low, *high))


def select_object(
    positions: Float[np.ndarray, "points 3"],
    origin: Float[np.ndarray, "3"],
    remove_plane: bool,
    nth: int | None,
    seed: int,
) -> tuple[Int[np.ndarray, " left"], list[str]]:
    """Indices of the points to keep, and messages: without the dominant plane, then of the nth largest cluster only.

    `nth` None keeps all clusters.  Messages give positions as positions + origin.  ValueError if there is no such plane
    or cluster, or if all points lie in the plane.
    """
    rows, lines = np.arange(len(positions)), []
    if remove_plane:
        plane = find_dominant_plane(positions, seed)
        if plane is None:
            raise UserError(f"--remove-plane: no plane holds {LEAST_PLANE:.0%} of the surface; leave it out")
        rows = np.flatnonzero(~plane.holds(positions))
        if not len(rows):
            raise UserError(f"--remove-plane: all of the {len(positions):,} points lie in one plane; leave it out")
        lines.append(
            f"--remove-plane: {len(rows):,} of {len(positions):,} points left, without those within "
            f"{plane.thickness:.3g} of the plane through most of the surface"
        )
    if nth is not None:
        labels = find_clusters(positions[rows])
        count = int(labels.max()) + 1
        if nth > count:
            there = f"are {count} clusters" if count > 1 else "is 1 cluster"
            raise UserError(f"--object {nth}: there {there} of points; choose one from 1 to {count}")
        chosen = rows[labels == nth - 1]
        box = _format_box(positions[chosen].min(axis=0) + origin, positions[chosen].max(axis=0) + origin)
        lines.append(f"--object: cluster {nth} of {count:,}, {len(chosen):,} of {len(rows):,} points, in the box {box}")
        rows = chosen
    return rows, lines


def choose_voxel_side(positions: Float[np.ndarray, "points 3"]) -> float:
    """Side of the finest voxels that hold CROWD points on average."""
    corner, extent = find_extent(positions)
    coarse, fine = 0, TRIES  # steps; the first is accepted whatever it holds
    while fine - coarse > 1:
        step = (coarse + fine) // 2
        crowded = len(positions) >= CROWD * len(first_in_voxels(positions - corner, extent / COARSEST / FINER**step))
        coarse, fine = (step, fine) if crowded else (coarse, step)
    return extent / COARSEST / FINER**coarse


def find_clusters(positions: Float[np.ndarray, "points 3"], voxel: float | None = None) -> Int[np.ndarray, " points"]:
    """The cluster of each point, 0 for the largest; of equal ones, that of the first point comes first."""
    x, y, z = (_slices(axis, voxel or choose_voxel_side(positions)) for axis in positions.T)
    deep, wide = int(z.max()) + 2, int(y.max()) + 2
    keys, first, rows = np.unique((x * wide + y) * deep + z, return_index=True, return_inverse=True)
    ends = []
    for dx, dy, dz in NEIGHBORS:
        wanted = keys + (dx * wide + dy) * deep + dz
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        touching = np.flatnonzero(keys[place] == wanted)
        ends.append(np.stack([touching, place[touching]]))
    one, two = np.concatenate(ends, axis=1)
    graph = coo_array((np.ones(len(one), bool), (one, two)), shape=(len(keys), len(keys)))
    count, labels = connected_components(graph, directed=False)
    sizes = np.bincount(labels[rows], minlength=count)
    begins = np.full(count, len(positions))
    np.minimum.at(begins, labels, first)
    rank = np.empty(count, np.int64)
    rank[np.lexsort((begins, -sizes))] = np.arange(count)
    return rank[labels[rows]]


def _slices(axis: np.ndarray, voxel: float) -> np.ndarray:
    """Indices (points,) from 1 of the slices along an axis; a gap of empty slices counts as one."""
    found, rows = np.unique(np.floor((axis - axis.min()) / voxel), return_inverse=True)
    return 1 + np.concatenate([[0], np.cumsum(np.minimum(np.diff(found), 2))]).astype(np.int64)[rows]


def find_dominant_plane(positions: Float[np.ndarray, "points 3"], seed: int = 0) -> Plane | None:
    """The plane with most of the surface near it; None if that is less than LEAST_PLANE of the area."""
    voxel = choose_voxel_side(positions)
    corner, _ = find_extent(positions)
    rng = np.random.default_rng(seed)
    evenly = positions[first_in_voxels(positions - corner, voxel)]
    sample = evenly[rng.permutation(len(evenly))[:SAMPLE]]
    if len(sample) < 3:
        return None
    a, b, c = (sample[rng.integers(len(sample), size=PLANES)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    if not length.any():
        return None
    normals = normals[length > 0] / length[length > 0, None]
    offsets = np.sum(normals * a[length > 0], axis=1)
    votes = [np.sum(np.abs(sample @ n - o) < CLOSE * voxel) for n, o in zip(normals, offsets, strict=True)]
    normal, offset = normals[np.argmax(votes)], offsets[np.argmax(votes)]
    for _ in range(ROUNDS):
        close = evenly[np.abs(evenly @ normal - offset) < 2 * CLOSE * voxel]
        middle = close.mean(axis=0)
        normal = np.linalg.eigh((close - middle).T @ (close - middle))[1][:, 0]
        offset = float(middle @ normal)
    heights = np.abs(evenly @ normal - offset)
    deviation = float(np.sqrt(np.mean(heights[heights < 2 * CLOSE * voxel] ** 2)))
    thickness = float(np.clip(THICK * deviation, CLOSE * voxel, voxel))
    found = Plane(normal=normal, offset=offset, thickness=thickness)
    return found if np.mean(heights <= thickness) >= LEAST_PLANE else None
