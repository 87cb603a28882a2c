"""Emission-absorption: weights, compositing, expected distance."""

import jax
import jax.numpy as jnp
import numpy as np
from support.laws import close, numbers

from spnr_jax.kernels import compositing
from spnr_jax.method import paper_method

volume_weights, composite = jax.jit(compositing.volume_weights), jax.jit(compositing.composite, static_argnums=2)
expected_distance, union_weights = jax.jit(compositing.expected_distance), jax.jit(paper_method.union_weights)
DENSITY = 5 * jnp.abs(numbers(0, 2, 3, 8))
DELTA = jnp.abs(numbers(1, 2, 3, 8))
VALUES = numbers(2, 2, 3, 8, 4)


class TestWeights:
    def test_an_optical_depth_that_float32_cannot_hold_is_opaque_with_a_finite_gradient(self):
        density, delta = jnp.full(4, 3e38), jnp.full(4, 10.0)
        close(volume_weights(density, delta), (jax.nn.one_hot(0, 4), 0.0))
        gradients = jax.grad(lambda d, w: jnp.sum(volume_weights(d, w)[0] * jnp.arange(4.0)), (0, 1))(density, delta)
        assert all(jnp.isfinite(g).all() for g in gradients)

    def test_a_wall_stops_the_gradient_behind_it_and_none_before_it(self):
        """Where alpha is exactly 1 a product of transmittances would divide by zero."""
        density, delta = jnp.array([0.5, 1.0, 1e10, 0.7, 0.2]), jnp.full(5, 0.3)
        values = jnp.array([1.0, -2.0, 3.0, 5.0, 7.0])
        gradient = np.asarray(jax.grad(lambda d: jnp.vdot(volume_weights(d, delta)[0], values))(density))
        passed = np.exp(-0.3 * np.cumsum([0.5, 1.0]))  # behind the first and the second
        after_second = 3.0 * passed[1]
        after_first = (passed[0] - passed[1]) * -2.0 + after_second
        close(gradient[:2], 0.3 * np.array([passed[0] * 1.0 - after_first, passed[1] * -2.0 - after_second]), atol=1e-5)
        assert (gradient[2:] == 0).all()

    def test_a_thousand_thin_intervals_dim_what_lies_behind_them(self):
        """The transmittance of each rounds to 1 in float32, so their product would be 1."""
        weights, _ = volume_weights(jnp.full(4096, 2e-8), jnp.ones(4096))
        close(weights[-1] / weights[0], np.exp(-4095 * 2e-8), rtol=1e-6)


class TestComposite:
    def test_an_empty_ray_is_exactly_the_background_and_values_get_no_gradient(self):
        def white(values):
            weights, _ = volume_weights(jnp.zeros((2, 3, 8)), DELTA)
            return composite(weights, values, 1.0)

        assert (white(VALUES) == 1).all()
        assert (
            jax.grad(lambda d: jnp.sum(composite(volume_weights(d, DELTA)[0], VALUES, 1.0)))(0 * DENSITY) != 0
        ).any()
        close(jax.grad(lambda v: jnp.sum(white(v)))(VALUES), jnp.zeros_like(VALUES))


class TestExpectedDistance:
    distances = jnp.cumsum(DELTA, axis=-1)
    far = DELTA.sum(-1) + 0.5

    def test_light_that_nothing_stops_counts_as_far_with_a_finite_gradient(self):
        def distance(density):
            return expected_distance(volume_weights(density, DELTA)[0], self.distances, self.far)

        assert (distance(jnp.zeros((2, 3, 8))) == self.far).all()
        assert jnp.isfinite(jax.grad(lambda d: jnp.sum(distance(d)))(jnp.zeros((2, 3, 8)))).all()


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
