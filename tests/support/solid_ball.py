"""A ball as a grid of solidity, and as points in two materials, somewhere in the frame of a file."""

import numpy as np

from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.formats.orientation import ROTATIONS
from spnr_jax.tools.surfaces import Grid
from support.surfel_clouds import cloud

RADIUS, CENTRE = 2.0, np.array([5.0, -3.0, 1.0])


def ball_grid(origin=(0, 0, 0)) -> Grid:
    """Solidity that falls with the distance from CENTRE, one half at RADIUS."""
    spacing, lowest = 0.2, CENTRE - 3.07  # no vertex falls on a place of the grid
    axes = [lowest[i] + spacing * np.arange(31) for i in range(3)]
    distance = np.linalg.norm(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - CENTRE, axis=-1)
    values = np.clip(0.5 + RADIUS - distance, 0, 1).astype(np.float32)
    return Grid(values=values, lowest=lowest, spacing=spacing, origin=np.array(origin, float))


def ball_cloud(up="y", origin=(0, 0, 0)) -> PlacedCloud:
    """Points of the ball: red, rough and no metal where the file's x is large, else blue, smooth and metal."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(600, 3))
    in_file = CENTRE + RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    right = in_file[:, 0] > CENTRE[0]
    rotation = np.array(ROTATIONS[up], float)
    color = np.where(right[:, None], [1, 0, 0], [0, 0, 1])
    points = cloud(in_file @ rotation.T, base_color=color, roughness=np.where(right, 1, 0.25), metallic=~right)
    return PlacedCloud(cloud=points, up=up, rotation=rotation, origin=np.array(origin, float))
