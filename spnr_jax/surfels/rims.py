"""Where discs end: at the rim of their layer, where another face cuts theirs, and beyond gaps between random points."""

import numpy as np

from spnr_jax.surfels.neighbours import Near, along, around, frame

RIM_DIRECTIONS = 16  # in which the end of a layer is looked for, an even number
TURN = (2 * np.pi / RIM_DIRECTIONS * np.arange(RIM_DIRECTIONS)).astype(np.float32)
RIM_WITHIN = 2.2  # spacings around a point
SHARP = 0.75  # cosine between normals below which two faces meet at an edge
EDGE = 0.1  # spacings that a disc goes beyond the line where another face cuts it
ALIGNED = 0.8  # cosine between a line's direction and one of the four
FAR = 4.0  # where a disc without an end ends
BEYOND = 0.25  # spacings that a surface goes beyond the last point of its layer
EVEN = 0.62  # spacings from a point to the next from which on points are spread evenly: a gap is a hole of the surface
WIDEST = 2.2  # spacings, radius of the widest gap between random points: there is one of 1.9 among 65,536
LEAST = 5e-7  # half the square of a distance in spacings, of a point that is not the same
BRIDGED = 0.95  # spacings from a disc to the middle of a gap, at most


def farthest(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """How far the farthest of the places (k, block) in a plane lies in each of RIM_DIRECTIONS (directions, block)."""
    ways = [one * np.cos(t) + two * np.sin(t) for t in TURN[: RIM_DIRECTIONS // 2]]
    return np.stack([way.max(axis=0) for way in ways] + [-way.min(axis=0) for way in ways])


def bridged(near: Near, layer: np.ndarray, spacing: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The spacing of the block, wider beside gaps, so that the discs around a gap cover its middle.

    A gap is an empty circle through the point with other points all around it (a vertex of the Voronoi diagram in the
    tangent plane).  The empty circle whose centre lies in a direction ends at the first point that it meets, and is
    largest, among its neighbours in direction, at a vertex; where the layer ends it grows without limit.  With all
    places inverted, p to 2 p / |p|^2, the farthest in a direction is as far away as that circle is curved.
    """
    own = spacing[near.rows]
    one, two = (along(near.offset, axis) for axis in frame(normal[near.rows].T)[:2] / own)
    half = (one**2 + two**2) / 2
    inverse = ((layer > 0.5) & (half > LEAST)) / np.maximum(half, LEAST)
    curved = farthest(one * inverse, two * inverse)
    vertex = (curved <= np.roll(curved, 1, axis=0)) & (curved <= np.roll(curved, -1, axis=0)) & (curved > 1 / WIDEST)
    return own * np.maximum(1 / (np.where(vertex, curved, np.inf).min(axis=0) * BRIDGED), 1)


def evenness(near: Near, layer: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Spacings to the nearest other point of the layer: .5 in the median of random points, .7 to .8 of even ones."""
    distance = np.where(layer[1:] > 0.5, near.distance[1:], np.inf).min(axis=0, initial=np.inf)
    return distance / spacing[near.rows]


def rims(
    near: Near, layer: np.ndarray, spacing: np.ndarray, normal: np.ndarray, sided: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The direction in which the layer ends soonest, and where it ends, in spacings, as `Surfels` has them.

    `layer` (k, block) are the neighbours' weights as points of the same layer; the rest are arrays of all points.

    It ends a little beyond its last point; at a sharp edge where the plane of the other face cuts it (clip lines,
    Zwicker et al. 2004).
    """
    axes, spacing, others = frame(normal[near.rows].T), spacing[near.rows], around(near, normal)
    within = near.distance < RIM_WITHIN * spacing
    there = (layer > 0.5) & within
    ends = farthest(*(along(near.offset, axis) * there for axis in axes[:2] / spacing)) + BEYOND
    across, up, facing = (along(others, axis) for axis in axes)
    flat = np.sqrt(across**2 + up**2)
    inverse = 1 / np.maximum(flat, 1e-6)
    line = np.einsum("ikn,ikn->kn", others, near.offset) / spacing * inverse
    edge = (facing < SHARP) & (line > 0) & within & (flat > 0.3)
    edge &= (np.take(sided, near.number) > 0.5) & (sided[near.rows] > 0.5)
    line = np.where(edge, line + EDGE, np.inf)
    nearest, row = line.argmin(axis=0), np.arange(len(spacing))
    soonest = ends.argmin(axis=0)
    cut = line[nearest, row] < ends[soonest, row] + BEYOND
    angle = np.where(cut, np.arctan2(up[nearest, row], across[nearest, row]), TURN[soonest])
    reach = []
    for quarter in (0, 2, 1, 3):
        way = angle + quarter * np.pi / 2
        step = np.round(way / (2 * np.pi) * RIM_DIRECTIONS).astype(np.int64) % RIM_DIRECTIONS
        cosine = (across * np.cos(way) + up * np.sin(way)) * inverse
        lines = np.where(cosine > ALIGNED, line, np.inf).min(axis=0)
        reach.append(np.where(np.isfinite(lines), lines, ends[step, row]))
    rim = np.cos(angle) * axes[0] + np.sin(angle) * axes[1]
    return rim.T, np.minimum(np.stack(reach, axis=1), FAR)
