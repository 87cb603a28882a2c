"""Points to volume and back: scatter by voxel, the sparse convolution, trilinear lookup."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from support.laws import close, numbers, same_bits

from spnr_jax.kernels import voxels
from spnr_jax.kernels.voxels import mean_contributions, scatter_conv, scatter_mean

D = 4
POSITIONS = 1.2 * numbers(0, 2, 3, 12, 3)  # some lie outside the box, and several share a voxel
FEATURES = numbers(1, 2, 3, 12, 2)
MASK = np.random.default_rng(2).uniform(size=(2, 3, 12)) > 0.3
scatter = jax.jit(scatter_mean, static_argnums=3)
locate = jax.jit(voxels.locate, static_argnums=1)


class TestLocate:
    @pytest.mark.parametrize(
        ("coordinate", "voxel"), [(-1.0, 0), (-0.5, 1), (-1e-8, 2), (0.0, 2), (0.49999, 2), (1.0, 3)]
    )
    def test_a_face_belongs_to_the_voxel_above_it_and_the_far_face_to_the_last(self, coordinate, voxel):
        cell, offset = locate(jnp.array([coordinate, 0.0, -0.75]), D)
        np.testing.assert_array_equal(cell, [voxel, 2, 0])
        close(offset, np.array([(np.float32(coordinate) + 1) * 2 - voxel - 0.5, -0.5, 0.0]))


class TestScatterMean:
    cloud = POSITIONS[0, 0], FEATURES[0, 0], jnp.asarray(MASK[0, 0])

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
