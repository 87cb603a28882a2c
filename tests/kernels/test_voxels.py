"""Points to volume and back: scatter by voxel, the sparse convolution, trilinear lookup."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from support import reference
from support.laws import close, numbers, same_bits

from spnr_jax.kernels import voxels
from spnr_jax.kernels.voxels import mean_contributions, row_of, scatter_conv, scatter_mean, trilinear

D = 4
POSITIONS = 1.2 * numbers(0, 2, 3, 12, 3)  # some lie outside the box, and several share a voxel
FEATURES = numbers(1, 2, 3, 12, 2)
MASK = np.random.default_rng(2).uniform(size=(2, 3, 12)) > 0.3
VOLUME = numbers(3, D, D, D, 2)
scatter = jax.jit(scatter_mean, static_argnums=3)
lookup, locate = jax.jit(trilinear), jax.jit(voxels.locate, static_argnums=1)


class TestLocate:
    @pytest.mark.parametrize(
        ("coordinate", "voxel"), [(-1.0, 0), (-0.5, 1), (-1e-8, 2), (0.0, 2), (0.49999, 2), (1.0, 3)]
    )
    def test_a_face_belongs_to_the_voxel_above_it_and_the_far_face_to_the_last(self, coordinate, voxel):
        cell, offset = locate(jnp.array([coordinate, 0.0, -0.75]), D)
        np.testing.assert_array_equal(cell, [voxel, 2, 0])
        close(offset, np.array([(np.float32(coordinate) + 1) * 2 - voxel - 0.5, -0.5, 0.0]))

    def test_rows_run_through_x_first_and_what_is_not_valid_goes_to_the_spare_row(self):
        cell = jnp.array([[1, 2, 3], [1, 2, 3]], jnp.int32)
        np.testing.assert_array_equal(row_of(cell, jnp.array([True, False]), D), [1 + 4 * 2 + 16 * 3, 64])


class TestScatterMean:
    cloud = POSITIONS[0, 0], FEATURES[0, 0], jnp.asarray(MASK[0, 0])

    def test_the_order_of_points_in_voxels_of_their_own_does_not_matter_by_a_bit(self):
        cells = np.random.default_rng(9).permutation(D**3)[:12]
        positions = np.stack(np.unravel_index(cells, (D, D, D)), axis=-1).astype(np.float32) * (2 / D) - 1 + 0.1
        order = np.random.default_rng(4).permutation(12)
        features, mask = np.asarray(FEATURES[0, 0]), MASK[0, 0]
        one, other = (
            scatter(*map(jnp.asarray, (positions[o], features[o], mask[o])), D) for o in (np.arange(12), order)
        )
        same_bits(one, other)

    @pytest.mark.parametrize(
        ("point", "kept"),
        [
            ((1, 1, 1), True),
            ((-1, -1, -1), True),
            ((-1, 1, 0), True),
            ((np.nextafter(np.float32(1), np.float32(2)), 0, 0), False),
            ((0, -1.5, 0), False),
            ((0, 0, 1e10), False),
        ],
    )
    def test_points_on_the_faces_stay_and_points_outside_are_dropped(self, point, kept):
        volume, occupancy = scatter(jnp.array([point], jnp.float32), jnp.ones((1, 2)), jnp.ones(1, bool), D)
        assert volume.sum() == 2 * kept
        assert occupancy.sum() == kept

    @pytest.mark.parametrize("fill", [0.0, 1e30, np.nan])
    def test_padding_does_not_matter_whatever_it_holds(self, fill):
        extra = jnp.full((5, 3), fill, jnp.float32)
        fills = extra, extra[:, :2], jnp.zeros(5, bool)
        padded = (jnp.concatenate(pair) for pair in zip(self.cloud, fills, strict=True))
        same_bits(scatter(*padded, D), scatter(*self.cloud, D))

    def test_no_point_gives_zeros_and_zero_gradients(self):
        positions, features, mask = self.cloud

        def total(features, mask):
            volume, occupancy = scatter_mean(positions, features, mask, D)
            return jnp.sum(volume) + jnp.sum(occupancy)

        value, gradient = jax.jit(jax.value_and_grad(total))(features, jnp.zeros_like(mask))
        assert value == 0
        assert (gradient == 0).all()
        empty = scatter_mean(jnp.zeros((0, 3)), jnp.zeros((0, 2)), jnp.zeros(0, bool), D)
        assert all((x == 0).all() for x in empty)


class TestScatterConv:
    kernel = numbers(5, 3, 3, 3, 3, 4)

    @staticmethod
    def volume(positions, features, mask):
        means, occupancy = scatter_mean(positions, features, mask, D)
        return jnp.concatenate([means, occupancy[..., None]], axis=-1)

    def dense(self, *points_and_kernel):
        *points, kernel = points_and_kernel
        numbering = ("NDHWC", "DHWIO", "NDHWC")
        volume = self.volume(*points)[None]
        return lax.conv_general_dilated(volume, kernel, (1, 1, 1), "SAME", dimension_numbers=numbering)[0]

    @staticmethod
    def sparse(positions, features, mask, kernel):
        return scatter_conv(*mean_contributions(positions, features, mask, D), kernel, D)

    def test_is_the_convolution_of_the_scattered_volume_in_value_and_gradient(self):
        weights = numbers(6, D, D, D, 4)
        mask = jnp.asarray(MASK[0, 0])

        def both(form):
            def projected(features, kernel):
                out = form(POSITIONS[0, 0], features, mask, kernel)
                return jnp.vdot(weights, out), out

            return jax.jit(jax.value_and_grad(projected, (0, 1), has_aux=True))(FEATURES[0, 0], self.kernel)

        sparse, dense = both(self.sparse), both(self.dense)
        close(sparse, dense, rtol=1e-4, atol=1e-5)
        volume = self.volume(POSITIONS[0, 0], FEATURES[0, 0], mask)
        close(sparse[0][1], reference.convolution(volume, self.kernel), atol=1e-5)


class TestTrilinear:
    def test_is_continuous_across_cells_and_constant_within_half_a_voxel_of_the_border(self):
        along = jnp.stack([jnp.linspace(-1, 1, 2001), jnp.full(2001, 0.1), jnp.full(2001, -0.3)], axis=-1)
        values = np.asarray(lookup(VOLUME, along))
        assert np.abs(np.diff(values, axis=0)).max() < 0.001 * 2 * D
        assert (values[:250] == values[0]).all()

    def test_outside_the_box_there_is_nothing_in_value_and_gradient(self):
        outside = jnp.array([[1.001, 0.0, 0.0], [0.0, -1.5, 0.0], [0.0, 0.0, 1e10], [-1e10, 0.0, 0.0]])
        assert (lookup(VOLUME, outside) == 0).all()
        gradients = jax.jit(jax.grad(lambda v, p: jnp.sum(trilinear(v, p)), (0, 1)))(VOLUME, outside)
        assert all((g == 0).all() for g in gradients)
