"""Points sampled on the surface of an object, with materials; and its normalisation.

Points are uniform by area over all parts, or evenly spread.  Materials are interpolated as by the renderer and
multiplied by the interpolated vertex colour; points in cut-out texels are drawn again.
"""

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.assets import CHANNELS, Asset, Part, lookup
from spnr_jax.kernels.cloud_arrays import farthest_points
from spnr_jax.kernels.triangles import face_crosses, tilt_normals, unit

Spread = Literal["random", "even"]
MOST_ROUNDS = 64  # of drawing points on a surface with cut-outs, before it counts as empty
CANDIDATES = 4  # points drawn for each kept point of an even spread


class SurfacePoints(NamedTuple):
    """Surface points: positions float64, unit normals, linear base colours (n, 3), materials float32, face (n,)."""

    positions: np.ndarray
    normals: np.ndarray
    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    face: np.ndarray


def bounding_box(asset: Asset) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner (3,) of the vertices that faces use; UserError if they have no extent."""
    corners = [part.positions[part.faces.ravel()] for part in asset.parts if len(part.faces)]
    if not corners:
        raise UserError("has no faces")
    used = np.concatenate(corners)
    if not np.isfinite(used).all():
        raise UserError("has vertices that are not finite (NaN or infinity)")
    low, high = used.min(axis=0), used.max(axis=0)
    if not np.linalg.norm(high - low) > 0:
        raise UserError("has zero extent: all its vertices lie in one point")
    return low, high


def normalise(asset: Asset) -> tuple[Asset, dict]:
    """The asset with its bounding-box centre at 0 and half of the box's diagonal 1, and the transform that did it.

    The transform is {"centre": [x, y, z], "scale": s}: normalised = (position - centre) * scale.
    """
    low, high = bounding_box(asset)
    centre, scale = (low + high) / 2, 2 / np.linalg.norm(high - low)
    parts = tuple(replace(part, positions=(part.positions - centre) * scale) for part in asset.parts)
    return replace(asset, parts=parts), {"centre": centre.tolist(), "scale": float(scale)}


def sample_surface(
    asset: Asset, num_points: int, seed: int, spread: Spread = "random", sides: bool = False
) -> SurfacePoints:
    """Points on all faces; deterministic for a seed.

    "random": uniform by area.  "even": farthest-point sampling of CANDIDATES times as many random points; each prefix
    is evenly spread, too.  With `sides`, the two sides of a thin wall are spread independently.
    """
    if num_points < 1:
        raise UserError(f"num_points must be at least 1, got {num_points}")
    if spread == "random":
        return _random_points(asset, num_points, seed)
    drawn = _random_points(asset, CANDIDATES * num_points, seed)
    places = drawn.positions.astype(np.float32)  # for distances, not for what is kept
    chosen = farthest_points(places, num_points, seed, drawn.normals if sides else None)
    return SurfacePoints(*(column[chosen] for column in drawn))


def _random_points(asset: Asset, num_points: int, seed: int) -> SurfacePoints:
    """Points uniform by area over the surface that is not cut out."""
    bounding_box(asset)
    rng = np.random.default_rng(seed)
    cumulative = np.cumsum(np.concatenate([face_areas(part) for part in asset.parts]))
    if not cumulative[-1] > 0:
        raise UserError("has no face with an area")
    first_face = np.cumsum([0, *(len(part.faces) for part in asset.parts)])
    rounds: list[SurfacePoints] = []
    while sum(len(points.face) for points in rounds) < num_points:
        if len(rounds) == MOST_ROUNDS:
            raise UserError("has next to no surface that its textures do not cut out")
        face = np.searchsorted(cumulative, rng.random(num_points) * cumulative[-1], side="right")
        face = np.minimum(face, np.searchsorted(cumulative, cumulative[-1]))  # the product may round up to the total
        root, along = rng.random((num_points, 2)).T ** [[0.5], [1]]
        barycentric = np.stack([1 - root, root * (1 - along), root * along], axis=-1)  # uniform over the triangle
        vectors, values = np.zeros((2, num_points, 3), np.float32), np.zeros((2, num_points), np.float32)
        points = SurfacePoints._make([np.zeros((num_points, 3)), *vectors, *values, face.astype(np.int32)])
        solid = np.ones(num_points, bool)
        for part, first in zip(asset.parts, first_face, strict=False):
            here = (face >= first) & (face < first + len(part.faces))
            sampled, solid[here] = _sample_part(part, face[here] - first, barycentric[here])
            for name, column in sampled.items():
                getattr(points, name)[here] = column
        rounds.append(SurfacePoints(*(column[solid] for column in points)))
    return SurfacePoints(*(np.concatenate(columns)[:num_points] for columns in zip(*rounds, strict=True)))


def vertex_points(asset: Asset) -> SurfacePoints:
    """All vertices as points of face -1, with the mean of their material; normals are 0 if there are none."""
    parts = []
    for part in asset.parts:
        look, shape = part.material, part.positions.shape
        color = look.base_color.reshape(-1, 3).mean(axis=0) * (1 if part.colors is None else part.colors)
        normals = np.zeros(shape) if part.normals is None else part.normals
        scalars = (np.full(shape[0], np.mean(value)) for value in (look.roughness, look.metallic, -1))
        parts.append(SurfacePoints(part.positions, normals, np.broadcast_to(color, shape), *scalars))
    return SurfacePoints(*map(np.concatenate, zip(*parts, strict=True)))


def face_areas(part: Part) -> np.ndarray:
    """Areas (f,) of a part's triangles."""
    return np.linalg.norm(face_crosses(part.positions, part.faces), axis=-1) / 2


def _sample_part(part: Part, face: np.ndarray, barycentric: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns of SurfacePoints, except `face`, at barycentric (n, 3) of faces (n,); and the mask of what is surface."""
    corners, look = part.faces[face], part.material

    def interpolate(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", barycentric, values[corners])

    texcoords = None if part.texcoords is None else interpolate(part.texcoords)
    found = {name: np.asarray(values) for name in CHANNELS if (values := getattr(look, name)) is not None}
    for name, values in found.items():
        if values.ndim > CHANNELS[name]:
            assert texcoords is not None, "a texture needs texture coordinates"
            found[name] = lookup(values, texcoords, look.wrap)
    opacity, normal_map = found.pop("opacity", None), found.pop("normal_map", None)
    if part.colors is not None:
        found["base_color"] = found["base_color"] * interpolate(part.colors)
    geometric = unit(face_crosses(part.positions, corners))
    normals = geometric if part.normals is None else unit(interpolate(part.normals), geometric)
    if normal_map is not None and part.texcoords is not None:
        normals = tilt_normals(normals, normal_map, part.positions[corners], part.texcoords[corners])
    solid = np.ones(len(face), bool) if opacity is None else opacity >= look.cutoff
    return {"positions": interpolate(part.positions), "normals": normals, **found}, solid
