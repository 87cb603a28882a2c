"""Learned points between the points of a sparse cloud: a network over pairs of neighbors.

    propose    candidates: pairs of neighbors without a point between them; open places at rims, legs and gaps
    place      middle of a pair's curved edge (PN triangles, Vlachos et al. 2001), and a local frame there
    predict    graph convolutions over the points, then a PointNet over the points around each candidate, in its frame:
               offset to the surface, normal, probability that the point exists, and material weights
    select     keep the likely points that are not too close to better ones

The network is rotation-equivariant: lengths are in spacings, vectors in frames that rotate with the cloud.  The
neighbors come from the host.  The choice of pairs, of the points around them and of the kept points has no gradient;
positions, normals and materials are differentiable.  An *end* is a point of a pair.
"""

import dataclasses
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.errors import UserError
from spnr_jax.kernels.numerics import clamp, length, normalize, safe_sqrt
from spnr_jax.kernels.records import AnyArray, Key, PointCloud
from spnr_jax.kernels.voxels import map_existing
from spnr_jax.surfels.geometry import check_inputs, estimate_surfels, normalise_cloud
from spnr_jax.surfels.neighbors import measure_evenness

MOST_POINTS = 32768  # a cloud of more points gets no learned points
SPARSE = 8192  # points of a cloud up to which points are added everywhere; larger ones: rims, curves, thin walls
OPPOSED_COSINE, WALL_SHARE = -0.5, 0.2  # a thin wall: this share of the neighbors has normals below this cosine
BENT = 0.3  # a pair is bent if |h_i| / s + |h_j| / s + 1 - cos > BENT: heights over the other's plane, spacing, normals
CANDIDATES = 6  # candidates of each point: middles of the pairs that it owns, then open places
NUM_NEAREST = 16  # nearest points from which a point is predicted
BETWEEN = 0.4  # a point lies between two ends if the cosine of the angle at which it sees them is below -BETWEEN
ACROSS = 0.8  # sine of the angle between a pair and both tangent planes, above which the pair crosses a wall
LONGEST, SHORTEST = 4.0, 0.3  # bounds of a pair's length, in spacings
ANGLES = 2 * np.pi / 6 * np.arange(6)  # of the directions tested for openness, from that to the nearest neighbor
BESIDE, NEAR = 0.75, 1.7  # a neighbor closes a direction within this cosine and this distance in spacings
OPEN_DISTANCE = 0.5  # spacings from a point to its open place
AFTER_PAIRS = 1e3  # rank of an open place: above the length of any pair in spacings
LEAST_DISTANCE = 0.2  # spacings: a learned point closer than this to a measured or a better learned one is dropped
NORMAL_PENALTY = 1.5  # times (1 - cosine of the normals), added to the squared ratio of a distance to LEAST_DISTANCE
LARGEST_GAP = 4.0  # cap of that squared ratio to measured points: being farther away is no better
ROUNDS = 8  # of the selection
FEATURES, CONVOLUTIONS = 64, 3  # features of points; number of graph convolutions
EDGE, WIDTH, HEAD = 9, 64, 128  # features of an edge, of a point around a candidate, and of a candidate
BLOCK = 256  # points or candidates in a block: a block fits into a core's cache
LEAST_PROBABILITY = 0.45  # probability above which a learned point is kept


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


class LearnedPoints(NamedTuple):
    """The point predicted for each candidate: `offset` from the middle in its frame, logit of existence, weights."""

    position: Float[Array, "m 3"]
    offset: Float[Array, "m 3"]
    normal: Float[Array, "m 3"]
    logit: Float[Array, " m"]
    weights: Float[Array, "m 16"]


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
    opposed = jnp.sum(real & (cosine < OPPOSED_COSINE), axis=1)
    on_wall = opposed > WALL_SHARE * jnp.sum(real, axis=1)  # pairs across a wall would fill one side of it alone
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
    axis = jnp.where(jnp.abs(normal[:, :1]) < 0.6, jnp.eye(3)[:1], jnp.eye(3)[1:2])
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


