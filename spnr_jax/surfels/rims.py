"""Where discs end: at the rim of their layer, where another face cuts theirs, and beyond gaps between random points."""

import numpy as np

from spnr_jax.surfels.neighbours import Near, in_plane
from spnr_jax.surfels.visibility import tangents

RIM_DIRECTIONS = 16  # in which the end of a layer is looked for
RIM_WITHIN = 2.2  # spacings around a point
SHARP = 0.75  # cosine between normals below which two faces meet at an edge
EDGE = 0.1  # spacings that a disc goes beyond the line where another face cuts it
ALIGNED = 0.8  # cosine between a line's direction and one of the four
FAR = 4.0  # where a disc without an end ends
BEYOND = 0.25  # spacings that a surface goes beyond the last point of its layer
EVEN = 0.62  # spacings from a point to the next from which on points are spread evenly: a gap is a hole of the surface
WIDEST = 2.2  # spacings, radius of the widest gap between random points: there is one of 1.9 among 65,536
BRIDGED = 0.95  # spacings from a disc to the middle of a gap, at most


def bridged(near: Near, layer: np.ndarray, spacing: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The spacing of the block, wider beside gaps, so that the discs around a gap cover its middle.

    A gap is an empty circle through the point with other points all around it (a vertex of the Voronoi diagram in the
    tangent plane).  The empty circle whose centre lies in a direction ends at the first point that it meets, and is
    largest, among its neighbours in direction, at a vertex; where the layer ends it grows without limit.
    """
    one, two, _ = in_plane(near, normal[near.rows], spacing[near.rows])
    squared = one**2 + two**2
    there = (layer > 0.5) & (squared > 1e-6)
    turn = (2 * np.pi / RIM_DIRECTIONS * np.arange(RIM_DIRECTIONS)).astype(np.float32)
    radii = []
    for t in turn:
        ahead = one * np.cos(t) + two * np.sin(t)
        met = np.where(there & (ahead > 1e-3), squared / (2 * np.maximum(ahead, 1e-3)), np.inf)
        radii.append(met.min(axis=1))
    radius = np.stack(radii, axis=1)
    vertex = (radius >= np.roll(radius, 1, axis=1)) & (radius >= np.roll(radius, -1, axis=1)) & (radius < WIDEST)
    return spacing[near.rows] * np.maximum(np.where(vertex, radius, 0).max(axis=1) / BRIDGED, 1).astype(np.float32)


def evenness(near: Near, layer: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Spacings to the nearest other point of the layer: .5 in the median of random points, .7 to .8 of even ones."""
    distance = np.where(layer[:, 1:] > 0.5, near.distance[:, 1:], np.inf).min(axis=1, initial=np.inf)
    return distance / spacing[near.rows]


def rims(
    near: Near, layer: np.ndarray, spacing: np.ndarray, normal: np.ndarray, sided: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The direction in which the layer ends soonest, and where it ends, in spacings, as `Surfels` has them.

    `layer` (block, k) are the neighbours' weights as points of the same layer; the rest are arrays of all points.

    It ends a little beyond its last point; at a sharp edge where the plane of the other face cuts it (clip lines,
    Zwicker et al. 2004).
    """
    own, others, spacing = normal[near.rows], normal[near.number], spacing[near.rows]
    one, two, _ = in_plane(near, own, spacing)
    there = (layer > 0.5) & (near.distance < RIM_WITHIN * spacing[:, None])
    turn = (2 * np.pi / RIM_DIRECTIONS * np.arange(RIM_DIRECTIONS)).astype(np.float32)
    ends = np.stack([(there * (one * np.cos(t) + two * np.sin(t))).max(axis=1) for t in turn], axis=1) + BEYOND
    first, second = tangents(own)
    across, up = (np.einsum("nki,ni->nk", others, t) for t in (first, second))
    flat = np.hypot(across, up)
    line = np.einsum("nki,nki->nk", others, near.offset) / spacing[:, None] / np.maximum(flat, 1e-6)
    edge = (np.einsum("nki,ni->nk", others, own) < SHARP) & (line > 0) & (near.distance < RIM_WITHIN * spacing[:, None])
    edge &= (sided[near.number] > 0.5) & (sided[near.rows, None] > 0.5) & (flat > 0.3)
    line = np.where(edge, line + EDGE, np.inf)
    nearest, row = line.argmin(axis=1), np.arange(len(own))
    soonest = ends.argmin(axis=1)
    cut = line[row, nearest] < ends[row, soonest] + BEYOND
    angle = np.where(cut, np.arctan2(up[row, nearest], across[row, nearest]), turn[soonest])
    reach = []
    for quarter in (0, 2, 1, 3):
        way = angle + quarter * np.pi / 2
        step = np.round(way / (2 * np.pi) * RIM_DIRECTIONS).astype(np.int64) % RIM_DIRECTIONS
        cosine = (across * np.cos(way)[:, None] + up * np.sin(way)[:, None]) / np.maximum(flat, 1e-6)
        lines = np.where(cosine > ALIGNED, line, np.inf).min(axis=1)
        reach.append(np.where(np.isfinite(lines), lines, ends[row, step]))
    rim = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    return rim.astype(np.float32), np.minimum(np.stack(reach, axis=1), FAR).astype(np.float32)
