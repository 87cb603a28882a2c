"""Surfels from points: what each point knows of the surface around it, once per object, near linear in the points.

NumPy in, NumPy out; neighbours come from SciPy's k-d tree, blocks of points bound the memory.

    spacing     side of the square that a point stands for, from the neighbours on its own layer of the surface
    normal      given, or the direction of least spread of the neighbours on the point's own layer (Hoppe et al. 1992,
                two reweighted rounds); its sign by a vote of the directions that see the point and its neighbours
    sided       1 where the votes say which side is outside, 0 where both are seen alike (a sheet)
    gradient    of the colour along the surface, a ridge regression over the layer: colours are interpolated to first
                order
    rim, reach  where the layer ends: a disc goes little further than the points of its layer
    shape       planarity and linearity: ratios of the neighbours' extents, 0 in a plane, 0 on a line
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from spnr_jax.kernels.cloud_arrays import bucket
from spnr_jax.kernels.records import Surfels
from spnr_jax.surfels.visibility import DIRECTIONS, grid_of, seen_from, tangents

NEIGHBOURS = 20  # of a point, itself among them
FIRST_DISC = 6  # neighbours within the disc whose area gives a first spacing
OWN_DISC = 5.0  # the same on the own layer, counted by their weights
REACH = 1.2  # spacings, standard deviation of the weight of a neighbour's distance
PAIRED = 6  # nearest points whose pairs span the planes that are tried
SLIVER = 0.2  # sine between two of them from which on they span one
FLAT = 0.1  # spacings from a plane at which a point supports it half
TRUSTED = 1.15  # the plane of least spread counts so much more: it is the better one where points are noisy
ROUNDS = 4  # of the quadric's fit
STIFF = (1e-3, 1e-3, 0.1, 0.1, 0.1)  # ridge of its slopes and curvatures
THICK, THINNEST = 0.3, 0.04  # spacings, most and least standard deviation of a neighbour's weight as one of the layer
START = 0.12  # the same in the first round
SPREADS = 2.0  # this deviation over the mean height of those that count
LOOSE = 2.0  # the same of the layer that colours and spacings come from, over that of the fit
APART, WALL = 3.0, 1.5  # deviations, and spacings, between which another layer is the other side of a wall
PARALLEL = 0.8  # cosine between their normals
STICKER, COVERING = 0.8, 2.0  # spacings, and neighbours above, from which on a layer covers a point
SOLID = 3.0  # weight of the wall's vote
SMOOTHED = 9  # neighbours over which the spacing is averaged
LEAST_SPACING = 1e-5  # in units of the box, for points that coincide
RIDGE = 0.15  # of the colour's regression, in spacings
TURN = 0.5  # votes against a given normal from which it is turned
HIDDEN = 0.4  # directions, counted by their cosines, that see a point at most that lies inside and is not drawn
LEAST_SHOWN = 0.3  # share of the points that has to be left
EVIDENCE = 1.0  # votes that a lean is measured against: few of them are none
UNSURE, SURE = 0.15, 0.45  # lean of the votes from which a side begins to count, and counts whole
RIM_DIRECTIONS = 16  # in which the end of a layer is looked for
RIM_WITHIN = 2.2  # spacings around a point
SHARP = 0.75  # cosine between normals below which two faces meet at an edge
EDGE = 0.1  # spacings that a disc goes beyond the line where another face cuts it
ALIGNED = 0.8  # cosine between a line's direction and one of the four
FAR = 4.0  # where a disc without an end ends
BEYOND = 0.25  # spacings that a surface goes beyond the last point of its layer
BLOCK = 2**16  # points that are worked on at once


class Near(NamedTuple):
    """Neighbours of a block of points: their numbers, distances, and the way to them."""

    number: Int[np.ndarray, "block k"]
    distance: Float[np.ndarray, "block k"]
    offset: Float[np.ndarray, "block k 3"]


def estimate(
    positions: Float[np.ndarray, "points 3"],
    base_color: Float[np.ndarray, "points 3"],
    roughness: Float[np.ndarray, " points"],
    metallic: Float[np.ndarray, " points"],
    normals: Float[np.ndarray, "points 3"] | None = None,
) -> Surfels:
    """Surfels of points in the box [-1, 1]^3, padded to a power of two; at least one point."""
    positions = np.asarray(positions, np.float32)
    tree = cKDTree(positions)
    blocks = [_neighbours(tree, positions, s) for s in range(0, len(positions), BLOCK)]
    raw = np.concatenate([_first_spacing(near) for near in blocks])
    rows = _split(len(positions))
    if normals is None:
        first = np.concatenate([_first_normals(near, raw[s]) for near, s in zip(blocks, rows, strict=True)])
    else:
        first = _unit(normals)
    fits = [_fitted(near, raw[s], first[s], normals is not None) for near, s in zip(blocks, rows, strict=True)]
    shape = np.concatenate([_shape(near, raw[s], f[1], f[2]) for near, s, f in zip(blocks, rows, fits, strict=True)])
    normal = np.concatenate([fit[0] for fit in fits])
    middle = float(np.median(raw))
    lean = _lean(normal, _visible(positions, normal, raw, middle))
    pairs = [(near, s, *fit[1:]) for near, s, fit in zip(blocks, rows, fits, strict=True)]
    lean = np.concatenate([_voted(*of, normal, raw, lean) for of in pairs])
    if normals is None:
        lean = np.clip(lean + np.concatenate([_of_walls(*of, normal, raw) for of in pairs]), -1, 1)
        lean = np.concatenate([_voted(*of, normal, raw, lean) for of in pairs])
    turned = lean < (-TURN if normals is not None else 0.0)
    sided = np.ones_like(lean) if normals is not None else np.clip((np.abs(lean) - UNSURE) / (SURE - UNSURE), 0, 1)
    normal = np.where(turned[:, None], -normal, normal)
    layers = [_layer(*of, normal, sided) for of in pairs]
    upwards = np.where(turned, -1, 1)[:, None]
    covered = np.concatenate([_covered(n, s, scale, upwards[s] * height, normal) for n, s, scale, height in pairs])
    spacing = np.concatenate([_own_spacing(n, s, w, raw) for n, s, w in zip(blocks, rows, layers, strict=True)])
    spacing = np.concatenate([_smoothed(n, w, spacing) for n, w in zip(blocks, layers, strict=True)])
    pairs = zip(blocks, rows, layers, strict=True)
    gradient = np.concatenate([_gradient(n, w, spacing[s], normal[s], base_color, s) for n, s, w in pairs])
    pairs = zip(blocks, rows, layers, strict=True)
    edges = [_rims(n, w, spacing[s], s, normal, sided) for n, s, w in pairs]
    rim, reach = (np.concatenate(parts) for parts in zip(*edges, strict=True))
    seen = _visible(positions, normal, spacing, middle)
    shown = _shown(normal, seen, covered)
    surfels = Surfels(
        position=positions,
        normal=normal,
        spacing=spacing,
        base_color=base_color,
        gradient=gradient,
        roughness=roughness,
        metallic=metallic,
        sided=sided,
        visible=np.concatenate([_averaged(n, w, seen) for n, w in zip(blocks, layers, strict=True)]),
        shape=shape,
        rim=rim,
        reach=reach,
        mask=np.ones(len(positions), bool),
    )
    return padded(Surfels(**{name: np.asarray(values)[shown] for name, values in vars(surfels).items()}))


def padded(surfels: Surfels) -> Surfels:
    """The surfels with zeros behind them up to a power of two."""
    columns = {}
    for name, values in vars(surfels).items():
        kind = bool if name == "mask" else np.float32
        extra = bucket(len(values)) - len(values)
        columns[name] = np.concatenate([np.asarray(values, kind), np.zeros((extra, *values.shape[1:]), kind)])
    columns["spacing"] = np.where(columns["mask"], columns["spacing"], 1).astype(np.float32)  # its logarithm is taken
    return Surfels(**columns)


def _split(count: int) -> list[slice]:
    return [slice(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]


def _neighbours(tree: cKDTree, positions: np.ndarray, first: int) -> Near:
    own = positions[first : first + BLOCK]
    distance, index = tree.query(own, min(NEIGHBOURS, len(positions)))
    distance, index = (x.reshape(len(own), -1) for x in (distance, index))
    return Near(index.astype(np.int32), distance.astype(np.float32), positions[index] - own[:, None])


def _first_spacing(near: Near) -> np.ndarray:
    """From the area of the disc that holds some neighbours, whatever layer they are on."""
    count = min(FIRST_DISC, near.number.shape[1] - 1)
    if count == 0:  # a single point stands for a tenth of the box
        return np.full(len(near.number), 0.1, np.float32)
    return np.maximum(np.sqrt(np.pi / count) * near.distance[:, count], LEAST_SPACING)


def _close(near: Near, spacing: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * (near.distance / (REACH * spacing[:, None])) ** 2)


def _in_plane(near: Near, normal: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates of the neighbours along two tangents and the normal, in spacings."""
    scaled = near.offset / spacing[:, None, None]
    one, two, three = (np.einsum("nki,ni->nk", scaled, axis) for axis in (*tangents(normal), normal))
    return one, two, three


