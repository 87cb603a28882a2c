"""Surfels from points: what each point knows of the surface around it, once per object, near linear in the points.

spacing     side of the square that a point stands for, from the neighbours on its own layer of the surface
normal      given, or that of the layer (layers.py), outward by the votes of directions and walls (sides.py)
sided       1 where the votes say which side is outside, 0 where both are seen alike (a sheet)
gradient    of the colour along the surface, a ridge regression over the layer: colours are interpolated to first
            order, but for points beside the border of two colours (borders.py)
rim, reach  where the disc ends: at the rim of the layer or where another face cuts it (rims.py)
shape       planarity and linearity: ratios of the neighbours' extents, 0 in a plane, 0 on a line
"""

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from spnr_jax.kernels.cloud_arrays import bucket
from spnr_jax.kernels.records import Surfels
from spnr_jax.surfels import layers, sheets, sides
from spnr_jax.surfels.borders import borders
from spnr_jax.surfels.neighbours import (
    LEAST_SPACING,
    Near,
    along,
    around,
    each,
    first_spacing,
    frame,
    in_order_of_space,
    joined,
    neighbourhoods,
)
from spnr_jax.surfels.rims import EVEN, bridged, evenness, rims
from spnr_jax.surfels.small_systems import solved

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
    order = in_order_of_space(positions)

    def ordered(values: np.ndarray) -> np.ndarray:
        return np.asfortranarray(np.asarray(values, np.float32)[order])

    given = (ordered(x) for x in (positions, base_color, roughness, metallic))
    columns, shown = _columns(*given, *(None if x is None else ordered(x) for x in (normals, materials_known)))
    place = np.argsort(order)
    return padded(columns, place[shown[place]])


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
    first = joined(layers.first_normals, near, *all_of(raw)) if normals is None else np.asfortranarray(_unit(normals))
    layer = each(layers.fitted, near, *all_of(raw, first), [given] * len(near), [given] * len(near))
    if normals is None:
        layer = sheets.parted(near, layer, raw, base_color)
    normal, sided = sides.outward(near, layer, raw, given, positions, middle)
    weight = each(layers.weights, near, layer, *all_of(normal, sided))
    spacing = joined(_own_spacing, near, weight, *all_of(raw))
    spacing = joined(_smoothed, near, weight, *all_of(spacing))
    if np.median(joined(evenness, near, weight, *all_of(spacing))) < EVEN:
        spacing = joined(bridged, near, weight, *all_of(spacing, normal))
    rim, reach = joined(rims, near, weight, *all_of(spacing, normal, sided))
    seen = sides.visible_from(positions, normal, spacing, middle)
    shown = sides.shown(normal, seen, joined(layers.covered, near, layer, *all_of(normal)))
    border, jump, sure = joined(borders, near, weight, *all_of(spacing, normal, base_color))
    gradient = joined(_gradient, near, weight, *all_of(spacing, normal, base_color))
    columns = {
        "position": positions,
        "normal": normal,
        "spacing": spacing,
        "base_color": base_color,
        "gradient": (1 - sure[:, None, None]) * gradient,
        "border": border,
        "jump": jump,
        "roughness": roughness,
        "metallic": metallic,
        "guessed": np.zeros(len(positions)) if materials_known is None else 1 - materials_known,
        "sided": sided,
        "visible": _averaged(near, weight, seen),
        "shape": joined(layers.shape_of, near, layer, *all_of(raw)),
        "rim": rim,
        "reach": reach,
        "mask": np.ones(len(positions), bool),
    }
    return columns, shown


def padded(columns: dict[str, np.ndarray], drawn: np.ndarray) -> Surfels:
    """Surfels of the points of these numbers, zeros behind them up to a power of two; the columns are taken out."""
    count = len(drawn)
    whole = {}
    for name in tuple(columns):
        values = columns.pop(name)
        kind = bool if name == "mask" else np.float32
        whole[name] = np.zeros((bucket(count), *values.shape[1:]), kind)
        np.take(np.asarray(values, kind), drawn, axis=0, out=whole[name][:count], mode="clip")  # whose mode copies none
    whole["spacing"][count:] = 1  # its logarithm is taken
    return Surfels(**whole)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """The vectors at length 1; straight up where there is none."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(size > 0.5, vectors / np.where(size > 0.5, size, 1), [0, 1, 0]).astype(np.float32)


def _own_spacing(near: Near, layer: np.ndarray, raw: np.ndarray) -> np.ndarray:
    """From the area of the disc that holds OWN_DISC neighbours of the layer."""
    raw = raw[near.rows]
    if len(near.number) == 1:
        return raw
    held = np.cumsum(layer[1:], axis=0)
    wanted = np.minimum(OWN_DISC, np.maximum(held[-1] * 0.6, 0.5))
    last = np.minimum((held < wanted).sum(axis=0) + 1, len(near.number) - 1)
    row = np.arange(len(raw))
    spacing = np.sqrt(np.pi / np.maximum(held[last - 1, row], 1)) * near.distance[last, row]
    return np.clip(spacing, 0.5 * raw, 1.6 * raw)


def _smoothed(near: Near, layer: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Geometric mean over the nearest of the layer."""
    weight = layer[:SMOOTHED]
    logarithm = np.log(np.maximum(np.take(spacing, near.number[:SMOOTHED]), LEAST_SPACING))
    return np.exp(np.sum(weight * logarithm, axis=0) / weight.sum(axis=0))


def _averaged(near: list[Near], layer: list[np.ndarray], seen: np.ndarray) -> np.ndarray:
    """Mean over the nearest of the layer: a depth buffer of points is noisy.  All blocks are one sparse matrix."""
    number = np.concatenate([block.number[:SMOOTHED] for block in near], axis=1)
    weight = np.concatenate([block[:SMOOTHED] for block in layer], axis=1)
    weight /= weight.sum(axis=0)
    ends = np.arange(0, weight.size + 1, len(weight), dtype=np.int32)
    return csr_array((weight.ravel("F"), number.ravel("F"), ends), shape=(len(seen), len(seen))) @ seen


def _gradient(near: Near, layer: np.ndarray, spacing: np.ndarray, normal: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Change of each colour along x, y, z (block, colour, axis): weighted least squares in the tangent plane."""
    spacing, (first, second, _) = spacing[near.rows], frame(normal[near.rows].T)
    plane = (along(near.offset, axis / spacing) for axis in (first, second))
    inputs = np.stack([np.ones_like(near.distance), *plane])
    weight = layer * np.exp(-0.5 * (near.distance / spacing) ** 2)
    weight[0] = 1
    change = around(near, color) - color[near.rows].T[:, None]
    sums = np.einsum("ikn,jkn->ijn", weight * inputs, np.concatenate([inputs, change]))
    ridge = np.diag(np.array([1e-6, RIDGE, RIDGE], np.float32))[..., None]
    slopes = solved(sums[:, :3] + ridge, sums[:, 3:])[1:] / spacing
    return np.einsum("tcn,tin->nci", slopes, np.stack([first, second]))
