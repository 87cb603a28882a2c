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
    boxes = [((0, 0.45, 0), (0.8, 0.05, 0.5))]
    boxes += [((x, -0.05, z), (0.05, 0.45, 0.05)) for x in (-0.7, 0.7) for z in (-0.4, 0.4)]
    sides = [(box, axis, sign) for box in range(len(boxes)) for axis in range(3) for sign in (-1, 1)]
    extents = np.array([np.delete(boxes[box][1], axis) for box, axis, _ in sides])
    shares = np.cumsum(extents.prod(axis=1)) / extents.prod(axis=1).sum()
    u, v = sequence(count).T
    side = np.minimum(np.searchsorted(shares, u), len(sides) - 1)
    before = np.concatenate([[0], shares])[side]
    inside = (u - before) / (shares[side] - before)  # which place in its own side a point has
    positions = np.empty((count, 3))
    for i, chosen in enumerate(side):
        box, axis, sign = sides[chosen]
        place = np.insert([2 * inside[i] - 1, 2 * v[i] - 1], axis, sign)
        positions[i] = np.add(boxes[box][0], place * np.array(boxes[box][1]))
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
