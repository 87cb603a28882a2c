"""Normals of the points that are kept of a dense cloud, from all of it: thinned points alone know them worse."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spnr_jax.devices.runtime import QUICKEST
from spnr_jax.kernels import cloud_arrays
from spnr_jax.kernels.cleaning import Cleaned
from spnr_jax.kernels.facing import planes
from spnr_jax.kernels.records import PointCloud
from spnr_jax.surfels import geometry
from spnr_jax.surfels.geometry import Points
from spnr_jax.surfels.neighbors import order_in_space

VOTERS = 2**15  # points that votes are taken of, those that are kept among them


def thinned(points: Cleaned, kept: Int[np.ndarray, " points"]) -> PointCloud:
    """The points of these numbers, (points, ...) float32; with normals from all where the columns have none.

    Where all are kept normals are not looked for: what draws the cloud estimates them from the same points.
    """
    values = {name: column[kept] for name, column in points.values.items()}
    if "normals" not in values and len(kept) < len(points.positions):
        values["normals"] = outward_normals(points.positions, points.values["base_color"], kept, points.noise)
    columns = {name: np.asarray(column, np.float32) for name, column in values.items()}
    positions = points.positions[kept].astype(np.float32)
    return PointCloud(positions=positions, mask=np.ones(len(kept), bool), **columns)


def outward_normals(
    positions: Float[np.ndarray, "all 3"],
    base_color: Float[np.ndarray, "all 3"],
    kept: Int[np.ndarray, " points"],
    noise: float = 0.0,
) -> Float[np.ndarray, "points 3"]:
    """Unit normals of the points of these numbers; outward by the votes of directions and walls (sides.py).

    Linear colors tell sheets apart that nearly touch; `noise` is that of `planes`.
    """
    rest = np.setdiff1d(np.arange(len(positions)), kept)
    others = max(0, VOTERS - len(kept))
    voters = np.concatenate([kept, np.random.default_rng(0).permutation(rest)[:others]])
    low, high = positions.min(axis=0), positions.max(axis=0)
    half = np.linalg.norm(high - low) / 2 or 1.0
    places = np.asarray((positions[voters] - (low + high) / 2) / half, np.float32)  # in the box
    order, near = order_in_space(places)
    size = cloud_arrays.bucket(len(order))

    def columns(values: np.ndarray, fill: int = 0) -> Array:
        return jnp.asarray(np.pad(values.T, [(0, 0), (0, size - len(order))], constant_values=fill))

    color = np.asarray(base_color[voters], np.float32)
    normal = np.asarray(planes(positions[voters], positions, noise), np.float32)
    points = Points(
        number=columns(near, -1),
        mask=jnp.arange(size) < len(order),
        given=jnp.zeros(size, bool),  # with a side
        position=columns(places[order]),
        color=columns(color[order]),
    )
    found = np.empty_like(places)
    found[order] = np.asarray(_turn(points, columns(normal[order])))[:, : len(order)].T
    return found[: len(kept)]


@partial(jax.jit, compiler_options=QUICKEST)
def _turn(points: Points, normals: Float[Array, "3 points"]) -> Float[Array, "3 points"]:
    """The normals that are given, but for those of sheets, outward."""
    raw, layer = geometry.find_layers(points, normals, sided=False, sheets=True)
    seen = geometry.look(points, layer.normal, raw)
    return geometry.find_sides(points, raw, layer, seen)[0]
