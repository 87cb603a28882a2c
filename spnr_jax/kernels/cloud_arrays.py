"""The few operations on the arrays of a cloud before a network sees it: NumPy in, NumPy out."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from spnr_jax.errors import UserError
from spnr_jax.kernels.records import PointCloud

SMALLEST_BUCKET = 512


def pad(cloud: PointCloud, size: int) -> PointCloud:
    """The cloud (points, ...) with zeros behind it up to `size` points, for which `mask` is False."""
    missing = size - len(cloud.mask)
    if missing < 0:
        raise UserError(f"a cloud of {len(cloud.mask)} points does not fit into {size}; thin it out first")

    def extend(values):
        return np.concatenate([values, np.zeros((missing, *values.shape[1:]), values.dtype)])

    return jax.tree.map(extend, cloud)


def strip(cloud: PointCloud) -> PointCloud:
    """The cloud (points, ...) without its padding."""
    mask = np.asarray(cloud.mask)
    return jax.tree.map(lambda x: np.asarray(x)[mask], cloud)


def bucket(count: int) -> int:
    """The smallest of 512, 1024, 2048, ... that holds `count` points: few sizes, so few compilations."""
    if count < 1:
        raise UserError(f"a cloud needs at least 1 point, got {count}")
    return max(SMALLEST_BUCKET, 1 << (count - 1).bit_length())


def normalization(positions: np.ndarray) -> tuple[np.ndarray, np.float32]:
    """(centre (3,), scale ()): (positions - centre) * scale has its bounding box around 0, with half diagonal 1.

    The scale of points without extent is 1.
    """
    low, high = (np.asarray(bound, np.float64) for bound in (positions.min(axis=0), positions.max(axis=0)))
    diagonal = np.linalg.norm(high - low)
    return ((low + high) / 2).astype(np.float32), np.float32(2 / diagonal if diagonal > 0 else 1)


def plain_cloud(
    positions: Float[np.ndarray, "points 3"],
    base_color: Float[np.ndarray, "points 3"] | float = 0.5,
    normals: Float[np.ndarray, "points 3"] | None = None,
) -> PointCloud:
    """Points of one material, grey unless said otherwise: roughness 0.5, metallic 0; all are real."""
    count = len(positions)
    return PointCloud(
        positions=positions,
        base_color=np.broadcast_to(np.float32(base_color), (count, 3)),
        roughness=np.full(count, 0.5, np.float32),
        metallic=np.zeros(count, np.float32),
        mask=np.ones(count, bool),
        normals=normals,
    )


def unstack(tree: Any) -> list[Any]:
    """What lies at each place of the first axis of a tree's arrays."""
    return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(len(jax.tree.leaves(tree)[0]))]
