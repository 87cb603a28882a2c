"""Candidates for learned points: pairs of neighbors without a point between them, and open places.

    propose       pairs of neighbors, and open places at rims, legs and gaps
    place         middle of a pair's curved edge (PN triangles, Vlachos et al. 2001), and a local frame there
    find_nearest  the points around a candidate, from which `nn.point_prediction` predicts a point

Lengths are in spacings, vectors in frames that rotate with the cloud.  The choice of pairs and of the points around
them has no gradient; positions, normals and materials are differentiable.  An *end* is a point of a pair.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.kernels.numerics import normalize, safe_sqrt
from spnr_jax.kernels.records import PointCloud
from spnr_jax.surfels.geometry import estimate_surfels

SPARSE = 8192  # points of a cloud up to which points are added everywhere; larger ones: rims, curves, thin walls
OPPOSED_COSINE, WALL_SHARE = -0.5, 0.2  # a thin wall: this share of the neighbors has normals below this cosine
BENT = 0.3  # a pair is bent if |h_i| / s + |h_j| / s + 1 - cos > BENT: heights over the other's plane, spacing, normals
CANDIDATES = 6  # candidates of each point: middles of the pairs that it owns, then open places
NUM_NEAREST = 16  # nearest points from which a point is predicted
BETWEEN = 0.4  # a point lies between two ends if the cosine of the angle at which it sees them is below -BETWEEN
ACROSS = 0.8  # sine of the angle between a pair and both tangent planes, above which the pair crosses a wall
LONGEST, SHORTEST = 4.0, 0.3  # bounds of a pair's length, in spacings
ANGLES = np.linspace(0, 2 * np.pi, 6, endpoint=False, dtype=np.float32)  # tested for openness, from the nearest
BESIDE, NEAR = 0.75, 1.7  # a neighbor closes a direction within this cosine and this distance in spacings
OPEN_DISTANCE = 0.5  # spacings from a point to its open place
AFTER_PAIRS = 1e3  # rank of an open place: above the length of any pair in spacings


class Nodes(NamedTuple):
    """Graph nodes: `color` is the square root of the linear colour; `traits`: shape, sidedness, openness, mask."""

    position: Float[Array, "n 3"]
    normal: Float[Array, "n 3"]
    spacing: Float[Array, " n"]
    color: Float[Array, "n 3"]
    traits: Float[Array, "n 5"]


class Candidates(NamedTuple):
    """Candidate positions: the two ends of each (the same point twice at an open place) and the points around it.

    `exists` is False for unused slots.  Rows of `frame` are unit vectors: from the first to the second end, across, and
    along the normal.  `scale` is the unit of length; `around` are indices of points, -1 for none.
    """

    first: Int[Array, " m"]
    second: Int[Array, " m"]
    exists: Bool[Array, " m"]
    middle: Float[Array, "m 3"]
    frame: Float[Array, "m 3 3"]
    scale: Float[Array, " m"]
    around: Int[Array, "m 16"]


def build_graph(cloud: PointCloud, neighbors: Int[Array, "n 20"]) -> tuple[Nodes, Candidates]:
    """Graph nodes and candidates of a cloud in the box: the inputs of the network."""
    surfels = jax.tree.map(jnp.asarray, estimate_surfels(cloud, neighbors))
    openness, shown = 2 * jnp.mean(surfels.visibility, axis=1), surfels.mask.astype(surfels.spacing.dtype)
    traits = jnp.concatenate([surfels.shape_ratios, jnp.stack([surfels.one_sided, openness, shown], axis=1)], axis=1)
    nodes = Nodes(surfels.position, surfels.normal, surfels.spacing, safe_sqrt(surfels.base_color), traits)
    return nodes, place_candidates(nodes, neighbors)


class Pairs(NamedTuple):
    """Each point i beside each of its neighbors j."""

    other: Int[Array, "n k"]
    """Index of j, negative for none."""
    real: Bool[Array, "n k"]
    offset: Float[Array, "n k 3"]
    """From i to j; 0 for none."""
    size: Float[Array, "n k"]
    """Length of the offset."""
    tangent: Float[Array, "n k 3"]
    """Unit direction of j in the tangent plane of i."""
    crosses_wall: Bool[Array, "n k"]
    """Whether the pair is steep to both tangent planes."""
    bent: Bool[Array, "n k"]
    """Whether the surface bends between i and j, or one of them lies on a thin wall."""


def describe_pairs(nodes: Nodes, neighbors: Int[Array, "n 20"]) -> Pairs:
    """The geometry of all pairs of a point and a neighbor."""
    other = neighbors[:, 1:]
    real, spacing = other >= 0, nodes.spacing[:, None]
    offset = jnp.where(real[..., None], nodes.position[other] - nodes.position[:, None], 0)
    size = safe_sqrt(jnp.sum(offset**2, axis=-1))
    height = jnp.einsum("nai,ni->na", offset, nodes.normal)
    height_there = jnp.sum(offset * nodes.normal[other], axis=-1)
    crosses_wall = (jnp.abs(height) > ACROSS * size) & (jnp.abs(height_there) > ACROSS * size)
    cosine = jnp.sum(nodes.normal[:, None] * nodes.normal[other], axis=-1)
    bent = (jnp.abs(height) + jnp.abs(height_there)) / spacing + 1 - cosine > BENT
    opposed, near = (jnp.sum(x, axis=1, dtype=size.dtype) for x in (real & (cosine < OPPOSED_COSINE), real))
    on_wall = opposed > WALL_SHARE * near  # pairs across a wall would fill one side of it alone
    bent = bent | on_wall[:, None] | on_wall[other]
    tangent = normalize((offset - height[..., None] * nodes.normal[:, None]) / spacing[..., None])
    return Pairs(other, real, offset, size, tangent, crosses_wall, bent)


def find_blocked(pairs: Pairs) -> Bool[Array, "n k"]:
    """Whether another neighbor lies between the two ends: it sees them at a cosine below -BETWEEN (113.6 degrees).

    The pairs that are not blocked are those of a beta-skeleton; a Gabriel graph has 90 degrees.
    """
    products = jnp.einsum("nai,nbi->nab", pairs.offset, pairs.offset, precision="highest")
    squared = jnp.diagonal(products, axis1=1, axis2=2)
    to_end = safe_sqrt(squared[:, :, None] + squared[:, None] - 2 * products)
    between = squared[:, None] - products < -BETWEEN * pairs.size[:, None] * to_end
    return jnp.any(between & (pairs.real & ~pairs.crosses_wall)[:, None], axis=2)


def find_open_directions(nodes: Nodes, pairs: Pairs) -> tuple[Float[Array, "n 6 3"], Bool[Array, "n 6"]]:
    """Directions in each tangent plane, the first towards the nearest neighbor, and which have no near neighbor."""
    joined = pairs.real & ~pairs.crosses_wall
    nearest = jnp.argmin(jnp.where(joined, pairs.size, jnp.inf), axis=1)[:, None, None]
    first = project_to_tangent(jnp.take_along_axis(pairs.tangent, nearest, axis=1)[:, 0], nodes.normal)
    second = jnp.cross(nodes.normal, first)
    directions = first[:, None] * np.cos(ANGLES)[None, :, None] + second[:, None] * np.sin(ANGLES)[None, :, None]
    cosine = jnp.einsum("nwi,nai->nwa", directions, pairs.tangent)
    closed = (cosine > BESIDE) & (joined & (pairs.size < NEAR * nodes.spacing[:, None]))[:, None]
    return directions, ~jnp.any(closed, axis=2) & pairs.real[:, :1]


def propose(
    nodes: Nodes, neighbors: Int[Array, "n 20"]
) -> tuple[Int[Array, "n c"], Bool[Array, "n c"], Float[Array, "n c 3"]]:
    """For each point: the other ends of its pairs, which of them exist, and directions to open places (end: the point).

    A pair that is in the lists of both ends belongs to one of them, the lower or the higher index by the parity of
    their sum, so that all points own about as many.  The CANDIDATES slots of a point hold its pairs by length, then
    open directions by angle.
    """
    pairs = describe_pairs(nodes, neighbors)
    own, other, spacing = jnp.arange(len(neighbors), dtype=neighbors.dtype), pairs.other, nodes.spacing[:, None]
    mutual = jnp.any(neighbors[other] == own[:, None, None], axis=-1)
    owns = ((own[:, None] + other) % 2 == 0) == (own[:, None] < other)
    fits = (pairs.size < LONGEST * spacing) & (pairs.size > SHORTEST * (spacing + nodes.spacing[other]))
    sparse = jnp.sum(neighbors[:, 0] >= 0) <= SPARSE
    joined = pairs.real & ~find_blocked(pairs) & ~pairs.crosses_wall & fits
    chosen = joined & (owns | ~mutual) & (sparse | pairs.bent)
    directions, free = find_open_directions(nodes, pairs)
    by_length = jnp.where(chosen, pairs.size / spacing, jnp.inf)
    by_angle = jnp.where(free, AFTER_PAIRS + ANGLES[None], jnp.inf)
    rank = jnp.concatenate([by_length, by_angle], axis=1)
    order = jnp.argsort(rank, axis=1)[:, :CANDIDATES]
    exists = jnp.take_along_axis(rank, order, axis=1) < jnp.inf
    ends = jnp.concatenate([other, jnp.broadcast_to(own[:, None], free.shape)], axis=1)
    ends = jnp.where(exists, jnp.take_along_axis(ends, order, axis=1), own[:, None])
    directions = jnp.concatenate([pairs.tangent, directions], axis=1)
    return ends, exists, jnp.take_along_axis(directions, order[..., None], axis=1)


def project_to_tangent(direction: Float[Array, "m 3"], normal: Float[Array, "m 3"]) -> Float[Array, "m 3"]:
    """Unit vectors: the directions projected to the planes of the normals; any vector of the plane if that is 0."""
    axis = jnp.where(jnp.abs(normal[:, :1]) < 0.6, jnp.eye(1, 3, dtype=normal.dtype), jnp.eye(1, 3, 1, normal.dtype))
    flat = direction - jnp.sum(direction * normal, axis=1, keepdims=True) * normal
    other = axis - jnp.sum(axis * normal, axis=1, keepdims=True) * normal
    return normalize(jnp.where(jnp.sum(flat**2, axis=1, keepdims=True) > 1e-6, flat, other))


def place_candidates(nodes: Nodes, neighbors: Int[Array, "n 20"]) -> Candidates:
    """Candidates of all points, CANDIDATES consecutive ones for each point."""
    ends, exists, directions = jax.lax.stop_gradient(propose(nodes, neighbors))
    own = jnp.broadcast_to(jnp.arange(len(ends), dtype=ends.dtype)[:, None], ends.shape)
    first, second, exists, directions = own.reshape(-1), ends.reshape(-1), exists.reshape(-1), directions.reshape(-1, 3)
    turned = nodes.spacing[first] > nodes.spacing[second]  # not by index: points may come in any order
    turned = turned | ((nodes.spacing[first] == nodes.spacing[second]) & (first > second))
    first, second = jnp.where(turned, second, first), jnp.where(turned, first, second)
    is_open = (first == second)[:, None]
    direction = nodes.position[second] - nodes.position[first]
    scale = (nodes.spacing[first] + nodes.spacing[second]) / 2
    one, two = nodes.normal[first], nodes.normal[second]
    heights = jnp.sum(direction * one, axis=1, keepdims=True), -jnp.sum(direction * two, axis=1, keepdims=True)
    curved = direction / 2 - (heights[0] * one + heights[1] * two) / 8
    middle = nodes.position[first] + jnp.where(is_open, OPEN_DISTANCE * scale[:, None] * directions, curved)
    alike = jnp.sum(one * two, axis=1, keepdims=True) >= 0
    up = normalize(one + jnp.where(alike, two, -two))
    along = project_to_tangent(jnp.where(is_open, directions, normalize(direction / scale[:, None])), up)
    frame = jnp.stack([along, jnp.cross(up, along), up], axis=1)
    around = find_nearest(nodes, neighbors, first, second, jax.lax.stop_gradient(middle))
    return Candidates(first, second, exists, middle, frame, scale, around)


def find_nearest(nodes: Nodes, neighbors: Array, first: Array, second: Array, middle: Array) -> Int[Array, "m 16"]:
    """Indices of the points nearest to each candidate, among the neighbors of both ends; -1 for none."""
    one, two = neighbors[first], neighbors[second]
    again = jnp.any(one[:, None] == two[:, :, None], axis=2)
    number = jnp.concatenate([one, jnp.where(again, -1, two)], axis=1)
    squared = jnp.sum((nodes.position[number] - middle[:, None]) ** 2, axis=-1)
    nearest, chosen = jax.lax.top_k(-jnp.where(number >= 0, squared, jnp.inf), NUM_NEAREST)
    return jnp.where(nearest > -jnp.inf, jnp.take_along_axis(number, chosen, axis=1), -1)
