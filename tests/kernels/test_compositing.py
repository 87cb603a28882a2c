"""Emission-absorption: weights, compositing, expected distance."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference
from support.laws import batch_law, close, gradient_law, numbers

from spnr_jax.kernels.compositing import composite, expected_distance, interval_lengths, volume_weights
from spnr_jax.kernels.numerics import softplus

DENSITY = 5 * jnp.abs(numbers(0, 2, 3, 8))
DELTA = jnp.abs(numbers(1, 2, 3, 8))
VALUES = numbers(2, 2, 3, 8, 4)


class TestWeights:
    def test_are_the_light_that_a_loop_loses(self):
        weights, residual, density, delta = map(np.asarray, (*volume_weights(DENSITY, DELTA), DENSITY, DELTA))
        for place in np.ndindex(2, 3):
            close((weights[place], residual[place]), reference.volume_weights(density[place], delta[place]))

    def test_obey_the_batch_and_gradient_laws(self):
        batch_law(volume_weights, DENSITY, DELTA)
        gradient_law(volume_weights, DENSITY, DELTA)

    @pytest.mark.parametrize("scale", [0.0, 1e-8, 1.0, 1e3, 1e10])
    def test_and_the_residual_sum_to_one(self, scale):
        weights, residual = map(np.asarray, volume_weights(scale * DENSITY, DELTA))
        assert (weights >= 0).all()
        close(weights.sum(-1) + residual, np.ones((2, 3)), atol=1e-6)

    @pytest.mark.parametrize(("k", "m"), list(itertools.product([-100, -10, 0, 10], repeat=2)))
    def test_are_finite_in_value_and_gradient_for_every_scale_of_density_and_length(self, k, m):
        rng = np.random.default_rng(3)
        density = jnp.asarray(np.exp(k + rng.normal(size=64)), jnp.float32)
        delta = jnp.asarray(np.exp(float(m)) * np.abs(rng.normal(size=64)) * (np.arange(64) % 8 > 0), jnp.float32)

        def total(density, delta):
            weights, residual = volume_weights(density, delta)
            return jnp.sum(weights * jnp.arange(64.0)) + residual, (weights, residual)

        (_, values), gradients = jax.jit(jax.value_and_grad(total, (0, 1), has_aux=True))(density, delta)
        assert all(np.isfinite(x).all() for x in (*values, *gradients))
        close(values, reference.volume_weights(density, delta), rtol=1e-4)

    @pytest.mark.parametrize("place", [0, 4, 7])
    def test_one_huge_density_stops_everything_where_it_is(self, place):
        weights, residual = volume_weights(1e10 * jax.nn.one_hot(place, 8), jnp.full(8, 0.1))
        close(weights, jax.nn.one_hot(place, 8))
        assert residual == 0

    def test_an_optical_depth_that_float32_cannot_hold_is_opaque_with_a_finite_gradient(self):
        density, delta = jnp.full(4, 3e38), jnp.full(4, 10.0)
        close(volume_weights(density, delta), (jax.nn.one_hot(0, 4), 0.0))
        gradients = jax.grad(lambda d, w: jnp.sum(volume_weights(d, w)[0] * jnp.arange(4.0)), (0, 1))(density, delta)
        assert all(jnp.isfinite(g).all() for g in gradients)

    @pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
    def test_and_the_residual_of_thousands_of_samples_sum_to_one(self, scale):
        density = scale * jnp.asarray(np.random.default_rng(5).gamma(0.1, size=(8, 4096)), jnp.float32)
        weights, residual = map(np.float64, jax.jit(volume_weights)(density, jnp.full((8, 4096), 1 / 4096)))
        close(weights.sum(-1) + residual, np.ones(8), rtol=0, atol=1e-6)

    def test_opacity_rises_with_every_density(self):
        grown = DENSITY[None] + np.eye(8, dtype=np.float32).reshape(8, 1, 1, 8)  # one more at each sample in turn
        opacity = 1 - np.asarray(volume_weights(grown, jnp.broadcast_to(DELTA, grown.shape))[1])
        before = 1 - np.asarray(volume_weights(DENSITY, DELTA)[1])
        assert (opacity >= before).all()
        assert (opacity > before).any()
        slope = jax.grad(lambda density: jnp.sum(volume_weights(density, DELTA)[1]))(DENSITY)
        assert (slope <= 0).all()

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

    def test_thin_intervals_are_not_lost(self):
        weights, _ = volume_weights(jnp.full(64, 1e-6 / 64), jnp.ones(64))
        assert weights.sum() == pytest.approx(1e-6, rel=1e-3)

    def test_a_thousand_thin_intervals_dim_what_lies_behind_them(self):
        """The transmittance of each rounds to 1 in float32, so their product would be 1."""
        weights, _ = volume_weights(jnp.full(4096, 2e-8), jnp.ones(4096))
        close(weights[-1] / weights[0], np.exp(-4095 * 2e-8), rtol=1e-6)

    def test_a_single_thin_interval_keeps_its_digits_and_its_gradient(self):
        value, gradient = jax.value_and_grad(lambda d: volume_weights(d, jnp.ones(1))[0][0])(jnp.array([1e-8]))
        assert value == pytest.approx(1e-8, rel=1e-6)
        assert gradient[0] == pytest.approx(1, rel=1e-6)

    def test_splitting_every_interval_changes_nothing(self):
        weights, residual = volume_weights(DENSITY, DELTA)
        halves, same = volume_weights(jnp.repeat(DENSITY, 2, axis=-1), jnp.repeat(DELTA / 2, 2, axis=-1))
        close(halves.reshape(2, 3, 8, 2).sum(-1), weights)
        close(same, residual)

    def test_an_interval_without_length_changes_nothing(self):
        with_empty = np.insert(DENSITY, 3, 1e10, axis=-1), np.insert(DELTA, 3, 0.0, axis=-1)
        weights, residual = map(np.asarray, volume_weights(*map(jnp.asarray, with_empty)))
        assert (weights[..., 3] == 0).all()
        close((np.delete(weights, 3, axis=-1), residual), volume_weights(DENSITY, DELTA))

    def test_optical_depth_keeps_its_precision_over_many_samples(self):
        density = jnp.asarray(np.random.default_rng(4).gamma(0.1, size=128), jnp.float32)
        close(volume_weights(density, jnp.ones(128)), reference.volume_weights(density, np.ones(128)), 3e-6, 1e-12)


class TestIntervals:
    def test_each_sample_owns_the_way_to_the_next_and_the_last_the_way_to_far(self):
        close(interval_lengths(jnp.array([1.0, 1.5, 3.0]), jnp.array(3.25)), np.array([0.5, 1.5, 0.25]))

    def test_obey_the_batch_and_gradient_laws(self):
        distances, far = jnp.cumsum(DELTA, axis=-1), DELTA.sum(-1) + 1
        batch_law(interval_lengths, distances, far)
        gradient_law(interval_lengths, distances, far)


class TestComposite:
    weights, _ = volume_weights(DENSITY, DELTA)

    def test_is_the_sum_over_samples_and_background(self):
        colour, weights, values = map(np.asarray, (composite(self.weights, VALUES, 0.7), self.weights, VALUES))
        for place in np.ndindex(2, 3):
            close(colour[place], reference.composite(weights[place], values[place], 0.7))

    def test_obeys_the_batch_and_gradient_laws(self):
        background = numbers(5, 2, 3, 4)
        batch_law(composite, self.weights, VALUES, background)
        gradient_law(composite, self.weights, VALUES, background)

    def test_an_empty_ray_is_exactly_the_background_and_values_get_no_gradient(self):
        def white(values):
            weights, _ = volume_weights(jnp.zeros((2, 3, 8)), DELTA)
            return composite(weights, values, 1.0)

        assert (white(VALUES) == 1).all()
        assert (
            jax.grad(lambda d: jnp.sum(composite(volume_weights(d, DELTA)[0], VALUES, 1.0)))(0 * DENSITY) != 0
        ).any()
        close(jax.grad(lambda v: jnp.sum(white(v)))(VALUES), jnp.zeros_like(VALUES))

    def test_a_ray_of_nearly_nothing_is_nearly_white(self):
        """64 samples of a field that says -9: with an endless last interval the pixel would be opaque."""
        density, delta = softplus(jnp.full(64, -9.0)), jnp.full(64, 2 / 64)
        weights, _ = volume_weights(density, delta)
        assert weights.sum() == pytest.approx(2.5e-4, rel=0.02)
        assert (composite(weights, jnp.zeros((64, 3)), 1.0) >= 0.999).all()


class TestExpectedDistance:
    distances = jnp.cumsum(DELTA, axis=-1)
    far = DELTA.sum(-1) + 0.5
    weights, _ = volume_weights(DENSITY, DELTA)

    def test_obeys_the_batch_and_gradient_laws(self):
        batch_law(expected_distance, self.weights, self.distances, self.far)
        gradient_law(expected_distance, self.weights, self.distances, self.far)

    @pytest.mark.parametrize("scale", [0.0, 1e-8, 1.0, 1e10])
    def test_lies_between_the_first_sample_and_far(self, scale):
        weights, _ = volume_weights(scale * DENSITY, DELTA)
        distance = expected_distance(weights, self.distances, self.far)
        assert (distance >= self.distances[..., 0] - 1e-5).all()
        assert (distance <= self.far + 1e-5).all()

    def test_light_that_nothing_stops_counts_as_far_with_a_finite_gradient(self):
        def distance(density):
            return expected_distance(volume_weights(density, DELTA)[0], self.distances, self.far)

        assert (distance(jnp.zeros((2, 3, 8))) == self.far).all()
        assert jnp.isfinite(jax.grad(lambda d: jnp.sum(distance(d)))(jnp.zeros((2, 3, 8)))).all()

    def test_an_opaque_sample_is_where_it_is_seen(self):
        close(expected_distance(jax.nn.one_hot(2, 4), jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.array(9.0)), 3.0)