class GraphConvolution(nn.Module):
    """Features of points after one graph convolution over their neighbors (Wang et al. 2019, EdgeConv)."""

    def setup(self) -> None:
        """Layers."""
        self.own, self.message, self.into, self.out = (nn.Dense(FEATURES) for _ in range(4))
        self.other, self.edge = (nn.Dense(FEATURES, use_bias=False) for _ in range(2))
        self.norm = nn.LayerNorm()

    def __call__(self, hidden: Array, sent: Array, edges: Array, real: Array) -> Float[Array, "n 64"]:
        """New features of the points, from the messages of their neighbors along these edges."""
        message = nn.relu(self.own(hidden)[:, None] + sent + self.edge(edges))
        message = pool(nn.relu(self.message(message)), real)
        return self.norm(hidden + self.out(nn.relu(self.into(jnp.concatenate([hidden, message], axis=1)))))

    def send(self, hidden: Float[Array, "n 64"]) -> Float[Array, "n 64"]:
        """The messages of the points to their neighbors."""
        return self.other(hidden)

    def first(self, hidden: Array, edges: Array, real: Array) -> Array:
        """One convolution of points that are their own only neighbors: to initialise the weights."""
        return self(hidden, self.send(hidden)[:, None], edges, real)


MESSAGE = nn.Dense(WIDTH, use_bias=False)  # from a point to the candidates that it lies around


class Proposal(nn.Module):
    """Predicts points: a PointNet over the points around each candidate, in the candidate's frame."""

    @nn.compact
    def __call__(self, nodes: Nodes, sent: Float[Array, "n 64"], candidates: Candidates) -> LearnedPoints:
        """Residuals on the middles of the candidates; without training, the middles themselves.

        `sent` are the messages of the points to the candidates that they lie around.
        """
        real = candidates.around >= 0
        point_features, offset = describe_points(nodes, candidates)
        pair_features = compare_ends(nodes, candidates)
        element = nn.Dense(WIDTH, name="element")(point_features) + nn.Dense(WIDTH, name="told")(pair_features)[:, None]
        element += sent[candidates.around]
        element = nn.relu(nn.Dense(WIDTH, name="element1")(nn.relu(element)))
        pooled = nn.relu(nn.Dense(WIDTH, name="pool")(pool(element, real)))
        element = nn.Dense(WIDTH, name="element2")(element) + nn.Dense(WIDTH, name="back")(pooled)[:, None]
        element = nn.relu(nn.Dense(WIDTH, name="element3")(nn.relu(element)))
        state = jnp.concatenate([pool(element, real), pooled, pair_features], axis=1)
        state = nn.relu(nn.Dense(HEAD, name="head")(state))
        state = nn.relu(nn.Dense(HEAD, name="head1")(state))
        out = nn.Dense(7, kernel_init=nn.initializers.normal(0.01), name="out")(state)
        move = clamp(out[:, :3], -1.5, 1.5)
        tilt = out[:, 3:6] + jnp.asarray([0, 0, 1], out.dtype)[None]
        position = candidates.middle + candidates.scale[:, None] * rotate(move, candidates.frame)
        normal = normalize(rotate(tilt, candidates.frame))
        near = jnp.sum((offset - move[:, None]) ** 2, axis=-1)
        facing = jnp.einsum("mki,mi->mk", nodes.normal[candidates.around], normal)
        sharp = self.param("sharp", nn.initializers.constant(2.0), (2,))
        preferred = nn.Dense(1, name="material")(element)[..., 0] - sharp[0] * near + sharp[1] * facing
        weights = jax.nn.softmax(jnp.where(real, preferred, -1e9), axis=1)
        return LearnedPoints(position, move, normal, out[:, 6], weights)


