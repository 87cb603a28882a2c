"""Surfels from points: what each point knows of the surface around it, once per object, near linear in the points.

NumPy in, NumPy out; neighbours come from SciPy's k-d tree, blocks of points bound the memory.

    spacing     side of the square that a point stands for, from the neighbours on its own layer of the surface
    normal      given, or the direction of least spread of the neighbours on the point's own layer (Hoppe et al. 1992,
                two reweighted rounds); its sign by a vote of the directions that see the point and its neighbours
    sided       1 where the votes say which side is outside, 0 where both are seen alike (a sheet)
    gradient    of the colour along the surface, a ridge regression over the layer: colours are interpolated to first
                order
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
LAYER = 0.5  # spacings, standard deviation of the weight of a neighbour's height over the tangent plane
THIN = 0.35  # the same while the normal is being found
SMOOTHED = 9  # neighbours over which the spacing is averaged
LEAST_SPACING = 1e-5  # in units of the box, for points that coincide
RIDGE = 0.15  # of the colour's regression, in spacings
TURN = 0.5  # votes against a given normal from which it is turned
HIDDEN = 0.4  # directions, counted by their cosines, that see a point at most that lies inside and is not drawn
LEAST_SHOWN = 0.3  # share of the points that has to be left
EVIDENCE = 1.0  # votes that a lean is measured against: few of them are none
UNSURE, SURE = 0.15, 0.45  # lean of the votes from which a side begins to count, and counts whole
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
    found = [
        _normals(near, raw[s], None if normals is None else normals[s]) for near, s in zip(blocks, rows, strict=True)
    ]
    normal, shape = (np.concatenate(parts) for parts in zip(*found, strict=True))
    middle = float(np.median(raw))
    seen = _visible(positions, normal, raw, middle)
    lean = _lean(normal, seen)
    lean = np.concatenate([_voted(near, s, normal, raw, lean) for near, s in zip(blocks, rows, strict=True)])
    turned = lean < (-TURN if normals is not None else 0.0)
    sided = np.ones_like(lean) if normals is not None else np.clip((np.abs(lean) - UNSURE) / (SURE - UNSURE), 0, 1)
    normal = np.where(turned[:, None], -normal, normal)
    layers = [_layer(near, s, normal, raw, sided) for near, s in zip(blocks, rows, strict=True)]
    spacing = np.concatenate([_own_spacing(n, s, w, raw) for n, s, w in zip(blocks, rows, layers, strict=True)])
    spacing = np.concatenate([_smoothed(n, w, spacing) for n, w in zip(blocks, layers, strict=True)])
    pairs = zip(blocks, rows, layers, strict=True)
    gradient = np.concatenate([_gradient(n, w, spacing[s], normal[s], base_color, s) for n, s, w in pairs])
    seen = _visible(positions, normal, spacing, middle)
    shown = _shown(normal, seen)
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


def _spread(near: Near, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variances, rising, and axes of the weighted neighbours."""
    weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    centred = near.offset - np.einsum("nk,nki->ni", weight, near.offset)[:, None]
    return np.linalg.eigh(np.einsum("nk,nki,nkj->nij", weight, centred, centred, optimize=True))


def _close(near: Near, spacing: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * (near.distance / (REACH * spacing[:, None])) ** 2)


def _height(near: Near, normal: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Of the neighbours over the tangent plane, in spacings."""
    return np.einsum("nki,ni->nk", near.offset, normal) / spacing[:, None]


def _normals(near: Near, spacing: np.ndarray, given: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals of either sign, and the shape of the neighbourhood."""
    weight = _close(near, spacing)
    variance, axes = _spread(near, weight)
    normal = axes[..., 0]
    if given is not None:
        size = np.linalg.norm(given, axis=1, keepdims=True)
        normal = np.where(size > 0.5, given / np.where(size > 0.5, size, 1), normal)
    else:
        for _ in range(2):
            flat = np.exp(-0.5 * (_height(near, normal, spacing) / THIN) ** 2)
            variance, axes = _spread(near, weight * flat + 1e-6)
            normal = axes[..., 0]
    extent = np.sqrt(np.maximum(variance, 0))
    shape = extent[:, :2] / np.maximum(extent[:, 1:], 1e-6)
    return normal.astype(np.float32), shape.astype(np.float32)


def _visible(positions: np.ndarray, normal: np.ndarray, spacing: np.ndarray, middle: float) -> np.ndarray:
    size, count = bucket(len(positions)), len(positions)

    def pad(values):
        return jnp.asarray(np.concatenate([values, np.zeros((size - count, *values.shape[1:]), values.dtype)]))

    cell, grid = grid_of(middle)
    bounded = np.clip(spacing, middle / 2, 2 * middle).astype(np.float32)
    mask = jnp.arange(size) < count
    seen = seen_from(pad(positions), pad(normal), pad(bounded), mask, jnp.float32(cell), grid=grid)
    return np.asarray(seen)[:count]


def _shown(normal: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Which points something outside sees; all, where that would leave too few."""
    shown = np.einsum("nd,nd->n", seen, np.abs(normal @ DIRECTIONS.T)) > HIDDEN
    return shown if shown.mean() > LEAST_SHOWN else np.ones_like(shown)


def _lean(normal: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """From -1 to 1: how much more is seen of the side that the normal points to than of the other."""
    cosines = normal @ DIRECTIONS.T
    front, back = (np.einsum("nd,nd->n", seen, np.maximum(side, 0)) for side in (cosines, -cosines))
    return (front - back) / (front + back + EVIDENCE)


def _voted(near: Near, rows: slice, normal: np.ndarray, spacing: np.ndarray, lean: np.ndarray) -> np.ndarray:
    """The lean of each point and of its neighbours on the same layer, whichever way their normals point."""
    along = np.einsum("nki,ni->nk", normal[near.number], normal[rows])
    flat = np.exp(-0.5 * (_height(near, normal[rows], spacing[rows]) / LAYER) ** 2)
    weight = _close(near, spacing[rows]) * along**2 * flat
    votes = np.einsum("nk,nk->n", weight * np.sign(along), lean[near.number])
    return votes / np.maximum(weight.sum(axis=1), 1e-6)


def _layer(near: Near, rows: slice, normal: np.ndarray, spacing: np.ndarray, sided: np.ndarray) -> np.ndarray:
    """Weight of each neighbour as one of the same layer: near the plane, and turned to the same side."""
    along = np.einsum("nki,ni->nk", normal[near.number], normal[rows])
    weight = np.exp(-0.5 * (_height(near, normal[rows], spacing[rows]) / LAYER) ** 2)
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
