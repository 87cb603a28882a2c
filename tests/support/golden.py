"""Pictures that the network of the package must go on drawing: tests/support/golden.npz holds them in 8 bits.

    PYTHONPATH=.:tests python -m support.golden     draws them anew, where a change of the pictures is meant

The clouds are made of formulas alone: low-discrepancy points (the R2 sequence) on a striped torus and on a small table.
"""

from pathlib import Path

import numpy as np

import spnr_jax
from support.surfel_clouds import cloud, even_square

FILE = Path(__file__).with_name("golden.npz")
SIZE, VIEW = 64, {"azimuth": 35.0, "elevation": 25.0}


def sequence(count: int) -> np.ndarray:
    """Points (count, 2) in [0, 1), evenly spread."""
    return even_square(count) / 2 % 1


def torus(count: int = 1000) -> spnr_jax.PointCloud:
    """A torus with stripes of two colours, rough ones and smooth ones."""
    around, along = 2 * np.pi * sequence(count).T
    radius = 0.7 + 0.28 * np.cos(along)
    positions = np.stack([radius * np.cos(around), 0.28 * np.sin(along), radius * np.sin(around)], axis=-1)
    striped = (np.floor(6 * around / np.pi) % 2)[:, None]
    colors = striped * [0.7, 0.12, 0.05] + (1 - striped) * [0.05, 0.2, 0.55]
    return cloud(positions, base_color=colors, roughness=0.25 + 0.5 * striped[:, 0])


def table(count: int = 1500) -> spnr_jax.PointCloud:
    """A wooden top on four metal legs: boxes, each with points in the share of its area."""
    middles = np.array([(0, 0.45, 0), *((x, -0.05, z) for x in (-0.7, 0.7) for z in (-0.4, 0.4))])
    halves = np.array([(0.8, 0.05, 0.5), *[(0.05, 0.45, 0.05)] * 4])
    areas = np.repeat(halves.prod(axis=1, keepdims=True) / halves, 2)  # of each box -x +x -y +y -z +z
    shares = np.cumsum(areas) / areas.sum()
    u, v = sequence(count).T
    side = np.searchsorted(shares, u)
    before = np.concatenate([[0], shares])[side]
    inside = (u - before) / (shares[side] - before)  # which place in its own side a point has
    box, axis = side // 6, side % 6 // 2
    place = np.stack([2 * (side % 2) - 1, 2 * inside - 1, 2 * v - 1], axis=1)
    place = np.take_along_axis(place, np.array([[0, 1, 2], [1, 0, 2], [1, 2, 0]])[axis], axis=1)
    positions = middles[box] + place * halves[box]
    top = (side < 6).astype(float)
    colors = top[:, None] * [0.35, 0.18, 0.08] + (1 - top[:, None]) * [0.6, 0.6, 0.62]
    return cloud(positions, base_color=colors, roughness=0.6 * top + 0.3 * (1 - top), metallic=1 - top)


CLOUDS = {"torus": torus, "table": table}


def draw(name: str) -> np.ndarray:
    """Colours and opacity (64, 64, 4) of the cloud as the network of the package draws it, in [0, 1]."""
    model = spnr_jax.load()
    volume = model.encode(CLOUDS[name]())
    rendering = model.render(volume, model.camera(volume, **VIEW, resolution=SIZE), "best")
    return np.clip(np.concatenate([rendering.image, rendering.acc[..., None]], axis=-1), 0, 1)


if __name__ == "__main__":
    np.savez_compressed(FILE, **{name: np.round(255 * draw(name)).astype(np.uint8) for name in CLOUDS})
