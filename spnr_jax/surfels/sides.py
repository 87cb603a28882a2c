"""Which side of each layer is outside: votes of the directions that see it, and of walls."""

import numpy as np

from spnr_jax.kernels.cloud_arrays import bucket
from spnr_jax.surfels.layers import APART, PARALLEL, SHEET, THINNEST, Layer
from spnr_jax.surfels.neighbours import BLOCK, Near, along, around, close, joined
from spnr_jax.surfels.visibility import DIRECTIONS, grid_of, seen_from

WALL = 1.5  # spacings within which another layer is the other side of a wall
SOLID = 3.0  # weight of the wall's vote
TURN = 0.5  # votes against a given normal from which it is turned
HIDDEN = 0.4  # directions, counted by their cosines, that see a point at most that lies inside and is not drawn
LEAST_SHOWN = 0.3  # share of the points that has to be left
EVIDENCE = 1.0  # votes that a lean is measured against: few of them are none
UNSURE, SURE = 0.15, 0.45  # lean of the votes from which a side begins to count, and counts whole
LEAK = 0.02  # what a disc with a side still weighs from behind, where its back can be seen: better than a hole


def visible_from(positions: np.ndarray, normal: np.ndarray, spacing: np.ndarray, middle: float) -> np.ndarray:
    """How much each of DIRECTIONS sees of each point (points, directions); `middle` is the median spacing."""
    size, count = bucket(len(positions)), len(positions)

    def pad(values):
        return np.concatenate([values, np.zeros((size - count, *values.shape[1:]), values.dtype)])

    cell, grid = grid_of(middle)
    bounded = np.clip(spacing, middle / 2, 2 * middle).astype(np.float32)
    seen = seen_from(pad(positions), pad(normal), pad(bounded), np.arange(size) < count, cell, grid=grid)
    return np.asarray(seen)[:count]


def shown(normal: np.ndarray, seen: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Which points something outside sees; all, where that would leave too few."""
    shown = ~covered & (sum(facing(normal, seen)) > HIDDEN)
    return shown if shown.mean() > LEAST_SHOWN else np.ones_like(shown)


def facing(normal: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How many directions before each point see it, counted by their cosines with its normal, and how many behind."""
    front, total = [], []
    for rows in (slice(i, i + BLOCK) for i in range(0, len(seen), BLOCK)):
        cosine = normal[rows] @ DIRECTIONS.T
        total.append(np.einsum("nd,nd->n", seen[rows], cosine))
        front.append(np.einsum("nd,nd->n", seen[rows], np.maximum(cosine, 0, out=cosine)))
    ahead = np.concatenate(front)
    return ahead, ahead - np.concatenate(total)


def voted(near: Near, layer: Layer, normal: np.ndarray, spacing: np.ndarray, lean: np.ndarray) -> np.ndarray:
    """The lean of each point and of its neighbours on the same layer, whichever way their normals point (block,)."""
    cosine = along(around(near, normal), normal[near.rows].T)
    weight = close(near, spacing[near.rows]) * np.exp(-0.5 * (layer.height / layer.scale) ** 2) * cosine**2
    votes = np.einsum("kn,kn->n", weight * np.sign(cosine), np.take(lean, near.number))
    return votes / np.maximum(weight.sum(axis=0), 1e-6)


def of_walls(near: Near, layer: Layer, normal: np.ndarray, spacing: np.ndarray, given: bool) -> np.ndarray:
    """A lean from another layer, nearer than anything can be seen between: a wall's sides face away from each other.

    A layer right under another, as under a sticker, is taken for a wall's inner side, and not seen from outside either;
    given normals tell the two apart.
    """
    cosine = along(around(near, normal), normal[near.rows].T)
    other = (-cosine if given else np.abs(cosine)) > PARALLEL
    wall = close(near, spacing[near.rows]) * other * (np.abs(layer.height) < WALL)
    scale = np.where(layer.scale > THINNEST, layer.scale, SHEET) if given else layer.scale
    above, below = (np.sum(wall * (sign * layer.height > APART * scale), axis=0) for sign in (1, -1))
    return SOLID * (below - above) / (above + below + EVIDENCE)


def outward(
    near: list[Near], layer: list[Layer], spacing: np.ndarray, given: bool, positions: np.ndarray, middle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normals that point outward (points, 3), and 1 where the votes say which side that is, 0 where they do not.

    Given normals have a side; they are turned only where the votes are clear.
    """
    normal = np.concatenate([of.normal for of in layer], axis=1).T
    normals, spacings = ([x] * len(near) for x in (normal, spacing))
    seen = visible_from(positions, normal, spacing, middle)
    front, back = facing(normal, seen)
    lean = (front - back) / (front + back + EVIDENCE)

    def vote(votes: np.ndarray) -> np.ndarray:
        return joined(voted, near, layer, normals, spacings, [votes] * len(near))

    towards = vote(np.clip(vote(lean) + joined(of_walls, near, layer, normals, spacings, [given] * len(near)), -1, 1))
    sided = np.clip((np.abs(towards) - UNSURE) / (SURE - UNSURE), 0, 1)
    wrong = towards < (-TURN if given else 0)
    normal = np.asfortranarray(np.where(wrong[:, None], -normal, normal))
    behind = np.where(wrong, front, back) > HIDDEN
    return normal, np.where(behind, np.minimum(sided, 1 - LEAK), sided)