def _spread(near: Near, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variances, rising, and axes of the weighted neighbours."""
    weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    centred = near.offset - np.einsum("nk,nki->ni", weight, near.offset)[:, None]
    return np.linalg.eigh(np.einsum("nk,nki,nkj->nij", weight, centred, centred, optimize=True))


def _first_normals(near: Near, spacing: np.ndarray) -> np.ndarray:
    """Of the planes through a point that two of its nearest span, and the one of least spread, that with most points.

    So a point at an edge gets the plane of one of the faces, not one between them.
    """
    weight = _close(near, spacing)
    best = _spread(near, weight)[1][..., 0].astype(np.float32)
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


def _unit(vectors: np.ndarray) -> np.ndarray:
    """The vectors at length 1; straight up where there is none."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(size > 0.5, vectors / np.where(size > 0.5, size, 1), [0, 1, 0]).astype(np.float32)


def _fitted(
    near: Near, spacing: np.ndarray, normal: np.ndarray, given: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit normals of either sign, the layers' scale, and the height of each neighbour over a point's layer.

    The layer is a quadric through the point (Cazals and Pouget 2003), fitted in rounds to the neighbours that lie close
    to it; lengths are spacings.  Given normals are kept.
    """
    weight = _close(near, spacing)
    scale = np.full(len(normal), START, np.float32)
    height = _in_plane(near, normal, spacing)[2]
    for _ in range(ROUNDS):
        one, two, up = _in_plane(near, normal, spacing)
        own = weight * np.exp(-0.5 * (height / scale[:, None]) ** 2)
        terms = np.stack([one, two, one * one, one * two, two * two], axis=-1)
        weighted = (own[..., None] * terms).swapaxes(1, 2)
        solution = np.linalg.solve(weighted @ terms + np.diag(STIFF), weighted @ up[..., None])
        if given:
            solution[:, :2] = 0
        height = up - (terms @ solution)[..., 0]
        first, second = tangents(normal)
        normal = normal - solution[:, 0] * first - solution[:, 1] * second
        normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
        away = np.sum(own * np.abs(height), axis=1) / np.maximum(own.sum(axis=1) - 1, 0.5)  # the point itself is at 0
        scale = np.clip(SPREADS * away, THINNEST, THICK).astype(np.float32)
    return normal, scale, height.astype(np.float32)


def _shape(near: Near, spacing: np.ndarray, scale: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Ratios of the extents of the layer's neighbours."""
    own = _close(near, spacing) * np.exp(-0.5 * (height / scale[:, None]) ** 2)
    extent = np.sqrt(np.maximum(_spread(near, own + 1e-6)[0], 0))
    return (extent[:, :2] / np.maximum(extent[:, 1:], 1e-6)).astype(np.float32)


def _visible(positions: np.ndarray, normal: np.ndarray, spacing: np.ndarray, middle: float) -> np.ndarray:
    size, count = bucket(len(positions)), len(positions)

    def pad(values):
        return jnp.asarray(np.concatenate([values, np.zeros((size - count, *values.shape[1:]), values.dtype)]))

    cell, grid = grid_of(middle)
    bounded = np.clip(spacing, middle / 2, 2 * middle).astype(np.float32)
    mask = jnp.arange(size) < count
    seen = seen_from(pad(positions), pad(normal), pad(bounded), mask, jnp.float32(cell), grid=grid)
    return np.asarray(seen)[:count]


def _shown(normal: np.ndarray, seen: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Which points something outside sees; all, where that would leave too few."""
    shown = ~covered & (np.einsum("nd,nd->n", seen, np.abs(normal @ DIRECTIONS.T)) > HIDDEN)
    return shown if shown.mean() > LEAST_SHOWN else np.ones_like(shown)


def _lean(normal: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """From -1 to 1: how much more is seen of the side that the normal points to than of the other."""
    cosines = normal @ DIRECTIONS.T
    front, back = (np.einsum("nd,nd->n", seen, np.maximum(side, 0)) for side in (cosines, -cosines))
    return (front - back) / (front + back + EVIDENCE)


def _voted(
    near: Near,
    rows: slice,
    scale: np.ndarray,
    height: np.ndarray,
    normal: np.ndarray,
    spacing: np.ndarray,
    lean: np.ndarray,
) -> np.ndarray:
    """The lean of each point and of its neighbours on the same layer, whichever way their normals point."""
    along = np.einsum("nki,ni->nk", normal[near.number], normal[rows])
    weight = _close(near, spacing[rows]) * along**2 * np.exp(-0.5 * (height / scale[:, None]) ** 2)
    return np.einsum("nk,nk->n", weight * np.sign(along), lean[near.number]) / np.maximum(weight.sum(axis=1), 1e-6)


def _of_walls(
    near: Near, rows: slice, scale: np.ndarray, height: np.ndarray, normal: np.ndarray, spacing: np.ndarray
) -> np.ndarray:
    """A lean from another layer, nearer than anything can be seen between: a wall's sides face away from each other.

    A layer right under another, as under a sticker, is taken for a wall's inner side, and not seen from outside either.
    """
    along = np.einsum("nki,ni->nk", normal[near.number], normal[rows])
    wall = _close(near, spacing[rows]) * (np.abs(along) > PARALLEL) * (np.abs(height) < WALL)
    above, below = (np.sum(wall * (sign * height > APART * scale[:, None]), axis=1) for sign in (1, -1))
    return SOLID * (below - above) / (above + below + EVIDENCE)


def _covered(near: Near, rows: slice, scale: np.ndarray, height: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Whether another layer that faces the same way lies right above a point, as a sticker does; see `_voted`."""
    alike = np.einsum("nki,ni->nk", normal[near.number], normal[rows]) > PARALLEL
    farthest = np.maximum(near.distance[:, -1:], LEAST_SPACING)
    other = alike * np.exp(-0.5 * (near.distance / farthest) ** 2) * (np.abs(height) < STICKER)
    above, below = (np.sum(other * (sign * height > APART * scale[:, None]), axis=1) for sign in (1, -1))
    return above > np.maximum(COVERING, 2 * below)


def _layer(
    near: Near, rows: slice, scale: np.ndarray, height: np.ndarray, normal: np.ndarray, sided: np.ndarray
) -> np.ndarray:
    """Weight of each neighbour as one of the same layer: near the quadric, and turned to the same side."""
    along = np.einsum("nki,ni->nk", normal[near.number], normal[rows])
    weight = np.exp(-0.5 * (height / (LOOSE * scale[:, None])) ** 2)
    weight = weight * np.where(sided[rows, None] > 0.5, np.clip(0.5 + along, 0, 1), 1)
    weight[:, 0] = 1
    return weight


def _own_spacing(near: Near, rows: slice, layer: np.ndarray, raw: np.ndarray) -> np.ndarray:
    """From the area of the disc that holds OWN_DISC neighbours of the layer."""
    raw = raw[rows]
    if near.number.shape[1] == 1:
        return raw
    held = np.cumsum(layer[:, 1:], axis=1)
    wanted = np.minimum(OWN_DISC, np.maximum(held[:, -1] * 0.6, 0.5))
    last = np.minimum((held < wanted[:, None]).sum(axis=1) + 1, near.number.shape[1] - 1)
    row = np.arange(len(raw))
    spacing = np.sqrt(np.pi / np.maximum(held[row, last - 1], 1)) * near.distance[row, last]
    return np.clip(spacing, 0.5 * raw, 1.6 * raw)


def _smoothed(near: Near, layer: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Geometric mean over the nearest of the layer."""
    weight = layer[:, :SMOOTHED]
    logarithm = np.log(np.maximum(spacing, LEAST_SPACING))[near.number[:, :SMOOTHED]]
    return np.exp((weight * logarithm).sum(axis=1) / weight.sum(axis=1)).astype(np.float32)


def _averaged(near: Near, layer: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Mean over the nearest of the layer: a depth buffer of points is noisy."""
    weight = layer[:, :SMOOTHED] / layer[:, :SMOOTHED].sum(axis=1, keepdims=True)
    return sum(weight[:, k, None] * seen[near.number[:, k]] for k in range(weight.shape[1])).astype(np.float32)


def _rims(
    near: Near, layer: np.ndarray, spacing: np.ndarray, rows: slice, normal: np.ndarray, sided: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The direction in which the layer ends soonest, and where it ends, in spacings, along `Surfels.reach`.

    It ends a little beyond its last point; at a sharp edge where the plane of the other face cuts it (clip lines,
    Zwicker et al. 2004).
    """
    own, others = normal[rows], normal[near.number]
    one, two, _ = _in_plane(near, own, spacing)
    there = (layer > 0.5) & (near.distance < RIM_WITHIN * spacing[:, None])
    turn = (2 * np.pi / RIM_DIRECTIONS * np.arange(RIM_DIRECTIONS)).astype(np.float32)
    ends = np.stack([(there * (one * np.cos(t) + two * np.sin(t))).max(axis=1) for t in turn], axis=1) + BEYOND
    first, second = tangents(own)
    across, up = (np.einsum("nki,ni->nk", others, t) for t in (first, second))
    flat = np.hypot(across, up)
    line = np.einsum("nki,nki->nk", others, near.offset) / spacing[:, None] / np.maximum(flat, 1e-6)
    edge = (np.einsum("nki,ni->nk", others, own) < SHARP) & (line > 0) & (near.distance < RIM_WITHIN * spacing[:, None])
    edge &= (sided[near.number] > 0.5) & (sided[rows, None] > 0.5) & (flat > 0.3)
    line = np.where(edge, line + EDGE, np.inf)
    nearest, row = line.argmin(axis=1), np.arange(len(own))
    soonest = ends.argmin(axis=1)
    cut = line[row, nearest] < ends[row, soonest] + BEYOND
    angle = np.where(cut, np.arctan2(up[row, nearest], across[row, nearest]), turn[soonest])
    reach = []
    for quarter in (0, 2, 1, 3):
        way = angle + quarter * np.pi / 2
        step = np.round(way / (2 * np.pi) * RIM_DIRECTIONS).astype(np.int64) % RIM_DIRECTIONS
        cosine = (across * np.cos(way)[:, None] + up * np.sin(way)[:, None]) / np.maximum(flat, 1e-6)
        lines = np.where(cosine > ALIGNED, line, np.inf).min(axis=1)
        reach.append(np.where(np.isfinite(lines), lines, ends[row, step]))
    rim = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    return rim.astype(np.float32), np.minimum(np.stack(reach, axis=1), FAR).astype(np.float32)


def _gradient(
    near: Near, layer: np.ndarray, spacing: np.ndarray, normal: np.ndarray, color: np.ndarray, rows: slice
) -> np.ndarray:
    """Change of each colour along x, y, z (block, colour, axis): weighted least squares in the tangent plane."""
    first, second = tangents(normal)
    plane = np.stack([np.einsum("nki,ni->nk", near.offset, t) for t in (first, second)], axis=-1)
    inputs = np.concatenate([np.ones((*near.number.shape, 1), np.float32), plane / spacing[:, None, None]], axis=-1)
    weight = layer * np.exp(-0.5 * (near.distance / spacing[:, None]) ** 2)
    weight[:, 0] = 1
    weighted = (weight[..., None] * inputs).swapaxes(1, 2)
    normal_equations = weighted @ inputs + np.diag([1e-6, RIDGE, RIDGE])
    slopes = np.linalg.solve(normal_equations, weighted @ (color[near.number] - color[rows, None]))[:, 1:]
    along = slopes[:, 0, :, None] * first[:, None] + slopes[:, 1, :, None] * second[:, None]
    return along / spacing[:, None, None]