def init(key: Key, nodes: Nodes, candidates: Candidates) -> dict:
    """Fresh weights of the network."""
    keys = jax.random.split(key, CONVOLUTIONS + 2)
    hidden, point = nn.Dense(FEATURES).init_with_output(keys[0], nodes.traits)
    edges, real = jnp.zeros((len(hidden), 1, EDGE)), jnp.ones((len(hidden), 1), bool)
    params = {"point": point["params"]}
    for number in range(CONVOLUTIONS):
        params[f"graph{number}"] = GraphConvolution().init(keys[1 + number], hidden, edges, real, method="first")[
            "params"
        ]
    keys = jax.random.split(keys[-1])
    sent, neighbor = MESSAGE.init_with_output(keys[0], hidden)
    proposal = Proposal().init(keys[1], nodes, sent, candidates)["params"]
    return params | {"proposal": proposal | {"neighbor": neighbor["params"]}}


def predict(params: dict, nodes: Nodes, neighbors: Int[Array, "n 20"], candidates: Candidates) -> LearnedPoints:
    """The points predicted for the candidates: graph convolutions, then a PointNet for each candidate, in blocks."""
    hidden: Any = nn.Dense(FEATURES).apply({"params": params["point"]}, nodes.traits)
    around = neighbors[:, 1:]
    edges = describe_edges(nodes, around)
    for number in range(CONVOLUTIONS):
        hidden = convolve(params[f"graph{number}"], hidden, edges, around, neighbors[:, 0] >= 0)

    sent: Any = MESSAGE.apply({"params": params["proposal"]["neighbor"]}, hidden)  # once, not in each block

    def predict_block(block: Candidates) -> Any:
        return Proposal().apply({"params": params["proposal"]}, nodes, sent, block)

    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(predict_block, candidates))
    return map_existing(predict_block, candidates.exists, (candidates,), empty, BLOCK)


def convolve(params: dict, hidden: Array, edges: Array, around: Array, exists: Array) -> Any:
    """Features of the points after one graph convolution, in blocks."""
    sent: Any = GraphConvolution().apply({"params": params}, hidden, method="send")

    def one(hidden: Array, edges: Array, around: Array) -> Any:
        return GraphConvolution().apply({"params": params}, hidden, sent[around], edges, around >= 0)

    return map_existing(one, exists, (hidden, edges, around), jnp.zeros_like(hidden), BLOCK)


def pool(values: Float[Array, "m k f"], real: Bool[Array, "m k"]) -> Float[Array, "m 2*f"]:
    """Maximum (of values above 0) and mean over the entries that are real."""
    values = values * real[..., None]
    mean = jnp.sum(values, axis=1) / jnp.maximum(jnp.sum(real, axis=1, keepdims=True), 1)
    return jnp.concatenate([jnp.max(values, axis=1), mean], axis=1)


def rotate(vectors: Float[Array, "m 3"], frame: Float[Array, "m 3 3"]) -> Float[Array, "m 3"]:
    """Vectors given in local frames, in the axes of the cloud."""
    return jnp.einsum("mj,mji->mi", vectors, frame, precision="highest")


def describe_edges(nodes: Nodes, around: Int[Array, "n k"]) -> Float[Array, "n k 9"]:
    """Rotation-invariant features of each edge from a point to a neighbor."""
    spacing = nodes.spacing[:, None]
    offset = (nodes.position[around] - nodes.position[:, None]) / spacing[..., None]
    normal, other = nodes.normal[:, None], nodes.normal[around]
    height, from_there = jnp.sum(offset * normal, axis=-1), -jnp.sum(offset * other, axis=-1)
    far = length(offset)
    beside = safe_sqrt(far**2 - height**2)
    unlike = length(nodes.color[around] - nodes.color[:, None])
    coarse = jnp.log(nodes.spacing[around] / spacing)
    parts = [height, from_there, far, jnp.exp(-far), beside, jnp.sum(normal * other, axis=-1), coarse]
    return clamp(jnp.stack([*parts, unlike, jnp.exp(-8 * unlike)], axis=-1), -8, 8)


