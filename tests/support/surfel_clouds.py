"""Clouds whose normals and spacing are known, surfels and cameras made by hand, for tests of `spnr_jax.surfels`."""

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.kernels import cameras
from spnr_jax.kernels.cloud_arrays import pad
from spnr_jax.kernels.records import Camera, PointCloud, Surfels
from spnr_jax.surfels.constants import CONSTANTS
from spnr_jax.surfels.geometry import estimate_surfels
from spnr_jax.surfels.neighbors import neighbors
from spnr_jax.surfels.sides import NUM_DIRECTIONS, spiral

PADDED = (4096, 32768)  # sizes that clouds are padded to: each is compiled once, and blocks of padding cost nothing


def even_square(count: int) -> np.ndarray:
    """Points (count, 2) in [-1, 1)^2: Roberts' R2 sequence."""
    ratio = 1.32471795724474602596  # x^3 = x + 1
    return 2 * ((np.arange(1, count + 1)[:, None] / ratio ** np.arange(1, 3)) % 1) - 1


def shape(name: str, count: int, spread: str = "even") -> tuple[np.ndarray, np.ndarray, float]:
    """Positions, outward normals (either for `plane`) and the square root of the area per point."""
    rng = np.random.default_rng(count)
    u, v = (even_square(count) if spread == "even" else rng.uniform(-1, 1, (count, 2))).T
    if name == "sphere":
        normals = spiral(count) if spread == "even" else rng.normal(size=(count, 3))
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        positions, area = 0.6 * normals, 4 * np.pi * 0.6**2
    elif name == "rod":
        normals = np.stack([np.cos(np.pi * u), np.sin(np.pi * u), 0 * u], axis=1)
        positions, area = 0.15 * normals + v[:, None] * [0, 0, 0.9], 2 * np.pi * 0.15 * 1.8
    elif name == "plane":
        normals = np.broadcast_to(np.array([0.48, 0.6, 0.64]), (count, 3))
        positions, area = 0.6 * (u[:, None] * [0.8, 0, -0.6] + v[:, None] * [-0.36, 0.8, -0.48]), 1.2**2
    else:  # two plates, outward on either side
        above = np.arange(count) % 2 == 0
        normals = np.where(above[:, None], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0])
        positions, area = np.stack([0.6 * u, np.where(above, 0.1, -0.1), 0.6 * v], axis=1), 2 * 1.2**2
    return positions.astype(np.float32), normals.astype(np.float32), float(np.sqrt(area / count))


def cloud(positions, **columns) -> PointCloud:
    """A grey cloud, other columns as given."""
    count = len(positions)
    columns = {"base_color": np.full((count, 3), 0.5), "roughness": np.full(count, 0.5)} | columns
    columns = {name: np.asarray(x, np.float32) for name, x in ({"metallic": np.zeros(count)} | columns).items()}
    return PointCloud(positions=np.asarray(positions, np.float32), mask=np.ones(count, bool), **columns)


def lumpy_ball(count: int, size: int, seed: int = 0, noise: float = 1.0) -> PointCloud:
    """Random points of a lumpy ball of two colours in units of its own, padded to a size."""
    rng = np.random.default_rng(seed)
    normals = shape("sphere", count, "random")[1]
    positions = 30 + 7 * normals * (1 + 0.2 * np.sin(3 * normals[:, :1])) * [1, 1.3, 0.8]
    colors = np.where(normals[:, :1] > 0.2, [0.8, 0.3, 0.1], [0.1, 0.3, 0.6]) + 0.1 * rng.random((count, 3))
    return pad(cloud(positions + noise * rng.normal(size=(count, 3)), base_color=colors), size)


def tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors orthogonal to each unit normal and to each other (Duff et al. 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x**2 * a, sign * b, -sign * x], axis=-1)
    second = np.stack([b, sign + y**2 * a, -y], axis=-1)
    return first, second


_estimate = jax.jit(estimate_surfels)


def estimate(
    positions, base_color=None, roughness=None, metallic=None, normals=None, order=None, evenness=None
) -> Surfels:
    """Surfels of points in the box, in their order, as NumPy arrays; computed padded, by few programs.

    `order` are the places of the points among the padding.
    """
    given = {"base_color": base_color, "roughness": roughness, "metallic": metallic, "normals": normals}
    given["evenness"] = evenness
    points = cloud(positions, **{name: values for name, values in given.items() if values is not None})
    points = pad(points, next(size for size in PADDED if size >= len(positions)))
    places = np.arange(len(positions)) if order is None else np.asarray(order)
    rows = np.full(len(points.mask), len(positions))
    rows[places] = np.arange(len(positions))
    points = jax.tree.map(lambda x: np.concatenate([x[: len(positions)], np.zeros_like(x[:1])])[rows], points)
    found = jax.tree.map(np.asarray, _estimate(points, neighbors(points)))
    assert found.mask.sum() == found.mask[places].sum() == len(positions)
    assert all(np.isfinite(values).all() for values in vars(found).values())
    return jax.tree.map(lambda values: values[places], found)


def surfels(position, normal, spacing, **columns) -> Surfels:
    """Grey whole discs that every direction sees and that have one side."""
    count = len(position)
    normal = np.broadcast_to(normal, (count, 3))
    columns = {
        "base_color": np.full((count, 3), 0.5),
        "color_edge": np.zeros((count, 4)),
        "color_jump": np.zeros((count, 3)),
        "roughness": np.full(count, 0.5),
        "metallic": np.zeros(count),
        "materials_unknown": np.zeros(count),
        "learned": np.zeros(count),
        "one_sided": np.ones(count),
        "visibility": np.ones((count, NUM_DIRECTIONS)),
        "shape_ratios": np.zeros((count, 2)),
        "rim_tangent": tangents(np.asarray(normal))[0],
        "rim_distances": np.full((count, 4), CONSTANTS.largest_radius),
    } | columns
    columns |= {"position": position, "normal": normal}
    columns |= {"spacing": np.broadcast_to(spacing, count)}
    return Surfels(**{name: jnp.asarray(x, jnp.float32) for name, x in columns.items()}, mask=jnp.ones(count, bool))


def camera(size: int = 24, eye=(0.0, 0.0, 2.5), field_of_view: float = 0.7, target=(0.0, 0.0, 0.0)) -> Camera:
    """A camera that looks at the target, y up."""
    pose = cameras.look_at(jnp.asarray(eye, jnp.float32), jnp.asarray(target), jnp.array([0.0, 1.0, 0.0]))
    return cameras.pinhole(pose, field_of_view, size, size)
