"""A surface from points alone, as a renderer of references needs it: screened Poisson reconstruction (Kazhdan 2013).

    points -> oriented normals -> pymeshlab's solver -> mesh; materials of the nearest point

Normals: a plane through each point's neighbours, turned to one side of the surface. Orientation follows Hoppe et al.
(1992): a normal is carried to a neighbour along the edges of a minimum spanning tree that prefers nearly parallel
planes. Which side is the outer one, each connected part of the cloud decides for itself: by the divergence theorem the
mean of normal * (position - centroid) is three times the volume over the area of a closed surface, hence positive where
normals point outwards. For an open surface this is the rule "away from the centroid".

The asset that comes out has base colour, roughness and metallic at its vertices and is rendered like any other
(views.py): the same light, cameras and integrator as the pictures that it is compared with.
`depth` is that of the solver's octree: 12, far finer than a thousand points are spaced, is what the paper names. The
solver closes what is open, bridges what is near, and extrapolates; `trim` removes its least supported vertices.
Deterministic: the solver runs in one thread.
"""

import importlib
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError
from spnr_jax.formats.assets import Asset, Material, Part
from spnr_jax.formats.surface_points import vertex_normals
from spnr_jax.kernels.records import PointCloud

NEIGHBOURS = 30
SMALLEST_EDGE = 1e-6  # added to every edge: a sparse matrix takes 0 for no edge


def orient_normals(positions: np.ndarray, neighbours: int = NEIGHBOURS) -> np.ndarray:
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


STRAIGHT = 1e-5  # points spread less than this share of their extent beside a line have no surface


class NoSurface(UserError):
    """Points that span no surface; the message is one line."""


@dataclass(frozen=True, kw_only=True)
class PoissonConfig:
    """How a surface is made of points."""

    depth: int = 12
    """Depth of the octree: the finest cell is the extent / 2^depth."""
    neighbours: int = NEIGHBOURS
    """Nearest points that a normal is estimated from."""
    trim: float = 0.0
    """Share of the vertices, those with the fewest points around them, that is cut off; 0 keeps all."""


def reconstruct(cloud: PointCloud, config: PoissonConfig) -> Asset:
    """The surface of one cloud (points, ...), smooth, with the materials of the nearest point at each vertex.

    NoSurface where there is none: too few points, or points on one line.
    """
    present = np.asarray(cloud.mask)
    positions = np.asarray(cloud.positions, np.float64)[present]
    check_extent(positions)
    vertices, faces, density = screened_poisson(positions, orient_normals(positions, config.neighbours), config.depth)
    vertices, faces = trim(vertices, faces, density, config.trim)
    if not len(faces):
        raise NoSurface(f"{len(positions)} points: the Poisson solver found no surface; give more points")
    nearest = cKDTree(positions).query(vertices)[1]
    base_color, roughness, metallic = (
        np.asarray(channel, np.float32)[present][nearest]
        for channel in (cloud.base_color, cloud.roughness, cloud.metallic)
    )
    part = Part(
        positions=vertices,
        faces=faces,
        material=Material(base_color=np.ones(3, np.float32), roughness=roughness, metallic=metallic),
        normals=vertex_normals(vertices, faces),
        colors=base_color,
    )
    return Asset(parts=(part,))


def check_extent(positions: np.ndarray) -> None:
    """Raise NoSurface unless the positions (points, 3) spread over a plane at least."""
    if len(positions) < 3:
        raise NoSurface(f"{len(positions)} points: a surface needs at least 3 that are not on one line")
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    if not spread[1] > STRAIGHT * spread[0]:
        raise NoSurface(f"{len(positions)} points on one line or in one place: a surface needs them beside each other")


def screened_poisson(
    positions: np.ndarray, normals: np.ndarray, depth: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), faces (f, 3) and the density of points around each vertex (v,)."""
    solver = pymeshlab().MeshSet()
    solver.add_mesh(pymeshlab().Mesh(vertex_matrix=positions, v_normals_matrix=normals))
    solver.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1)
    mesh = solver.current_mesh()
    if not mesh.face_number():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0)
    return mesh.vertex_matrix(), mesh.face_matrix().astype(np.int64), mesh.vertex_scalar_array()


def trim(vertices: np.ndarray, faces: np.ndarray, density: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces without the share of the vertices that has the lowest density, and their faces."""
    if not share or not len(faces):
        return vertices, faces
    kept = density >= np.quantile(density, share)
    number = np.cumsum(kept) - 1
    return vertices[kept], number[faces[kept[faces].all(axis=1)]]


def pymeshlab():
    """The solver's module; ValueError, with what to install, if it is absent."""
    try:
        return importlib.import_module("pymeshlab")
    except ImportError as error:
        needed = "Poisson reconstruction needs pymeshlab: pip install 'spnr-jax[baselines]'"
        raise UserError(f"{needed} ({error})") from None
