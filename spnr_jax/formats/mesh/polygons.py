"""Triangles of polygons: fans of convex ones, ears of others (Meisters 1975), so that a notch stays empty."""

from collections.abc import Sequence

import numpy as np

MOST_CORNERS = 4096  # of a polygon whose ears are looked for; a larger one becomes a fan
Corners = Sequence[int] | np.ndarray


def triangulate(positions: np.ndarray, polygons: Sequence[Corners] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces (f, 3) of polygons, vertex numbers each, in their order, and which polygon each face is of."""
    sizes = np.array([len(polygon) for polygon in polygons], np.int64)
    faces, owners = [], []
    for size in np.unique(sizes[sizes > 2]):
        rows = np.flatnonzero(sizes == size)
        corners = np.array([polygons[int(row)] for row in rows], np.int64)
        fan = np.stack([np.broadcast_to(corners[:, :1], (len(rows), size - 2)), corners[:, 1:-1], corners[:, 2:]], -1)
        fan = fan.copy()
        if 3 < size <= MOST_CORNERS and (corners >= 0).all() and corners.max() < len(positions):
            for row in np.flatnonzero(~_convex(positions[corners])):
                fan[row] = corners[row][ears(positions[corners[row]])]
        faces.append(fan.reshape(-1, 3))
        owners.append(np.repeat(rows, size - 2))
    if not faces:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(faces)[order], owner[order]


def is_concave(corners: np.ndarray) -> bool:
    """Whether a polygon (n, 3) has a corner that turns the other way."""
    return not _convex(corners[None])[0]


def _convex(corners: np.ndarray) -> np.ndarray:
    """Whether no corner of polygons (m, n, 3) turns against the sense of the whole."""
    edges = np.roll(corners, -1, axis=1) - corners
    turns = np.cross(np.roll(edges, 1, axis=1), edges)
    centred = corners - corners.mean(axis=1, keepdims=True)
    whole = np.cross(centred, np.roll(centred, -1, axis=1)).sum(axis=1)
    share = np.einsum("mnc,mc->mn", turns, whole)
    return (share >= -1e-9 * np.abs(share).max(axis=1, initial=0)[:, None]).all(axis=1) | ~np.isfinite(share).all(
        axis=1
    )


def ears(corners: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3) of a simple polygon (n, 3), as numbers of its corners; a fan of what is not simple."""
    centred = corners - corners.mean(axis=0)
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.delete(centred, axis, axis=1) * [1, (1 if axis != 1 else -1) * np.sign(normal[axis] or 1)]
    left, found, place = list(range(len(corners))), [], 0
    while len(left) > 3:
        for i in [*range(place, len(left)), *range(place)]:
            a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
            if _turn(flat[a], flat[b], flat[c]) > 0:
                others = flat[[j for j in left if j not in (a, b, c)]]
                if not _inside(others, flat[a], flat[b], flat[c]).any():
                    break
        else:
            break
        found.append((a, b, c))
        left.pop(i)
        place = max(i - 1, 0)  # what lies before was no ear, and still is none
    return np.array(found + [(left[0], b, c) for b, c in zip(left[1:-1], left[2:], strict=True)])


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _inside(points: np.ndarray, *triangle: np.ndarray) -> np.ndarray:
    """Whether points (n, 2) lie in a triangle that turns left, or on its border."""
    sides = []
    for a, b in zip(triangle, (*triangle[1:], triangle[0]), strict=True):
        edge, way = b - a, points - a
        sides.append(edge[0] * way[:, 1] - edge[1] * way[:, 0])
    return np.min(sides, axis=0) >= 0
