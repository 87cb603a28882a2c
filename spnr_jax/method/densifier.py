"""Learned points between the points of a sparse cloud: a network over pairs of neighbors.

    surfels.candidates   where points may be missing: middles of pairs, open places
    nn.point_prediction  for each: offset to the surface, normal, probability that the point exists, material weights
    select_points        keep the likely points that are not too close to better ones

The neighbors come from the host.  The choice of the kept points has no gradient; positions, normals and materials are
differentiable.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from spnr_jax.errors import UserError, check_kind
from spnr_jax.kernels.numerics import clamp
from spnr_jax.kernels.records import AnyArray, PointCloud
from spnr_jax.method.checks import check_neighbors
from spnr_jax.method.surfel_renderer import normalise_cloud
from spnr_jax.nn.point_prediction import LearnedPoints, predict, weigh_rows
from spnr_jax.surfels.candidates import CANDIDATES, Candidates, Nodes, build_graph
from spnr_jax.surfels.neighbors import measure_evenness

MOST_POINTS = 32768  # a cloud of more points gets no learned points
LEAST_PROBABILITY = 0.45  # probability above which a learned point is kept
LEAST_DISTANCE = 0.2  # spacings: a learned point closer than this to a measured or a better learned one is dropped
NORMAL_PENALTY = 1.5  # times (1 - cosine of the normals), added to the squared ratio of a distance to LEAST_DISTANCE
LARGEST_GAP = 4.0  # cap of that squared ratio to measured points: being farther away is no better
ROUNDS = 8  # of the selection


def densify(params: dict, cloud: PointCloud, neighbors: Int[AnyArray, "points 20"]) -> PointCloud:
    """The cloud (unbatched, any units), then CANDIDATES slots for each of its points; `mask` is True for the kept ones.

    Pure, of static size: jit, vmap over equally padded clouds, grad.  `params` are the model's, `neighbors` those of
    `spnr_jax.neighbors(cloud)`; find them anew for the result before `encode`.  All points of the result have normals:
    given, estimated or predicted.  `learned` is 0 for measured points.  UserError for params without a densifier.
    """
    check_kind(params, Mapping, "densify: expected model.params")
    if "densifier" not in params:
        raise UserError("densify: these params have no densifier; use those of spnr_jax.load()")
    check_neighbors(cloud, neighbors, "densify")
    inside, centre, scale = normalise_cloud(cloud)
    dense = densify_in_box(params["densifier"], inside, neighbors)
    learned = dense.positions[len(cloud.mask) :] / scale + centre[None]
    return dataclasses.replace(dense, positions=jnp.concatenate([jnp.asarray(cloud.positions), learned]))


def densify_in_box(weights: dict, cloud: PointCloud, neighbors: Int[AnyArray, "points 20"]) -> PointCloud:
    """`densify` of a cloud in the box, by the densifier's own weights."""
    neighbors = jnp.asarray(neighbors)
    nodes, candidates = build_graph(cloud, neighbors)
    evenness = measure_evenness(cloud, neighbors)
    learned = predict(weights, nodes, neighbors, candidates)

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


def select_points(
    nodes: Nodes, neighbors: Int[Array, "n 20"], candidates: Candidates, learned: LearnedPoints
) -> Bool[Array, " m"]:
    """Which predicted points are kept: likely ones that are not too close to each other or to a measured point.

    Of two candidates that are too close, the one that is more likely and farther from measured points wins.  Each round
    keeps those that beat all others close to them (as for maximal independent sets, Luby 1986), so the order of points
    does not matter.  The candidates of point i have the indices i * CANDIDATES + c.
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
