"""Fewer points cover the shape as evenly, whatever their number; a sample does not depend on the pieces of the file."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.point_clouds import sphere_points

from spnr_jax.kernels.cloud_arrays import (
    THINNING,
    candidates,
    farthest_points,
    first_in_voxels,
    make_cloud,
    sample_stream,
    stack_columns,
)
from spnr_jax.surfels.constants import CONSTANTS
from spnr_jax.surfels.neighbors import measure_evenness, neighbors


@pytest.mark.parametrize("num_points", [500, 6000])  # 6000 is thinned at random before
def test_thinned_points_cover_the_shape_evenly_where_a_random_choice_leaves_gaps(num_points):
    positions, count = sphere_points(2, num_points), 64
    kept = farthest_points(positions, count, seed=0)
    between = np.linalg.norm(positions[kept, None] - positions[kept], axis=-1) + 9 * np.eye(count)
    gap = np.linalg.norm(positions[:, None] - positions[kept], axis=-1).min(axis=1)
    random = np.random.default_rng(0).choice(num_points, count, replace=False)
    random_gap = np.linalg.norm(positions[:, None] - positions[random], axis=-1).min(axis=1)
    assert between.min() > 0.8 * np.quantile(gap, 0.99)  # a packing that covers: both radii agree
    assert np.quantile(gap, 0.99) < 0.6 * np.quantile(random_gap, 0.99)


def test_with_normals_each_side_of_a_thin_wall_is_covered_by_itself_and_still_even():
    places = np.random.default_rng(1).random((4000, 3)) * [1, 1, 0]
    front = np.arange(4000) % 2 == 0
    wall, normals = places + front[:, None] * [0, 0, 0.004], np.where(front[:, None], [0, 0, 1.0], [0, 0, -1.0])

    def gap_and_evenness(kept):
        gaps = [cKDTree(wall[kept[front[kept] == side]]).query(wall[front == side])[0].max() for side in (True, False)]
        one = make_cloud(wall[kept], normals=normals[kept])
        return max(gaps), float(measure_evenness(one, neighbors(one)))

    blind, told = (gap_and_evenness(farthest_points(wall, 400, 0, of)) for of in (None, normals))
    assert told[0] < 0.7 * blind[0]
    assert told[1] > CONSTANTS.even
    unknown = farthest_points(wall, 400, 0, np.zeros_like(wall))
    np.testing.assert_array_equal(unknown, farthest_points(wall, 400, 0))


def in_a_grid(positions: np.ndarray) -> np.ndarray:
    return np.round(positions, 1)


@pytest.mark.parametrize("moved", [np.asarray, in_a_grid], ids=["anywhere", "many as far as each other, many coincide"])
def test_many_farthest_points_are_those_of_the_loop_over_all(moved):
    positions, count = moved(sphere_points(3, 3000)), 2500
    x, y, z = np.ascontiguousarray((positions - positions.mean(axis=0)).T, np.float32)
    squared, kept = np.full(3000, np.inf, np.float32), [int(np.random.default_rng(7).integers(3000))]
    while len(kept) < count:
        squared = np.minimum(squared, (x - x[kept[-1]]) ** 2 + (y - y[kept[-1]]) ** 2 + (z - z[kept[-1]]) ** 2)
        squared[kept[-1]] = -1
        kept.append(int(np.argmax(squared)))
    np.testing.assert_array_equal(farthest_points(positions, count, seed=7), kept)


def pieces_of(positions: np.ndarray, size: int):
    """Columns with the row number as `tag`, `size` points at a time."""
    table = np.column_stack([positions, np.arange(len(positions))])
    for start in range(0, len(table), size):
        yield dict(zip(("x", "y", "z", "tag"), table[start : start + size].T, strict=True))


def test_a_voxel_keeps_the_first_of_its_points():
    positions = np.array([[0.1, 0.1, 0.1], [-0.1, 0.1, 0.1], [0.9, 0.9, 0.9], [1.1, 0.9, 0.9], [0.5, 0.5, 0.5]])
    np.testing.assert_array_equal(first_in_voxels(positions, 1.0), [0, 1, 3])
    np.testing.assert_array_equal(first_in_voxels(positions, 1e-3), np.arange(5))
    np.testing.assert_array_equal(first_in_voxels(positions * 1e30, 1e-3), [0, 1])  # beyond the last voxel


def test_a_stream_that_fits_is_kept_as_it_is_whatever_its_pieces():
    positions = sphere_points(0, 100)
    for size in (7, 50, 100):
        kept, seen = sample_stream(pieces_of(positions, size), most=100)
        assert seen == 100
        np.testing.assert_array_equal(kept["tag"], np.arange(100))
        np.testing.assert_array_equal(kept["y"], positions[:, 1])
    assert sample_stream([], most=3) == ({}, 0)


@pytest.mark.parametrize("size", [77, 20_000])
def test_the_sample_of_a_longer_stream_is_as_dense_as_the_stream_whatever_its_pieces(size):
    positions = sphere_points(1, 20_000)
    positions[:15_000] *= 0.1
    whole, _ = sample_stream(pieces_of(positions, 20_000), 1000)
    sample, seen = sample_stream(pieces_of(positions, size), 1000)
    rows = sample["tag"].astype(int)
    assert seen == 20_000
    np.testing.assert_array_equal(rows, whole["tag"])
    np.testing.assert_array_equal(stack_columns(sample), positions[rows])
    assert 500 <= len(rows) <= 1000
    np.testing.assert_allclose(np.mean(rows < 15_000), 0.75, atol=0.02)


def test_a_point_far_outside_does_not_make_the_voxels_of_the_others_larger():
    assert len(candidates(np.concatenate([sphere_points(2, 5000), [[1e7, 0, 0]]]), 60)) > 200


def test_candidates_are_enough_and_not_too_many_even_where_points_coincide():
    for positions in (sphere_points(3, 4000), np.zeros((4000, 3)), np.eye(3)[np.arange(4000) % 3]):
        among = candidates(positions, 100)
        assert 100 <= len(among) <= THINNING * 100
        assert len(np.unique(among)) == len(among)


def test_points_whose_squared_distances_leave_float32_are_thinned_as_smaller_ones_are():
    positions = np.random.default_rng(3).normal(size=(200, 3))
    np.testing.assert_array_equal(farthest_points(1e30 * positions, 20, 0), farthest_points(positions, 20, 0))
