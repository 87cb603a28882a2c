"""The layer of the surface that each point lies on: a plane that its neighbours support, then a quadric through it.

Walls thinner than what anything sees between, stickers and edges put points of several layers side by side; colours,
spacings and normals of one must not mix with those of another.  Lengths are spacings unless they are said not to be.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from spnr_jax.surfels.neighbours import LEAST_SPACING, Near, close, in_plane, spread
from spnr_jax.surfels.visibility import tangents

PAIRED = 8  # nearest points whose pairs span the planes that are tried
SLIVER = 0.2  # sine between two of them from which on they span one
FLAT = 0.1  # spacings from a plane at which a point supports it half
TRUSTED = 1.15  # the plane of least spread counts so much more: it is the better one where points are noisy
ROUNDS = 4  # of the quadric's fit
STIFF = np.diag(np.array([1e-3, 1e-3, 0.1, 0.1, 0.1], np.float32))  # ridge of its slopes and curvatures
THICK, THINNEST = 0.3, 0.04  # most and least standard deviation of a neighbour's weight as one of the layer
START = 0.12  # the same in the first round
SPREADS = 2.0  # this deviation over the mean height of those that count
LOOSE = 2.0  # the same of the layer that colours and spacings come from, over that of the fit
APART = 3.0  # deviations from which on a neighbour is of another layer
PARALLEL = 0.8  # cosine between normals of layers that lie above each other
STICKER, COVERING = 0.8, 2.0  # most height, and fewest neighbours above, of a layer that covers a point


class Layer(NamedTuple):
    """Of a block of points: unit normals of either sign, the layer's thickness, the neighbours' height over it."""

    normal: Float[np.ndarray, "block 3"]
    scale: Float[np.ndarray, " block"]
    height: Float[np.ndarray, "block k"]


def first_normals(near: Near, spacing: np.ndarray) -> np.ndarray:
    """Unit normals (block, 3): of the planes through a point that two of its nearest span, that with most points.

    The plane of least spread is tried, too.  So a point at an edge gets the plane of one of the faces, not one between
    them.
    """
    spacing = spacing[near.rows]
    weight = close(near, spacing)
    best = spread(near, weight)[1][..., 0].astype(np.float32)
    most = TRUSTED * _supported(near, weight, best, spacing)
    last = min(PAIRED, near.number.shape[1] - 1)
    for one in range(1, last):
        for two in range(one + 1, last + 1):
            across = np.cross(near.offset[:, one], near.offset[:, two])
            size = np.linalg.norm(across, axis=1)
            wide = size > SLIVER * near.distance[:, one] * near.distance[:, two]
            normal = across / np.maximum(size, 1e-12)[:, None]
            support = np.where(wide, _supported(near, weight, normal, spacing), 0)
            best = np.where((support > most)[:, None], normal, best)
            most = np.maximum(most, support)
    return best


def _supported(near: Near, weight: np.ndarray, normal: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    height = np.einsum("nki,ni->nk", near.offset, normal) / spacing[:, None]
    return np.sum(weight / (1 + (height / FLAT) ** 2), axis=1)


def fitted(near: Near, spacing: np.ndarray, normal: np.ndarray, given: bool) -> Layer:
    """The layers of a block of points from first normals (all points' arrays); given normals are kept.

    A layer is a quadric through its point (Cazals and Pouget 2003), fitted in rounds to the neighbours that lie close
    to it.
    """
    spacing, of_all, normal = spacing[near.rows], normal, normal[near.rows]
    weight, scale = close(near, spacing), np.full(len(normal), START, np.float32)
    height = in_plane(near, normal, spacing)[2]
    if given:  # the other side of a wall is told apart by its normals
        weight = weight * np.clip(0.5 + np.einsum("nki,ni->nk", of_all[near.number], normal), 0, 1)
    for _ in range(ROUNDS):
        one, two, up = in_plane(near, normal, spacing)
        own = weight * np.exp(-0.5 * (height / scale[:, None]) ** 2)
        terms = np.stack([one, two, one * one, one * two, two * two], axis=-1)
        weighted = (own[..., None] * terms).swapaxes(1, 2)
        solution = np.linalg.solve(weighted @ terms + STIFF, weighted @ up[..., None])
        if given:
            solution[:, :2] = 0
        height = up - (terms @ solution)[..., 0]
        first, second = tangents(normal)
        normal = normal - solution[:, 0] * first - solution[:, 1] * second
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        away = np.sum(own * np.abs(height), axis=1) / np.maximum(own.sum(axis=1) - 1, 0.5)  # the point itself is at 0
        scale = np.clip(SPREADS * away, THINNEST, THICK)
    return Layer(normal, scale, height)


def shape_of(near: Near, layer: Layer, spacing: np.ndarray) -> np.ndarray:
    """Ratios of the extents of the layer's neighbours (block, 2): planarity and linearity."""
    own = close(near, spacing[near.rows]) * np.exp(-0.5 * (layer.height / layer.scale[:, None]) ** 2)
    extent = np.sqrt(np.maximum(spread(near, own + 1e-6)[0], 0))
    return extent[:, :2] / np.maximum(extent[:, 1:], 1e-6)


def weights(near: Near, layer: Layer, normal: np.ndarray, sided: np.ndarray) -> np.ndarray:
    """Weight of each neighbour as one of the same layer: near the quadric, and turned to the same side."""
    along = np.einsum("nki,ni->nk", normal[near.number], normal[near.rows])
    weight = np.exp(-0.5 * (layer.height / (LOOSE * layer.scale[:, None])) ** 2)
    weight = weight * np.where(sided[near.rows, None] > 0.5, np.clip(0.5 + along, 0, 1), 1)
    weight[:, 0] = 1
    return weight


def covered(near: Near, layer: Layer, normal: np.ndarray) -> np.ndarray:
    """Whether another layer that faces the same way lies right above a point, as a sticker does (block,)."""
    along = np.einsum("nki,ni->nk", normal[near.number], normal[near.rows])
    outward = np.sign(np.einsum("ni,ni->n", normal[near.rows], layer.normal))[:, None] * layer.height
    farthest = np.maximum(near.distance[:, -1:], LEAST_SPACING)
    other = (along > PARALLEL) * np.exp(-0.5 * (near.distance / farthest) ** 2) * (np.abs(outward) < STICKER)
    above, below = (np.sum(other * (sign * outward > APART * layer.scale[:, None]), axis=1) for sign in (1, -1))
    return above > np.maximum(COVERING, 2 * below)
