"""Surfels from points: what each point knows of the surface around it, once per object, near linear in the points.

spacing     side of the square that a point stands for, from the neighbours on its own layer of the surface
normal      given, or that of the layer (layers.py), outward by the votes of directions and walls (sides.py)
sided       1 where the votes say which side is outside, 0 where both are seen alike (a sheet)
gradient    of the colour along the surface, a ridge regression over the layer: colours are interpolated to first
            order
rim, reach  where the disc ends: at the rim of the layer or where another face cuts it (rims.py)
shape       planarity and linearity: ratios of the neighbours' extents, 0 in a plane, 0 on a line
"""

import numpy as np
from jaxtyping import Float

from spnr_jax.kernels.cloud_arrays import bucket
from spnr_jax.kernels.records import Surfels
from spnr_jax.surfels import layers, sides
from spnr_jax.surfels.neighbours import LEAST_SPACING, Near, each, first_spacing, joined, neighbourhoods
from spnr_jax.surfels.rims import EVEN, bridged, evenness, rims
from spnr_jax.surfels.visibility import tangents

OWN_DISC = 5.5  # neighbours, by their weights, in the disc that gives the spacing; sums of ones jump at whole numbers
SMOOTHED = 9  # neighbours over which the spacing is averaged
RIDGE = 0.15  # of the colour's regression, in spacings


def estimate(
    positions: Float[np.ndarray, "points 3"],
    base_color: Float[np.ndarray, "points 3"],
    roughness: Float[np.ndarray, " points"],
    metallic: Float[np.ndarray, " points"],
    normals: Float[np.ndarray, "points 3"] | None = None,
    materials_known: Float[np.ndarray, " points"] | None = None,
) -> Surfels:
    """Surfels of points in the box [-1, 1]^3, padded to a power of two; at least one point."""
    return padded(
        *_columns(np.asarray(positions, np.float32), base_color, roughness, metallic, normals, materials_known)
    )


def _columns(
    positions: np.ndarray,
    base_color: np.ndarray,
    roughness: np.ndarray,
    metallic: np.ndarray,
    normals: np.ndarray | None,
    materials_known: np.ndarray | None,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The fields of `Surfels` for all points, and which of them are drawn; what they were made of is let go."""
    near = neighbourhoods(positions)

    def all_of(*arrays: np.ndarray) -> list[list[np.ndarray]]:
        return [[array] * len(near) for array in arrays]

    raw = joined(first_spacing, near)
    middle, given = float(np.median(raw)), normals is not None
    first = joined(layers.first_normals, near, *all_of(raw)) if normals is None else _unit(normals)
    layer = each(layers.fitted, near, *all_of(raw, first), [given] * len(near))
    normal, sided = sides.outward(near, layer, raw, given, positions, middle)
    weight = each(layers.weights, near, layer, *all_of(normal, sided))
    spacing = joined(_own_spacing, near, weight, *all_of(raw))
    spacing = joined(_smoothed, near, weight, *all_of(spacing))
    if np.median(joined(evenness, near, weight, *all_of(spacing))) < EVEN:
        spacing = joined(bridged, near, weight, *all_of(spacing, normal))
    rim, reach = joined(rims, near, weight, *all_of(spacing, normal, sided))
    seen = sides.visible_from(positions, normal, spacing, middle)
    shown = sides.shown(normal, seen, joined(layers.covered, near, layer, *all_of(normal)))
    columns = {
        "position": positions,
        "normal": normal,
        "spacing": spacing,
        "base_color": base_color,
        "gradient": joined(_gradient, near, weight, *all_of(spacing, normal, base_color)),
        "roughness": roughness,
        "metallic": metallic,
        "guessed": np.zeros(len(positions)) if materials_known is None else 1 - materials_known,
        "sided": sided,
        "visible": joined(_averaged, near, weight, *all_of(seen)),
        "shape": joined(layers.shape_of, near, layer, *all_of(raw)),
        "rim": rim,
        "reach": reach,
        "mask": np.ones(len(positions), bool),
    }
    return columns, shown


def padded(columns: dict[str, np.ndarray], drawn: np.ndarray) -> Surfels:
    """Surfels of the points that are drawn, zeros behind them up to a power of two; the columns are taken out."""
    count = int(drawn.sum())
    whole = {}
    for name in tuple(columns):
        values = columns.pop(name)
        kind = bool if name == "mask" else np.float32
        whole[name] = np.zeros((bucket(count), *values.shape[1:]), kind)
        whole[name][:count] = values[drawn]
    whole["spacing"][count:] = 1  # its logarithm is taken
    return Surfels(**whole)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """The vectors at length 1; straight up where there is none."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(size > 0.5, vectors / np.where(size > 0.5, size, 1), [0, 1, 0]).astype(np.float32)


def _own_spacing(near: Near, layer: np.ndarray, raw: np.ndarray) -> np.ndarray:
    """From the area of the disc that holds OWN_DISC neighbours of the layer."""
    raw = raw[near.rows]
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


def _gradient(near: Near, layer: np.ndarray, spacing: np.ndarray, normal: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Change of each colour along x, y, z (block, colour, axis): weighted least squares in the tangent plane."""
    spacing, own = spacing[near.rows], color[near.rows]
    first, second = tangents(normal[near.rows])
    plane = np.stack([np.einsum("nki,ni->nk", near.offset, t) for t in (first, second)], axis=-1)
    inputs = np.concatenate([np.ones((*near.number.shape, 1), np.float32), plane / spacing[:, None, None]], axis=-1)
    weight = layer * np.exp(-0.5 * (near.distance / spacing[:, None]) ** 2)
    weight[:, 0] = 1
    weighted = (weight[..., None] * inputs).swapaxes(1, 2)
    normal_equations = weighted @ inputs + np.diag([1e-6, RIDGE, RIDGE])
    slopes = np.linalg.solve(normal_equations, weighted @ (color[near.number] - own[:, None]))[:, 1:]
    along = slopes[:, 0, :, None] * first[:, None] + slopes[:, 1, :, None] * second[:, None]
    return along / spacing[:, None, None]
