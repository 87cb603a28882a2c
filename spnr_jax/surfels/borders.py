"""Where a disc's colour changes at a line: two colours beside each other on a surface keep a straight border.

The neighbours of a point are parted in two by their colours, and by a line in the tangent plane where one parts them as
well.  Beyond it the disc shows the other colour.  Colours to first order would fray such a border at the spacing.
"""

import numpy as np
from jaxtyping import Bool, Float

from spnr_jax.surfels.neighbours import Near, along, around, frame
from spnr_jax.surfels.small_systems import solved

WITHIN = 1.6  # spacings, standard deviation of the weight of a neighbour
LEAST = 0.01  # weight from which on a neighbour's place counts
# from where on a border begins to count, and counts whole: nothing jumps with a rounding
CONTRAST = 0.06, 0.16  # between the two colours, in square roots of linear ones
PARTED = 0.8, 0.9  # share of the colours' variance that is between the two
SHARE = 0.03, 0.06  # of the neighbours beyond the line
WRONG = 0.05, 0.01  # share of the neighbours on the wrong side of the line
STIFF = np.diag(np.array([1e-6, 0.1, 0.1], np.float32))[..., None]  # ridge of the line's regression


def borders(
    near: Near, layer: np.ndarray, spacing: np.ndarray, normal: np.ndarray, color: np.ndarray
) -> tuple[Float[np.ndarray, "block 4"], Float[np.ndarray, "block 3"], Float[np.ndarray, " block"]]:
    """The border of each disc of a block and what is added to its colour beyond, as `Surfels` has them; how sure it is.

    Where that is 0 nothing is added.
    """
    border, jump, sure = (np.zeros((near.number.shape[1], *n), np.float32) for n in ((4,), (3,), ()))
    colors = around(near, color)
    some = np.flatnonzero((colors.max(axis=1) - colors.min(axis=1)).max(axis=0) > CONTRAST[0] ** 2)
    if some.size == 0:
        return border, jump, sure
    own, axes = spacing[near.rows][some], frame(normal[near.rows][some].T)
    place = np.stack([along(near.offset[..., some], axis) for axis in axes[:2] / own])
    weight = layer[:, some] * np.exp(-0.5 / WITHIN**2 * np.sum(place**2, axis=0))
    weight[0] = 1
    weight /= weight.sum(axis=0)
    colors = colors[..., some]
    beyond, parted = _parted(weight, np.sqrt(np.maximum(colors, 0)))
    way, distance, wrong = _line(place, weight, beyond)
    sure[some] = parted * _ramp(wrong, *WRONG)
    border[some] = np.concatenate([np.einsum("tn,tin->ni", way, axes[:2]), (distance * own)[:, None]], axis=1)
    jump[some] = (sure[some] * (_mean(colors, weight * beyond) - _mean(colors, weight * ~beyond))).T
    return border, jump, sure


def _ramp(values: np.ndarray, begin: float, end: float) -> np.ndarray:
    """0 before the begin, 1 beyond the end."""
    return np.clip((values - begin) / (end - begin), 0, 1)


def _parted(
    weight: Float[np.ndarray, "k block"], colors: Float[np.ndarray, "3 k block"]
) -> tuple[Bool[np.ndarray, "k block"], Float[np.ndarray, " block"]]:
    """Which neighbours have another colour than the point, and how sure it is that the colours are two.

    Another colour is one nearer to that which differs most from the point's own.
    """
    change = colors - colors[:, :1]
    most = np.argmax(weight * np.sum(change**2, axis=0), axis=0)
    axis = np.take_along_axis(change, most[None, None], axis=1)[:, 0]
    beyond = along(change, axis) > 0.5 * np.sum(axis**2, axis=0)
    share = np.sum(weight * beyond, axis=0)
    apart = _mean(change, weight * beyond) - _mean(change, weight * ~beyond)
    off = change - _mean(change, weight)[:, None]
    total = np.maximum(np.einsum("kn,ckn,ckn->n", weight, off, off), 1e-9)
    between = share * (1 - share) * np.sum(apart**2, axis=0) / total
    return beyond, _ramp(share, *SHARE) * _ramp(np.abs(apart).max(axis=0), *CONTRAST) * _ramp(between, *PARTED)


def _line(
    place: Float[np.ndarray, "2 k block"], weight: Float[np.ndarray, "k block"], beyond: Bool[np.ndarray, "k block"]
) -> tuple[Float[np.ndarray, "2 block"], Float[np.ndarray, " block"], Float[np.ndarray, " block"]]:
    """Unit way across the line, its distance along it in spacings, and the share of neighbours on the wrong side.

    The way is that of a linear regression of the side; the line lies midway between the last of the point's colour and
    the first of the other.
    """
    one, share = np.float32(1), np.sum(weight * beyond, axis=0)
    even = weight * np.where(beyond, 0.5 / np.maximum(share, 1e-6), 0.5 / np.maximum(1 - share, 1e-6))
    terms = np.stack([np.ones_like(weight), *place])
    sums = np.einsum("ikn,jkn->ijn", even * terms, np.stack([*terms, np.where(beyond, one, -one)]))
    way = solved(sums[:, :3] + STIFF, sums[:, 3:])[1:, 0]
    way = way / np.maximum(np.linalg.norm(way, axis=0), 1e-6)
    height, there = np.einsum("ikn,in->kn", place, way), weight > LEAST
    last = np.where(there & ~beyond, height, 0).max(axis=0)  # the point itself lies at 0
    first = np.where(there & beyond, height, np.inf).min(axis=0)
    distance = np.maximum(np.where(np.isfinite(first), last + first, 0) / 2, 0)
    return way, distance, np.sum(weight * (beyond != (height > distance)), axis=0)


def _mean(values: Float[np.ndarray, "3 k block"], weight: Float[np.ndarray, "k block"]) -> Float[np.ndarray, "3 block"]:
    return np.einsum("ckn,kn->cn", values, weight) / np.maximum(weight.sum(axis=0), 1e-6)
