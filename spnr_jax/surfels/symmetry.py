"""Mirror symmetry of a sparse cloud: its points reflected in the planes about which it is symmetric.

Most furniture and vehicles are their own mirror images, but the points of one half do not mirror those of the other:
the reflected points lie between the measured ones, and on the surface.

candidates  planes through the centroid, near which every plane of symmetry passes; those whose reflected points lie
            nearest to the cloud are refined
refinement  the reflected points are registered to the cloud (point-to-plane ICP, Chen and Medioni 1992)
acceptance  around most points, the reflected ones lie as far from the nearest measured one as other points of the
            surface would; a reflected point far from all measured ones, as on a part of one side alone, is left out
spacing     the points in the widest gaps are added first, and none close to another: gaps are filled, crowds not made

NumPy on the host, for a cloud in the box: choices, without a gradient.  Lengths are in spacings unless stated.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from spnr_jax.kernels.records import PointCloud
from spnr_jax.kernels.triangles import unit
from spnr_jax.surfels.constants import CONSTANTS
from spnr_jax.surfels.neighbors import measure_evenness, neighbors
from spnr_jax.surfels.normals import estimate_normals
from spnr_jax.surfels.sides import spiral

FEWEST_POINTS = 128  # of a cloud that is completed
MOST_PLANES, ORTHOGONAL = 2, 0.3  # planes used, and the largest cosine between their normals
CANDIDATES, REFINED, DISTINCT = 320, 3, 0.98  # directions of normals, planes refined, cosine from which two are one
SCORING, REGISTERING = 256, 1024  # points that score a candidate, and that register a plane
ROUNDS, ROBUST = 13, (0.5, 0.05)  # of the registration; first and last height at which a point has half its weight
MATCHES = 4  # nearest points among which a reflected point is matched
FAR, LEAST_COSINE = 2.0, 0.7  # limits of a match: distance to the nearest point, cosine of normals
AROUND = 12  # neighbors over which distances are averaged
LEAST_SHARE = 0.8  # of the points that fit
UNLIKE = 0.15  # difference of square roots of colors, beyond which a reflected point does not fit its match


class Limits(NamedTuple):
    """Limits for reflected points; distances, in spacings, are those to the nearest measured point."""

    fits: float
    """A neighborhood fits if its mean distance is below this."""
    nearest: float
    """Reflected points nearer than this are left out; also the least distance between two of them."""
    farthest: float
    """Reflected points farther than this are left out."""
    plate: float
    """A plane within this distance of nine tenths of the points is the middle of a plate, which proves no symmetry."""
    most_points: int
    """Larger clouds are left as they are."""


# other points of the surface have a mean distance of 0.37 if they are even, 0.5 if random
EVENLY_SPREAD = Limits(fits=0.52, nearest=0.3, farthest=0.8, plate=0.0, most_points=2048)
RANDOM = Limits(fits=0.7, nearest=0.45, farthest=1.6, plate=1.5, most_points=8192)


class Surface(NamedTuple):
    """Points and unoriented unit normals in the box; the limits of their kind; neighbors, and the tree of the points.

    `spacing`, the unit of this file's lengths, is the median over points of the mean distance to six neighbors.
    """

    position: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    spacing: float
    limits: Limits
    around: Int[np.ndarray, "n 12"]
    tree: cKDTree


class Reflection(NamedTuple):
    """Points reflected in the plane normal . x = offset, each with the measured point that it matches.

    `height` over the plane of the match and `distance` to the nearest measured point, in spacings; `cosine` between the
    normals.
    """

    position: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    match: Int[np.ndarray, " n"]
    height: Float[np.ndarray, " n"]
    cosine: Float[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]


class Plane(NamedTuple):
    """The points x with normal . x = offset.

    `distance`: mean distance from reflected points to the nearest measured one.  `share`: share of the points whose
    neighborhood fits.
    """

    normal: Float[np.ndarray, "3"]
    offset: float
    distance: float
    share: float


def complete(cloud: PointCloud) -> PointCloud:
    """The cloud (unbatched, without padding), then its points reflected in up to two planes of symmetry.

    Only the points of the cloud if there are too few or too many, or no symmetry.  Reflected points keep their
    material; where the surface has another color there are none, because a pattern need not be symmetric.  `evenness`
    is that of the measured points: others between them hide it.
    """
    count = len(cloud.mask)
    if not FEWEST_POINTS <= count <= RANDOM.most_points:
        return cloud
    evenness = float(measure_evenness(cloud, neighbors(cloud)))
    cloud = dataclasses.replace(cloud, evenness=np.full(count, evenness, np.float32))
    limits = choose_limits(evenness, cloud.normals is not None)
    if count > limits.most_points:
        return cloud
    surface = measure_surface(cloud, limits)
    chosen: list[Plane] = []
    for plane in find_planes(surface):
        if len(chosen) < MOST_PLANES and all(abs(plane.normal @ other.normal) < ORTHOGONAL for other in chosen):
            chosen.append(plane)
    for number, plane in enumerate(chosen):
        cloud = add_reflected(cloud, measure_surface(cloud, limits) if number else surface, plane)
    return cloud


def choose_limits(evenness: float, normals_known: bool = False) -> Limits:
    """The limits for points that lie so evenly; where normals are known, each side of a plate may do so by itself."""
    limits = RANDOM if evenness < CONSTANTS.even else EVENLY_SPREAD
    return limits._replace(plate=RANDOM.plate) if normals_known else limits


def measure_surface(cloud: PointCloud, limits: Limits) -> Surface:
    """The points of a cloud with their normals, given or estimated."""
    position = np.asarray(cloud.positions, np.float64)
    tree = cKDTree(position)
    distance, around = tree.query(position, list(range(1, AROUND + 1)))
    spacing = max(float(np.median(distance[:, 1:7].mean(axis=1))), np.finfo(np.float64).tiny)
    normal = estimate_normals(position, tree) if cloud.normals is None else unit(np.asarray(cloud.normals, np.float64))
    return Surface(position, normal, spacing, limits, around, tree)


def find_planes(surface: Surface) -> list[Plane]:
    """Planes of symmetry, the best first."""
    centroid = surface.position.mean(axis=0)
    axes = np.linalg.eigh(np.cov(surface.position.T))[1].T
    normals = np.concatenate([axes, spiral(CANDIDATES)[: CANDIDATES // 2] @ axes])
    sample = surface.position[:: -(-len(surface.position) // SCORING)]
    across = 2 * (sample - centroid) @ normals.T
    distance = surface.tree.query(sample[:, None] - across[..., None] * normals, workers=-1)[0]
    score = np.minimum(distance / surface.spacing, FAR).mean(axis=0)
    refined: list[np.ndarray] = []
    for normal in normals[np.argsort(score, kind="stable")]:
        if len(refined) < REFINED and all(abs(normal @ other) < DISTINCT for other in refined):
            refined.append(normal)
    planes = [register_plane(surface, normal, float(centroid @ normal)) for normal in refined]
    return sorted(
        (x for x in planes if x.share > LEAST_SHARE and not halves_plate(surface, x)), key=lambda x: x.distance
    )


def halves_plate(surface: Surface, plane: Plane) -> bool:
    """Whether the points lie so near to the plane that any surface would fit its mirror image."""
    distance = np.abs(surface.position @ plane.normal - plane.offset)
    return bool(np.quantile(distance, 0.9) < surface.limits.plate * surface.spacing)


def register_plane(surface: Surface, normal: Float[np.ndarray, "3"], offset: float) -> Plane:
    """The plane after point-to-plane registration of the reflected points to the cloud, robustly weighted."""
    chosen = slice(None, None, -(-len(surface.position) // REGISTERING))
    position = surface.position[chosen]
    for robust in np.geomspace(*ROBUST, ROUNDS):
        found = reflect(surface, normal, offset, chosen)
        weight = (found.distance < FAR) * (found.cosine > LEAST_COSINE) / (1 + (found.height / robust) ** 2)
        tangents = np.linalg.svd(normal[None])[2][1:]
        target = surface.normal[found.match]
        before, facing = position @ normal - offset, target @ normal
        turns = [(position @ x) * facing + before * (target @ x) for x in tangents]
        slopes = 2 * np.stack([*turns, -facing], axis=1)
        weighted = slopes * weight[:, None]
        step = np.linalg.lstsq(weighted.T @ slopes, weighted.T @ (found.height * surface.spacing), rcond=1e-6)[0]
        turned = normal + step[:2] @ tangents
        length = np.linalg.norm(turned)
        normal, offset = turned / length, float((offset + step[2]) / length)
    distance = reflect(surface, normal, offset).distance
    fits = distance[surface.around].mean(axis=1) < surface.limits.fits
    return Plane(normal, offset, float(distance.mean()), float(fits.mean()))


def reflect(surface: Surface, normal: Float[np.ndarray, "3"], offset: float, chosen: slice = slice(None)) -> Reflection:
    """The points, or chosen ones, reflected in a plane, each matched to one of the nearest by place and normal."""
    position, normals = surface.position[chosen], surface.normal[chosen]
    reflected = position - 2 * (position @ normal - offset)[:, None] * normal
    normals = normals - 2 * (normals @ normal)[:, None] * normal
    distance, near = surface.tree.query(reflected, MATCHES)
    distance, facing = distance / surface.spacing, surface.normal[near]
    cosine = np.abs(np.einsum("ni,nki->nk", normals, facing))
    height = np.einsum("nki,nki->nk", reflected[:, None] - surface.position[near], facing) / surface.spacing
    rows, best = np.arange(len(near)), np.argmin(np.abs(height) + 0.3 * distance + 1 - cosine, axis=1)
    match = near[rows, best], height[rows, best], cosine[rows, best]
    return Reflection(reflected, normals, *match, np.minimum(distance[:, 0], FAR))


def add_reflected(cloud: PointCloud, surface: Surface, plane: Plane) -> PointCloud:
    """The cloud, then its points reflected in a plane, where they lie between measured points of their color."""
    found, limits = reflect(surface, plane.normal, plane.offset), surface.limits
    roots = np.sqrt(np.maximum(cloud.base_color, 0))
    alike = np.linalg.norm(roots[found.match] - roots, axis=1) < UNLIKE
    fits = np.flatnonzero(alike & (found.distance > limits.nearest) & (found.distance < limits.farthest))
    kept = fits[space_out(found.position[fits], found.distance[fits], limits.nearest * surface.spacing)]
    added = {"positions": np.clip(found.position[kept], -1, 1), "normals": found.normals[kept]}

    def extend(name: str, values: np.ndarray) -> np.ndarray:
        more = added[name] if name in added else values[kept]
        return np.concatenate([values, more.astype(values.dtype)])

    columns = {name: extend(name, np.asarray(x)) for name, x in vars(cloud).items() if x is not None}
    return dataclasses.replace(cloud, **columns)


def space_out(
    position: Float[np.ndarray, "n 3"], distance: Float[np.ndarray, " n"], least: float
) -> Int[np.ndarray, " kept"]:
    """Sorted indices of the points kept: visited by decreasing distance, farther than `least` from all kept before."""
    near, free = cKDTree(position).query_ball_point(position, least), np.ones(len(position), bool)
    kept = np.zeros(len(position), bool)
    for point in np.argsort(-distance, kind="stable"):
        if free[point]:
            kept[point], free[near[point]] = True, False
    return np.flatnonzero(kept)
