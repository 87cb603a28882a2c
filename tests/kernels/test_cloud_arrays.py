"""Padding, buckets and the box of clouds as arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.point_clouds import sphere_points, write_rows

from spnr_jax.formats.clouds import read_cloud
from spnr_jax.kernels.cloud_arrays import bucket, make_cloud, normalization, pad


@pytest.mark.parametrize("known", [(), ("roughness",), ("roughness", "metallic"), ("base_color", "normals")])
def test_a_cloud_of_arrays_is_the_cloud_of_a_file_that_holds_them(tmp_path, known):
    positions = sphere_points(3, 30)
    given = {"base_color": np.abs(positions), "normals": positions, "roughness": positions[:, 0] ** 2}
    given = {name: values for name, values in (given | {"metallic": positions[:, 1] ** 2}).items() if name in known}
    columns = {name: values for name, values in given.items() if values.ndim == 1}
    for name, axes in (
        ("base_color", ("base_color_r", "base_color_g", "base_color_b")),
        ("normals", ("nx", "ny", "nz")),
    ):
        columns |= dict(zip(axes, given[name].T, strict=True)) if name in given else {}
    read, made = read_cloud(write_rows(tmp_path, positions, **columns)), make_cloud(positions, **given)
    traced = jax.jit(make_cloud)(jnp.asarray(positions), **given)
    for name, values in vars(read).items():
        assert (getattr(made, name) is None) == (getattr(traced, name) is None) == (values is None), name
        if values is not None:
            np.testing.assert_allclose(getattr(made, name), values, atol=1e-6, err_msg=name)
            np.testing.assert_array_equal(getattr(traced, name), getattr(made, name))
            assert getattr(made, name).dtype == getattr(traced, name).dtype == values.dtype


def test_one_value_holds_for_all_points():
    positions = sphere_points(3, 3)
    made = make_cloud(positions, (0.1, 0.2, 0.3), roughness=0.7)
    traced = jax.jit(lambda red: make_cloud(positions, (red, 0.2, 0.3)).base_color)(0.1)
    np.testing.assert_array_equal([made.base_color, traced], np.float32([[[0.1, 0.2, 0.3]] * 3] * 2))
    np.testing.assert_array_equal([made.roughness, made.metallic], np.float32([[0.7] * 3, [0] * 3]))


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