def describe_points(nodes: Nodes, candidates: Candidates) -> tuple[Float[Array, "m k 14"], Float[Array, "m k 3"]]:
    """Features of the points around each candidate, and their offsets in its frame and scale."""
    number, scale = candidates.around, candidates.scale[:, None]
    way = (nodes.position[number] - candidates.middle[:, None]) / scale[..., None]
    offset = clamp(jnp.einsum("mki,mji->mkj", way, candidates.frame), -8, 8)
    normal = jnp.einsum("mki,mji->mkj", nodes.normal[number], candidates.frame)
    far = length(offset)
    color = (nodes.color[candidates.first] + nodes.color[candidates.second]) / 2
    unlike = length(nodes.color[number] - color[:, None])
    ends = [number == x[:, None] for x in (candidates.first, candidates.second)]
    coarse = jnp.log(nodes.spacing[number] / scale)
    height = -jnp.sum(offset * normal, axis=-1)
    parts = [far, jnp.exp(-(far**2)), height, coarse, unlike, jnp.exp(-8 * unlike), *ends]
    return jnp.concatenate([offset, normal, jnp.stack(parts, axis=-1)], axis=-1), offset


def compare_ends(nodes: Nodes, candidates: Candidates) -> Float[Array, "m 7"]:
    """Features that compare the two ends of each candidate."""
    one, two = candidates.first, candidates.second
    direction = (nodes.position[two] - nodes.position[one]) / candidates.scale[:, None]
    heights = [jnp.sum(direction * nodes.normal[x], axis=1) for x in (one, two)]
    cosine = jnp.sum(nodes.normal[one] * nodes.normal[two], axis=1)
    unlike = length(nodes.color[one] - nodes.color[two])
    coarse = jnp.log(nodes.spacing[two] / nodes.spacing[one])
    parts = [length(direction), *heights, cosine, unlike, coarse, (one == two).astype(cosine.dtype)]
    return clamp(jnp.stack(parts, axis=1), -8, 8)


def weigh_rows(weights: Float[Array, "m k"], values: Float[Array, "m k ..."]) -> Float[Array, "m ..."]:
    """Weighted sums of the values."""
    return jnp.einsum("mk,mk...->m...", weights, values, precision="highest")


