"""Two sheets nearer to each other than the layer of a point is thick, told apart by their colours.

The skin of a vehicle and its lining, a page and its cover: one quadric goes through both, and each would show through
the other.  Where points of two colours lie among each other and those of the other colour all lie a step above or below
the quadric through a point's own, they are two sheets.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from spnr_jax.surfels.layers import APART, SPREADS, STIFF, THICK, Layer, quadric
from spnr_jax.surfels.neighbours import Near, along, around, close, each
from spnr_jax.surfels.small_systems import solved

LIKE = 0.1  # between square roots of linear colours, standard deviation of the weight of a neighbour as of one colour
SHARE = 0.3  # of the neighbours of a like colour that are certain, from which on a point is believed
# of two sheets, from where on they may be and are certain: the step over their thickness; the share of what is known of
# it that no slope or curvature explains; neighbours of each colour, by their weights; the step over its standard error
SURE = (1.5, APART), (0.3, 0.7), (1.0, 2.0), (3.0, 6.0)


class Sheets(NamedTuple):
    """Points of a block that may lie on one of two sheets, the layers they then have, and whether that is certain."""

    points: Int[np.ndarray, " some"]
    layer: Layer
    certain: Bool[np.ndarray, " some"]


def parted(
    near: list[Near], layer: list[Layer], spacing: Float[np.ndarray, " points"], color: Float[np.ndarray, "points 3"]
) -> list[Layer]:
    """The layers of all blocks of points, of one sheet alone where linear colours tell two apart."""
    root = np.asfortranarray(np.sqrt(np.maximum(color, 0)))
    spacings, colors = ([x] * len(near) for x in (spacing, root))
    found = each(_sheets, near, layer, spacings, colors)
    certain = np.zeros(len(spacing), bool)
    for block, sheets in zip(near, found, strict=True):
        certain[block.rows][sheets.points] = sheets.certain
    return each(_agreed, near, layer, found, colors, [certain] * len(near))


def _unlike(near: Near, root: np.ndarray, some: np.ndarray) -> np.ndarray:
    """How far the neighbours of some points of a block are of another colour than the point, 0 to 1 (k, some)."""
    colors = np.take(root.T, near.number[:, some], axis=1)
    return -np.expm1(-0.5 / LIKE**2 * np.sum((colors - colors[:, :1]) ** 2, axis=0))


def _fewer(weight: np.ndarray, unlike: np.ndarray) -> np.ndarray:
    """Neighbours of the point's colour or of another, by their weights, whichever are fewer."""
    others = np.sum(weight * unlike, axis=0)
    return np.minimum(others, weight.sum(axis=0) - others - 1)  # it is its own neighbour


def _sheets(near: Near, layer: Layer, spacing: np.ndarray, root: np.ndarray) -> Sheets:
    """Fits the quadric with the step to the other colour as one more unknown.

    The border of two colours on a bent surface is no step: slope and curvature beyond it explain as much.
    """
    colors = around(near, root)
    some = np.flatnonzero((colors.max(axis=1) - colors.min(axis=1)).max(axis=0) > LIKE)
    weight, unlike = close(near, spacing[near.rows])[:, some], _unlike(near, root, some)
    mixed = _fewer(weight, unlike) > SURE[2][0]
    some, weight, unlike = some[mixed], weight[:, mixed], unlike[:, mixed]
    offset = near.offset[..., some]
    spacing, normal = spacing[near.rows][some], layer.normal[:, some]
    first = Layer(normal, np.full(some.size, THICK, np.float32), along(offset, normal / spacing))
    found, weight, sums, step = quadric(offset, spacing, weight, first, unlike, firm=False)
    last = np.zeros((len(STIFF), 1, some.size), np.float32)
    last[-1] = 1
    variance = np.maximum(solved(sums + STIFF, last)[-1, 0], 1e-9)  # of the step, over that of the heights
    mean = np.sum(weight * unlike, axis=0) / weight.sum(axis=0)
    alone = 1 / np.maximum(np.sum(weight * (unlike - mean) ** 2, axis=0), 1e-9)  # were nothing else unknown
    high = np.abs(step) / found.scale
    measured = high, alone / variance, _fewer(weight, unlike), high * SPREADS / np.sqrt(variance)
    may, certain = (np.all([x > limits[i] for x, limits in zip(measured, SURE, strict=True)], axis=0) for i in (0, 1))
    return Sheets(some[may], Layer(*(values[..., may] for values in found)), certain[may])


def _agreed(near: Near, layer: Layer, sheets: Sheets, root: np.ndarray, certain: np.ndarray) -> Layer:
    """The layers of a block, those of sheets where enough neighbours of a like colour are certain."""
    like = 1 - _unlike(near, root, sheets.points)[1:]
    share = np.sum(like * certain[near.number[1:, sheets.points]], axis=0) / np.maximum(like.sum(axis=0), 1e-6)
    agreed = share > SHARE
    values = tuple(values.copy() for values in layer)
    for whole, part in zip(values, sheets.layer, strict=True):
        whole[..., sheets.points[agreed]] = part[..., agreed]
    return Layer(*values)
