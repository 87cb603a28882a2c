"""Mesh arrays: triangulation of polygons and strips, and normals.  NumPy in, NumPy out.

Polygons become fans of triangles; where a fan would cover a notch, ears are clipped (Meisters 1975).

A texel of a normal map holds the components of the normal along increasing u, decreasing v (green is up) and outwards.
On a triangle the position is linear in the texture coordinates, so two edges give both tangents; they are made
perpendicular to the interpolated normal.  Where the texture coordinates have no area, the normal is kept.
"""

from collections.abc import Sequence

import numpy as np

MOST_CORNERS = 2048  # larger polygons always become fans


def triangulate(
    positions: np.ndarray, corners: np.ndarray, sizes: Sequence[int] | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (f, 3) of polygons, and the index of the polygon (f,) of each; polygons keep their order.

    `corners`: vertex indices of all polygons, concatenated; `sizes`: number of corners of each polygon.
    """
    count, corners = np.array(sizes, np.int64), corners.astype(np.int64)
    begin = np.cumsum(count) - count
    faces, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for size in np.unique(count[count > 2]):
        rows = np.flatnonzero(count == size)
        own = corners[begin[rows, None] + np.arange(size)]
        fan = np.stack([np.broadcast_to(own[:, :1], (len(rows), size - 2)), own[:, 1:-1], own[:, 2:]], axis=-1)
        if 3 < size <= MOST_CORNERS and (own >= 0).all() and own.max() < len(positions):
            crosses = face_crosses(positions, fan.reshape(-1, 3)).reshape(fan.shape)
            share = np.einsum("mnc,mc->mn", crosses, crosses.sum(axis=1))
            flipped = share < -1e-9 * np.abs(share).max(axis=1)[:, None]  # against the polygon's orientation
            for row in np.flatnonzero(flipped.any(axis=1)):
                fan[row] = own[row][ears(positions[own[row]])]
        faces.append(fan.reshape(-1, 3))
        owners.append(np.repeat(rows, size - 2))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(faces)[order], owner[order]


def ears(corners: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3) of a simple polygon with corners (n, 3), as indices; a fan if it is not simple.

    Two edges may lie on each other: the bridge to a hole.
    """
    centred = corners - corners.mean(axis=0)
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.roll(centred, 2 - axis, axis=1)[:, :2] * [1, np.sign(normal[axis]) or 1]  # counter-clockwise
    left, found, i, failed = list(range(len(corners))), [], 0, 0
    while len(left) > 3 and failed < len(left):
        ear = [left[i - 1], left[i], left[(i + 1) % len(left)]]
        edges = flat[[ear[1], ear[2], ear[0]]] - flat[ear]
        beside = flat[[j for j in left if j not in ear]][:, None] - flat[ear]
        inside = (edges[:, 0] * beside[..., 1] - edges[:, 1] * beside[..., 0] >= 0).all(axis=1)
        inside &= beside.any(axis=2).all(axis=1)  # corners in the place of one of the ear's are those of a bridge
        convex = edges[0, 0] * edges[1, 1] > edges[0, 1] * edges[1, 0]
        if (convex and not inside.any()) or not edges[0].any():  # or a corner that repeats the one before
            found.append(tuple(ear))
            left.pop(i)
            i, failed = max(i - 1, 0), 0  # earlier corners are still no ears
        else:
            i, failed = (i + 1) % len(left), failed + 1
    return np.array(found + [(left[0], b, c) for b, c in zip(left[1:-1], left[2:], strict=True)])


def strip_faces(order: np.ndarray) -> np.ndarray:
    """Triangles (f, 3) of strips of vertices (n,), which -1 ends; every other one of a strip is turned."""
    number = np.arange(len(order))
    place = number - np.maximum.accumulate(np.where(order < 0, number + 1, 0))  # in its strip
    faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=-1)
    faces = np.where(place[: len(faces), None] % 2 == 1, faces[:, [1, 0, 2]], faces)
    return faces[(faces >= 0).all(axis=1)]


def face_crosses(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals (f, 3) of twice the triangles' area."""
    a, b, c = np.moveaxis(positions[faces], 1, 0)
    return np.cross(b - a, c - a)


def unit(vectors: np.ndarray, fallback: np.ndarray | None = None) -> np.ndarray:
    """Vectors (n, 3) of length 1; where one has no length, the fallback."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    directed = vectors / np.where(length > 0, length, 1)
    return directed if fallback is None else np.where(length > 0, directed, fallback)


def vertex_normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit mean normals (v, 3) of the faces (f, 3) around each vertex, weighted by area; y where there is none."""
    sums = np.zeros_like(positions)
    np.add.at(sums, faces, face_crosses(positions, faces)[:, None])
    return unit(sums, np.array([0.0, 1.0, 0.0]))


def tilt_normals(normals: np.ndarray, texels: np.ndarray, corners: np.ndarray, texcoords: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) tilted by texels (n, 3), on triangles with corners (n, 3, 3) and texcoords (n, 3, 2)."""
    edges, steps = corners[:, 1:] - corners[:, :1], texcoords[:, 1:] - texcoords[:, :1]
    area = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0]
    side = np.where(area < 0, -1.0, 1.0)[:, None]  # the length does not matter, so that nothing is divided by the area
    along_u = side * (edges[:, 0] * steps[:, 1, 1, None] - edges[:, 1] * steps[:, 0, 1, None])
    against_v = side * (edges[:, 0] * steps[:, 1, 0, None] - edges[:, 1] * steps[:, 0, 0, None])
    tangent = unit(along_u - normals * np.sum(along_u * normals, axis=-1, keepdims=True))
    across = np.cross(normals, tangent)
    across *= np.where(np.sum(across * against_v, axis=-1, keepdims=True) < 0, -1, 1)
    found = unit(texels[:, :1] * tangent + texels[:, 1:2] * across + texels[:, 2:] * normals)
    sound = (area != 0) & np.isfinite(found).all(axis=-1) & tangent.any(axis=-1) & found.any(axis=-1)
    return np.where(sound[:, None], found, normals)
