"""Normals that a normal map tilts.

A texel says where the normal points along the directions in which u grows, in which v falls (v runs down the rows, and
the map's green is up), and outwards.  On a triangle the position is linear in the texture coordinates, so that two of
its edges give both directions; they are made perpendicular to the interpolated normal.  Where the coordinates have no
area the normal stays.
"""

import numpy as np


def tilted(normals: np.ndarray, texels: np.ndarray, corners: np.ndarray, texcoords: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) tilted by texels (n, 3), on triangles with corners (n, 3, 3) and texcoords (n, 3, 2)."""
    edges, steps = corners[:, 1:] - corners[:, :1], texcoords[:, 1:] - texcoords[:, :1]
    area = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0]
    side = np.where(area < 0, -1.0, 1.0)[:, None]  # the length does not matter, so that nothing is divided by the area
    along_u = side * (edges[:, 0] * steps[:, 1, 1, None] - edges[:, 1] * steps[:, 0, 1, None])
    against_v = side * (edges[:, 0] * steps[:, 1, 0, None] - edges[:, 1] * steps[:, 0, 0, None])
    tangent, right = _unit(along_u - normals * np.sum(along_u * normals, axis=-1, keepdims=True))
    across = np.cross(normals, tangent)
    across *= np.where(np.sum(across * against_v, axis=-1, keepdims=True) < 0, -1, 1)
    found, whole = _unit(texels[:, :1] * tangent + texels[:, 1:2] * across + texels[:, 2:] * normals)
    return np.where((area != 0)[:, None] & right & whole, found, normals)


def _unit(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vectors (n, 3) of length 1, and where (n, 1) they have a length."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    good = np.isfinite(length) & (length > 0)
    return vectors / np.where(good, length, 1), good
