"""Padding, buckets and the box of clouds as arrays."""

import numpy as np
import pytest
from support.point_clouds import sphere_points

from spnr_jax.formats.clouds import read_cloud
from spnr_jax.kernels.cloud_arrays import bucket, normalization, pad


def test_padding_adds_masked_zeros_and_changes_no_real_point(tmp_path):
    np.save(tmp_path / "a.npy", sphere_points(4, 5))
    cloud = read_cloud(tmp_path / "a.npy")
    padded = pad(cloud, 8)
    np.testing.assert_array_equal(padded.mask, np.arange(8) < 5)
    for name in ("positions", "base_color", "roughness", "metallic"):
        np.testing.assert_array_equal(getattr(padded, name)[:5], getattr(cloud, name))
        np.testing.assert_array_equal(getattr(padded, name)[5:], 0)
        assert getattr(padded, name).dtype == np.float32
    np.testing.assert_array_equal(pad(cloud, 5).positions, cloud.positions)
    with pytest.raises(ValueError, match="5 points does not fit into 4"):
        pad(cloud, 4)


def test_a_bucket_is_the_smallest_doubling_of_512_that_holds_the_points():
    sizes = [1, 511, 512, 513, 1024, 1025, 4096, 5000]
    assert [bucket(size) for size in sizes] == [512, 512, 512, 1024, 1024, 2048, 4096, 8192]
    with pytest.raises(ValueError, match="at least 1 point, got 0"):
        bucket(0)


def test_normalised_points_have_their_box_around_zero_with_half_diagonal_one():
    positions = (sphere_points(5, 50) * [3, 1, 0.2] + [5, -7, 100]).astype(np.float32)
    centre, scale = normalization(positions)
    normalised = (positions - centre) * scale
    np.testing.assert_allclose(normalised.min(axis=0), -normalised.max(axis=0), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(normalised.max(axis=0)), 1, rtol=1e-5)


def test_a_point_alone_is_moved_to_zero_and_not_scaled():
    centre, scale = normalization(np.array([[3.0, 4, 5]], np.float32))
    np.testing.assert_array_equal(centre, [3, 4, 5])
    assert scale == 1