def select_points(
    nodes: Nodes, neighbors: Int[Array, "n 20"], candidates: Candidates, learned: LearnedPoints
) -> Bool[Array, " m"]:
    """Which predicted points are kept: likely ones that are not too close to each other or to a measured point.

    Of two candidates that are too close, the one that is more likely and farther from measured points wins.  Each round
    keeps those that beat all others close to them (maximal independent set, Luby 1986), so the order of points does not
    matter.  The candidates of point i have the indices i * CANDIDATES + c.
    """
    count = len(neighbors)
    near = neighbors[:, :12]
    fixed = (nodes, learned, candidates.scale, candidates.exists)
    nodes, learned, scale, exists = jax.lax.stop_gradient(fixed)
    position, normal = (x.reshape(count, CANDIDATES, 3) for x in (learned.position, learned.normal))
    closest = LEAST_DISTANCE * scale.reshape(count, CANDIDATES, 1)

    def compare(others: Array, facing: Array) -> Array:
        """Squared distances over LEAST_DISTANCE squared, plus a term for different normals; below 1 is too close."""
        far = jnp.sum((others[:, None] - position[:, :, None]) ** 2, axis=-1)
        unlike = 1 - jnp.einsum("nki,nci->nck", facing, normal, precision="highest")
        return far / closest**2 + NORMAL_PENALTY * unlike

    measured = jnp.where((near >= 0)[:, None], compare(nodes.position[near], nodes.normal[near]), jnp.inf)
    gap = jnp.min(measured, axis=2)
    likely = jax.nn.sigmoid(learned.logit).reshape(count, CANDIDATES)
    candidate = exists.reshape(count, CANDIDATES) & (likely > LEAST_PROBABILITY) & (gap > 1)
    score = jnp.where(candidate, likely * jnp.minimum(gap, LARGEST_GAP), 0)
    candidate_index = (near[..., None] * CANDIDATES + jnp.arange(CANDIDATES)[None, None]).reshape(count, 1, -1)
    own = jnp.arange(count * CANDIDATES).reshape(count, CANDIDATES, 1)
    too_close = compare(position[near].reshape(count, -1, 3), normal[near].reshape(count, -1, 3)) < 1
    too_close = too_close & (candidate_index != own) & jnp.repeat(near >= 0, CANDIDATES, axis=1)[:, None]
    other = score.reshape(-1)[candidate_index]
    loses = too_close & ((other > score[..., None]) | ((other == score[..., None]) & (candidate_index < own)))

    def decide(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        kept, undecided = state
        best = undecided & ~jnp.any(loses & undecided.reshape(-1)[candidate_index], axis=2)
        lost = jnp.any(too_close & best.reshape(-1)[candidate_index], axis=2)
        return kept | best, undecided & ~best & ~lost

    return jax.lax.fori_loop(0, ROUNDS, decide, (jnp.zeros_like(candidate), candidate))[0].reshape(-1)


def densify(params: dict, cloud: PointCloud, neighbors: Int[AnyArray, "points 20"]) -> PointCloud:
    """The cloud (unbatched, any units), then CANDIDATES slots for each of its points; `mask` is True for the kept ones.

    Pure, of static size: jit, vmap over equally padded clouds, grad.  `params` are the model's, `neighbors` those of
    `spnr_jax.neighbors(cloud)`; find them anew for the result before `encode`.  All points of the result have normals:
    given, estimated or predicted.  `learned` is 0 for measured points.  UserError for params without a densifier.
    """
    if "densifier" not in params:
        raise UserError("densify: these params have no densifier; use those of spnr_jax.load()")
    check_inputs(cloud, neighbors, "densify")
    inside, centre, scale = normalise_cloud(cloud)
    dense = densify_in_box(params["densifier"], inside, neighbors)
    learned = dense.positions[len(cloud.mask) :] / scale + centre[None]
    return dataclasses.replace(dense, positions=jnp.concatenate([jnp.asarray(cloud.positions), learned]))


def densify_in_box(params: dict, cloud: PointCloud, neighbors: Int[AnyArray, "points 20"]) -> PointCloud:
    """`densify` of a cloud in the box."""
    neighbors = jnp.asarray(neighbors)
    nodes, candidates = build_graph(cloud, neighbors)
    evenness = measure_evenness(cloud, neighbors)
    learned = predict(params, nodes, neighbors, candidates)

    def extend(column: AnyArray, more: Array | None = None) -> Array:
        values = jnp.asarray(column)
        more = weigh_rows(learned.weights, values[candidates.around]) if more is None else more
        return jnp.concatenate([values, more])

    return PointCloud(
        positions=extend(cloud.positions, clamp(learned.position, -1, 1)),
        base_color=extend(cloud.base_color, weigh_rows(learned.weights, nodes.color[candidates.around]) ** 2),
        roughness=extend(cloud.roughness),
        metallic=extend(cloud.metallic),
        mask=extend(cloud.mask, select_points(nodes, neighbors, candidates, learned)),
        normals=extend(nodes.normal, learned.normal),
        materials_known=None if cloud.materials_known is None else extend(cloud.materials_known),
        learned=extend(
            jnp.zeros_like(nodes.spacing) if cloud.learned is None else cloud.learned,
            1 - jax.nn.sigmoid(learned.logit) / 2,
        ),
        evenness=jnp.full((1 + CANDIDATES) * len(nodes.spacing), evenness),
    )
