"""Coarse and fine samples composited as one line of samples."""

import jax
import jax.numpy as jnp
import numpy as np
from support import reference
from support.laws import batch_law, close, gradient_law, numbers

from spnr_jax.method.paper_method import union_weights


class TestUnionWeights:
    coarse = jnp.sort(numbers(6, 2, 3, 5), axis=-1)
    fine = jnp.sort(numbers(7, 2, 3, 4), axis=-1)
    density = 3 * numbers(8, 2, 3, 9, low=0.0)
    far = jnp.full((2, 3), 1.5)

    def test_are_those_of_the_sorted_samples_put_back_in_their_places(self):
        weights = np.asarray(union_weights(self.coarse, self.fine, self.density, self.far))
        distances = np.concatenate([self.coarse, self.fine], axis=-1)
        for place in np.ndindex(2, 3):
            order = np.argsort(distances[place], kind="stable")
            delta = np.diff(np.append(distances[place][order], 1.5))
            expected = np.empty(9)
            expected[order], _ = reference.volume_weights(np.asarray(self.density)[place][order], delta)
            close(weights[place], expected)

    def test_obey_the_batch_law(self):
        batch_law(union_weights, self.coarse, self.fine, self.density, self.far)

    def test_gradients_by_the_density_are_right(self):
        gradient_law(lambda density: union_weights(self.coarse, self.fine, density, self.far), self.density)

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
