"""Emission-absorption at samples that are thin or coincide; the rest is in the tables of laws."""

import jax
import jax.numpy as jnp
import numpy as np
from support.laws import close, numbers

from spnr_jax.kernels import compositing
from spnr_jax.method import paper_method

union_weights = jax.jit(paper_method.union_weights)


def test_a_thousand_thin_intervals_dim_what_lies_behind_them():
    """The transmittance of each rounds to 1 in float32, so their product would be 1."""
    weights, _ = compositing.volume_weights(jnp.full(4096, 2e-8), jnp.ones(4096))
    close(weights[-1] / weights[0], np.exp(-4095 * 2e-8), rtol=1e-6)


class TestUnionWeights:
    coarse = jnp.sort(numbers(6, 2, 3, 5), axis=-1)
    density = 3 * numbers(8, 2, 3, 9, low=0.0)
    far = jnp.full((2, 3), 1.5)

    def test_a_fine_sample_on_top_of_a_coarse_one_changes_nothing(self):
        same = self.coarse[..., :4]
        density = jnp.concatenate([self.density[..., :5], self.density[..., :4]], axis=-1)
        weights = union_weights(self.coarse, same, density, self.far)
        alone = union_weights(self.coarse, self.coarse[..., :0], self.density[..., :5], self.far)
        close(weights[..., :4] + weights[..., 5:], alone[..., :4])
        close(weights[..., 4], alone[..., 4])

    def test_samples_that_coincide_have_finite_gradients(self):
        same = jnp.ones((2, 3, 4))
        density = jnp.concatenate([1e10 * self.density[..., :4], self.density[..., :4]], axis=-1)
        arguments = same, same, density, jnp.ones((2, 3))
        gradients = jax.grad(lambda *x: jnp.sum(union_weights(*x) * jnp.arange(8.0).reshape(1, 1, 8)), (0, 1, 2, 3))(
            *arguments
        )
        assert all(jnp.isfinite(g).all() for g in gradients)
