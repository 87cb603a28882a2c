"""Normals of a point cloud without any: a plane through each point's neighbours, turned to one side of the surface.

Orientation follows Hoppe et al. (1992): a normal is carried to a neighbour along the edges of a minimum spanning tree
that prefers nearly parallel planes. Which side is the outer one, each connected part of the cloud decides for itself:
by the divergence theorem the mean of normal * (position - centroid) is three times the volume over the area of a closed
surface, hence positive where normals point outwards. For an open surface this is the rule "away from the centroid".
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

NEIGHBOURS = 30
SMALLEST_EDGE = 1e-6  # added to every edge: a sparse matrix takes 0 for no edge


def oriented_normals(positions: np.ndarray, neighbours: int = NEIGHBOURS) -> np.ndarray:
    """Unit normals (points, 3) of positions (points, 3) that point outwards, float64."""
    positions = np.asarray(positions, np.float64)
    around = nearest_points(positions, neighbours)
    return orient(positions, plane_normals(positions, around), around)


def nearest_points(positions: np.ndarray, neighbours: int) -> np.ndarray:
    """The numbers (points, k) of each point's nearest points, itself among them; k <= neighbours, points."""
    count = min(neighbours, len(positions))
    return cKDTree(positions).query(positions, count)[1].reshape(len(positions), count)


def plane_normals(positions: np.ndarray, around: np.ndarray) -> np.ndarray:
    """The unit normals (points, 3) of the planes through the points' neighbours, of either sign.

    The normal is the direction in which the neighbours spread least.
    """
    spread = positions[around] - positions[around].mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]


def orient(positions: np.ndarray, normals: np.ndarray, around: np.ndarray) -> np.ndarray:
    """The normals, turned so that neighbours agree and each connected part faces outwards."""
    rows, columns = np.repeat(np.arange(len(around)), around.shape[1]), around.ravel()
    bend = 1 - np.abs(np.einsum("ni,ni->n", normals[rows], normals[columns])) + SMALLEST_EDGE
    edges = rows != columns
    graph = coo_matrix((bend[edges], (rows[edges], columns[edges])), shape=(len(positions),) * 2).tocsr()
    tree = minimum_spanning_tree(graph.maximum(graph.T))
    parts, part_of = connected_components(tree, directed=False)
    oriented = normals.copy()
    for part in range(parts):
        order, before = breadth_first_order(tree, int(np.argmax(part_of == part)), directed=False)
        for point in order[1:]:
            if oriented[point] @ oriented[before[point]] < 0:
                oriented[point] *= -1
        offset = positions[order] - positions[order].mean(axis=0)
        if np.sum(oriented[order] * offset) < 0:
            oriented[order] *= -1
    return oriented
