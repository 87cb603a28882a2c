"""The network of the densifier: the point that belongs at each candidate.

Graph convolutions over the points, then a PointNet over the points around each candidate, in its frame: offset to the
surface, normal, probability that the point exists, and material weights.  It is rotation-equivariant: lengths are in
spacings, vectors in frames that rotate with the cloud (`surfels.candidates`).
"""

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.kernels.numerics import clamp, length, normalize, safe_sqrt
from spnr_jax.kernels.records import Key
from spnr_jax.kernels.voxels import map_existing
from spnr_jax.surfels.candidates import Candidates, Nodes

FEATURES, CONVOLUTIONS = 64, 3  # features of points; number of graph convolutions
EDGE, WIDTH, HEAD = 9, 64, 128  # features of an edge, of a point around a candidate, and of a candidate
BLOCK = 256  # points or candidates in a block: a block fits into a core's cache


class LearnedPoints(NamedTuple):
    """The point predicted for each candidate: `offset` from the middle in its frame, logit of existence, weights."""

    position: Float[Array, "m 3"]
    offset: Float[Array, "m 3"]
    normal: Float[Array, "m 3"]
    logit: Float[Array, " m"]
    weights: Float[Array, "m 16"]


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
    values = jnp.where(real[..., None], values, 0)
    mean = jnp.sum(values, axis=1) / jnp.maximum(jnp.sum(real, axis=1, keepdims=True, dtype=values.dtype), 1)
    return jnp.concatenate([jnp.max(values, axis=1), mean], axis=1)


def rotate(vectors: Float[Array, "m 3"], frame: Float[Array, "m 3 3"]) -> Float[Array, "m 3"]:
    """Vectors given in local frames, in the axes of the cloud."""
    return jnp.einsum("mj,mji->mi", vectors, frame, precision="highest")


def weigh_rows(weights: Float[Array, "m k"], values: Float[Array, "m k ..."]) -> Float[Array, "m ..."]:
    """Weighted sums of the values."""
    return jnp.einsum("mk,mk...->m...", weights, values, precision="highest")


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
    ends = [(number == x[:, None]).astype(far.dtype) for x in (candidates.first, candidates.second)]
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
