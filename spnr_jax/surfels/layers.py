"""The layer of the surface that each point lies on: a plane that its neighbours support, then a quadric through it.

Walls thinner than what anything sees between, stickers and edges put points of several layers side by side; colours,
spacings and normals of one must not mix with those of another.  Lengths are spacings unless they are said not to be.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from spnr_jax.surfels.neighbours import LEAST_SPACING, Near, along, around, close, covariance, frame
from spnr_jax.surfels.small_systems import cross, narrowest, solved, variances

PAIRED = 8  # nearest points whose pairs span the planes that are tried
SLIVER = 0.2  # sine between two of them from which on they span one
FLAT = 0.1  # spacings from a plane at which a point supports it half
TRUSTED = 1.15  # the plane of least spread counts so much more: it is the better one where points are noisy
ROUNDS = 4  # of the quadric's fit
# ridge of its slopes and curvatures, and of a step between two colours
STIFF = np.diag(np.array([1e-3, 1e-3, 0.1, 0.1, 0.1, 0.01], np.float32))[..., None]
THICK, THINNEST = 0.3, 0.04  # most and least standard deviation of a neighbour's weight as one of the layer
SHEET = 0.02  # the least where colours or normals tell two sheets apart
START = 0.12  # the same in the first round
SPREADS = 2.0  # this deviation over the mean height of those that count
LOOSE = 2.0  # the same of the layer that colours and spacings come from, over that of the fit
APART = 3.0  # deviations from which on a neighbour is of another layer
PARALLEL = 0.8  # cosine between normals of layers that lie above each other
STICKER, COVERING = 0.8, 2.0  # most height, and fewest neighbours above, of a layer that covers a point


class Layer(NamedTuple):
    """Of a block of points: unit normals of either sign, the layer's thickness, the neighbours' height over it."""

    normal: Float[np.ndarray, "3 block"]
    scale: Float[np.ndarray, " block"]
    height: Float[np.ndarray, "k block"]


def first_normals(near: Near, spacing: np.ndarray) -> np.ndarray:
    """Unit normals (block, 3): of the planes through a point that two of its nearest span, that with most points.

    The plane of least spread is tried, too.  So a point at an edge gets the plane of one of the faces, not one between
    them.
    """
    flat = FLAT * spacing[near.rows]
    weight = close(near, spacing[near.rows])

    def support(normal: np.ndarray) -> np.ndarray:
        return np.sum(weight / (1 + along(near.offset, normal / flat) ** 2), axis=0)

    best = narrowest(covariance(near, weight)).astype(np.float32)
    most = TRUSTED * support(best)
    last = min(PAIRED, len(near.number) - 1)
    for one, two in combinations(range(1, last + 1), 2):
        across = cross(near.offset[:, one], near.offset[:, two])
        size = np.linalg.norm(across, axis=0)
        normal = across / np.maximum(size, 1e-12)
        supported = support(normal) * (size > SLIVER * near.distance[one] * near.distance[two])
        best = np.where(supported > most, normal, best)
        most = np.maximum(most, supported)
    return best.T


def fitted(near: Near, spacing: np.ndarray, normal: np.ndarray, sided: bool, firm: bool) -> Layer:
    """The layers of a block of points from first normals (all points' arrays), which are kept if they are firm.

    A layer is a quadric through its point (Cazals and Pouget 2003), fitted in rounds to the neighbours that lie close
    to it.
    """
    spacing, of_all, normal = spacing[near.rows], normal, normal[near.rows].T
    weight, scale = close(near, spacing), np.full(len(spacing), START, np.float32)
    if sided:  # the other side of a wall is told apart by its normals
        weight *= np.clip(0.5 + along(around(near, of_all), normal), 0, 1)
    first = Layer(normal, scale, along(near.offset, normal / spacing))
    return quadric(near.offset, spacing, weight, first, None, firm).layer


class Fit(NamedTuple):
    """A layer, the neighbours' weights in it, their sums over products of unknowns, the step to those unlike."""

    layer: Layer
    weight: Float[np.ndarray, "k block"]
    sums: Float[np.ndarray, "unknowns unknowns block"]
    step: Float[np.ndarray, " block"]


def quadric(
    offset: np.ndarray, spacing: np.ndarray, weight: np.ndarray, first: Layer, unlike: np.ndarray | None, firm: bool
) -> Fit:
    """Fit in rounds from a first layer; where `unlike` is given, those neighbours lie a step from the quadric."""
    normal, scale, rest = first
    others, stiff, thinnest = ([], STIFF[:5, :5], THINNEST) if unlike is None else ([unlike], STIFF, SHEET)
    for _ in range(ROUNDS):
        axes = frame(normal)
        one, two, up = (along(offset, axis) for axis in axes / spacing)
        own = weight * np.exp(-0.5 * (rest / scale) ** 2)
        terms = np.stack([one, two, one * one, one * two, two * two, *others, up])
        sums = np.einsum("ikn,jkn->ijn", own * terms[:-1], terms)
        solution = solved(sums[:, :-1] + stiff, sums[:, -1:])[:, 0]
        if firm:
            solution[:2] = 0
        height = rest = up - np.einsum("ikn,in->kn", terms[:5], solution[:5])
        if unlike is not None:
            rest = height - solution[5] * unlike
        normal = axes[2] - solution[0] * axes[0] - solution[1] * axes[1]
        normal = normal / np.linalg.norm(normal, axis=0)
        away = np.einsum("kn,kn->n", own, np.abs(rest)) / np.maximum(own.sum(axis=0) - 1, 0.5)  # it is at 0 itself
        scale = np.clip(SPREADS * away, thinnest, THICK)
    return Fit(Layer(normal, scale, height), own, sums[:, :-1], solution[-1])


def shape_of(near: Near, layer: Layer, spacing: np.ndarray) -> np.ndarray:
    """Ratios of the extents of the layer's neighbours (block, 2): planarity and linearity."""
    own = close(near, spacing[near.rows]) * np.exp(-0.5 * (layer.height / layer.scale) ** 2)
    extent = np.sqrt(np.maximum(variances(covariance(near, own + 1e-6)), 0))
    return (extent[:2] / np.maximum(extent[1:], 1e-6)).T.astype(np.float32)


def weights(near: Near, layer: Layer, normal: np.ndarray, sided: np.ndarray) -> np.ndarray:
    """Weight of each neighbour as one of the same layer: near the quadric, and turned to the same side."""
    cosine = along(around(near, normal), normal[near.rows].T)
    weight = np.exp(-0.5 * (layer.height / (LOOSE * layer.scale)) ** 2)
    weight *= np.where(sided[near.rows] > 0.5, np.clip(0.5 + cosine, 0, 1), 1)
    weight[0] = 1
    return weight


def covered(near: Near, layer: Layer, normal: np.ndarray) -> np.ndarray:
    """Whether another layer that faces the same way lies right above a point, as a sticker does (block,)."""
    own = normal[near.rows].T
    outward = np.sign(np.einsum("in,in->n", own, layer.normal)) * layer.height
    farthest = np.maximum(near.distance[-1], LEAST_SPACING)
    other = np.exp(-0.5 * (near.distance / farthest) ** 2) * (np.abs(outward) < STICKER)
    other *= along(around(near, normal), own) > PARALLEL
    above, below = (np.sum(other * (sign * outward > APART * layer.scale), axis=0) for sign in (1, -1))
    return above > np.maximum(COVERING, 2 * below)
