"""Points to volume: padding, and the sparse convolution; the rest is in the tables of laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from support.laws import close, numbers, same_bits

from spnr_jax.kernels.voxels import mean_contributions, scatter_conv, scatter_mean

D = 4
POSITIONS, FEATURES = 1.2 * numbers(0, 12, 3), numbers(1, 12, 2)  # some outside the box, several in one voxel
MASK = jnp.asarray(np.random.default_rng(2).uniform(size=12) > 0.3)
KERNEL = numbers(5, 3, 3, 3, 3, 4)
scatter = jax.jit(scatter_mean, static_argnums=3)


@pytest.mark.parametrize("fill", [0.0, 1e30, np.nan])
def test_padding_does_not_matter_whatever_it_holds(fill):
    cloud, extra = (POSITIONS, FEATURES, MASK), jnp.full((5, 3), fill, jnp.float32)
    padded = (jnp.concatenate(pair) for pair in zip(cloud, (extra, extra[:, :2], jnp.zeros(5, bool)), strict=True))
    same_bits(scatter(*padded, D), scatter(*cloud, D))


def dense(features, kernel):
    means, occupancy = scatter_mean(POSITIONS, features, MASK, D)
    volume = jnp.concatenate([means, occupancy[..., None]], axis=-1)[None]
    return lax.conv_general_dilated(volume, kernel, (1, 1, 1), "SAME", dimension_numbers=("NDHWC", "DHWIO", "NDHWC"))[0]


def sparse(features, kernel):
    return scatter_conv(*mean_contributions(POSITIONS, features, MASK, D), kernel, D)


def test_the_sparse_convolution_is_that_of_the_scattered_volume_in_value_and_gradient():
    def both(form):
        def projected(features, kernel):
            out = form(features, kernel)
            return jnp.vdot(numbers(6, D, D, D, 4), out), out

        return jax.jit(jax.value_and_grad(projected, (0, 1), has_aux=True))(FEATURES, KERNEL)

    close(both(sparse), both(dense), rtol=1e-4, atol=1e-5)
