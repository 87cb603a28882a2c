"""Stratified samples, inverse-CDF samples, and the merge of two sorted lists."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference
from support.laws import batch_law, close, float64_law, gradient_law, numbers, same_bits

from spnr_jax.kernels import sampling
from spnr_jax.kernels.sampling import count_at_most, importance, merge, strata, stratified

NEAR = 1 + numbers(0, 2, 3)
FAR = NEAR + 0.5 + jnp.abs(numbers(1, 2, 3))
EDGES = jnp.sort(numbers(2, 2, 3, 9), axis=-1)
WEIGHTS = jnp.abs(numbers(3, 2, 3, 8))
KEYS = [None, 11]


drawn = jax.jit(importance, static_argnames=("num_samples", "padding"))


def fresh(seed):
    return None if seed is None else jax.random.key(seed)


class TestStratified:
    def test_without_a_key_samples_are_the_middles_of_equal_parts(self):
        distances, edges = map(np.asarray, stratified(None, NEAR, FAR, 4))
        for place in np.ndindex(2, 3):
            near, far = np.float64(NEAR)[place], np.float64(FAR)[place]
            close(edges[place], np.array([near + (far - near) * k / 4 for k in range(5)]))
            close(distances[place], np.array([near + (far - near) * (k + 0.5) / 4 for k in range(4)]))

    def test_obeys_the_batch_and_gradient_laws(self):
        batch_law(lambda near, far: stratified(None, near, far, 4), NEAR, FAR)
        gradient_law(lambda near, far: stratified(None, near, far, 4), NEAR, FAR)

    def test_no_gradient_is_lost_where_the_compiler_computes_a_distance_twice(self):
        """Once with a fused multiply-add and once without: jnp.clip compares the two in its gradient."""
        near = np.float32([0.6369617, 0.26978672, 0.04097353])
        float64_law(lambda near, far: stratified(None, near, far, 5), near, 2 * near, rtol=1e-5)

    @pytest.mark.parametrize(("near", "far"), [(0.0, 0.0), (1e10, 1.1e10), (1.0, 1 + 1e-7), (0.0, 1e-8)])
    @pytest.mark.parametrize("seed", KEYS)
    def test_one_sample_lies_in_each_part_however_long_the_ray_is(self, near, far, seed):
        distances, edges = stratified(fresh(seed), jnp.full(100, near), jnp.full(100, far), 16)
        assert (edges[:, :-1] <= distances).all()
        assert (distances <= edges[:, 1:]).all()
        assert (edges[:, 0] == jnp.float32(near)).all()
        assert (edges[:, -1] == jnp.float32(far)).all()

    @pytest.mark.parametrize("steps", [0, 1, 3])
    def test_edges_rise_also_where_a_ray_is_as_short_as_the_rounding_of_its_distance(self, steps):
        near = jnp.abs(numbers(4, 1000))
        far = near * (1 + steps * 2**-23)
        distances, edges = stratified(None, near, far, 16)
        assert (jnp.diff(edges, axis=-1) >= 0).all()
        assert ((edges[:, :-1] <= distances) & (distances <= edges[:, 1:])).all()
        assert ((edges[:, 0] == near) & (edges[:, -1] == far)).all()

    def test_jitter_is_uniform_in_every_part(self):
        jitter = strata(fresh(1), (4000,), 4) * 4 - jnp.arange(4.0)[None]
        close(jitter.mean(axis=0), np.full(4, 0.5), atol=0.02)
        close(jitter.var(axis=0), np.full(4, 1 / 12), atol=0.005)

    def test_rays_of_one_key_are_independent(self):
        jitter = np.array(strata(fresh(2), (2000, 2), 1))[..., 0]
        assert abs(np.corrcoef(jitter.T)[0, 1]) < 0.07
        assert len(np.unique(jitter)) > 3990

    def test_rays_mapped_over_split_keys_are_independent(self):
        keys = jax.random.split(fresh(3), 2000)
        jitter = np.array(jax.vmap(lambda key: strata(key, (), 2))(keys)) * 2 % 1
        assert len(np.unique(jitter)) > 3990
        assert abs(np.corrcoef(jitter.T)[0, 1]) < 0.07
        assert abs(np.corrcoef(jitter[:-1, 0], jitter[1:, 0])[0, 1]) < 0.07

    def test_keys_of_rays_draw_for_each_what_they_draw_for_it_alone(self):
        together = [strata(keys, (3,), 5) for keys in sampling.split(jax.random.split(fresh(4), 3))]
        alone = [[strata(key, (), 5) for key in jax.random.split(of_ray)] for of_ray in jax.random.split(fresh(4), 3)]
        same_bits(together, [jnp.stack(x) for x in zip(*alone, strict=True)])

    def test_equal_keys_give_equal_bits_and_other_keys_others(self):
        first, again, other = (strata(fresh(seed), (3,), 4) for seed in (5, 5, 6))
        assert (first == again).all()
        assert (first != other).all()


class TestImportance:
    @pytest.mark.parametrize("seed", KEYS)
    def test_is_the_walk_along_the_bins(self, seed):
        distances = np.asarray(drawn(fresh(seed), EDGES, WEIGHTS, 5))
        edges, weights, at = map(np.float64, (EDGES, WEIGHTS, strata(fresh(seed), (2, 3), 5)))
        for place in np.ndindex(2, 3):
            close(distances[place], reference.importance(edges[place], weights[place], at[place], 1e-5), atol=1e-5)

    def test_obeys_the_batch_law(self):
        batch_law(lambda edges, weights: importance(None, edges, weights, 5), EDGES, WEIGHTS, atol=1e-5)

    @pytest.mark.parametrize("scale", [0.0, 1e-8, 1.0, 1e10])
    @pytest.mark.parametrize("seed", KEYS)
    def test_samples_are_sorted_and_inside_the_edges(self, scale, seed):
        distances = drawn(fresh(seed), EDGES, scale * WEIGHTS**8, 64)
        assert jnp.isfinite(distances).all()
        assert (jnp.diff(distances) >= 0).all()
        assert (distances >= EDGES[..., :1]).all()
        assert (distances <= EDGES[..., -1:]).all()

    def test_all_zero_weights_give_the_even_spread(self):
        edges = jnp.linspace(2.0, 4.0, 9)
        close(importance(None, edges, jnp.zeros(8), 4), stratified(None, jnp.array(2.0), jnp.array(4.0), 4)[0])

    @pytest.mark.parametrize("hot", [0, 1, 3, 7])
    def test_a_single_heavy_bin_takes_all_samples(self, hot):
        distances = drawn(None, EDGES[0, 0], jax.nn.one_hot(hot, 8), 64)
        lo, hi = EDGES[0, 0, hot], EDGES[0, 0, hot + 1]
        assert ((distances >= lo) & (distances <= hi)).mean() > 0.98

    def test_a_thin_part_keeps_most_samples(self):
        edges = jnp.linspace(0.0, 1.0, 63)
        distances = drawn(None, edges, 1e-3 * jax.nn.one_hot(20, 62), 64)
        assert ((distances >= edges[20]) & (distances <= edges[21])).mean() == pytest.approx(0.62, abs=0.03)

    @pytest.mark.parametrize("bins", [16, 300], ids=["few bins", "many bins"])
    def test_samples_are_distributed_as_the_step_function(self, bins):
        rays = 3000
        edges = jnp.sort(numbers(4, bins + 1))
        weights = jnp.abs(numbers(5, bins)) ** 3
        many = (jnp.broadcast_to(x, (rays, *x.shape)) for x in (edges, weights))
        samples = np.sort(np.array(drawn(fresh(6), *many, 1, padding=1e-8))[:, 0])
        mass = np.concatenate([[0], np.cumsum(np.float64(weights))])
        expected = np.interp(samples, np.float64(edges), mass / mass[-1])
        deviation = np.abs(expected - (np.arange(rays) + 0.5) / rays).max()
        assert deviation < 1.95 / np.sqrt(rays), "Kolmogorov-Smirnov, 0.1 %"

    @pytest.mark.parametrize("seed", range(5))
    def test_a_share_of_one_or_more_stays_at_the_end_of_the_last_bin(self, seed, monkeypatch):
        """The cumulative mass of 127 bins ends a rounding above or below 1."""
        monkeypatch.setattr(sampling, "strata", lambda *_: jnp.array([0.0, 1 - 2**-24, 1.0, 1 + 2**-22]))
        weights = jnp.asarray(np.random.default_rng(seed).gamma(0.1, size=127), jnp.float32)
        distances = np.asarray(importance(None, jnp.linspace(2.0, 3.0, 128), weights, 4))
        assert distances[0] == 2
        assert (distances[1:] <= 3).all()
        assert (distances[1:] >= 3 - 1 / 127).all()
        assert (np.diff(distances) >= 0).all()

    def test_no_gradient_passes_through_where_the_samples_lie(self):
        gradients = jax.grad(lambda e, w: jnp.sum(importance(None, e, w, 5)), (0, 1))(EDGES, WEIGHTS)
        close(gradients, (jnp.zeros_like(EDGES), jnp.zeros_like(WEIGHTS)))


class TestMerge:
    @staticmethod
    def lists(n, m):
        """Sorted lists full of ties, within each list and between them."""
        draws = np.random.default_rng(8).integers(0, 6, (2, 3, n + m)).astype(np.float32)
        return tuple(jnp.asarray(np.sort(x, axis=-1)) for x in (draws[..., :n], draws[..., n:]))

    @pytest.mark.parametrize(("n", "m"), [(1, 1), (5, 3), (4, 9), (2, 300), (270, 280)])
    def test_is_the_stable_sort_with_ties(self, n, m):
        first, second = self.lists(n, m)
        order, rank = jax.jit(merge)(first, second)
        expected = np.argsort(np.concatenate([first, second], axis=-1), axis=-1, kind="stable")
        np.testing.assert_array_equal(order, expected)
        np.testing.assert_array_equal(rank, np.argsort(expected, axis=-1, kind="stable"))

    def test_obeys_the_batch_law(self):
        batch_law(merge, *self.lists(5, 3))


class TestCount:
    @pytest.mark.parametrize("strictly", [False, True])
    @pytest.mark.parametrize("n", [1, 7, 257, 511, 512])
    def test_is_bisection_of_the_sorted_list_with_ties_and_extremes(self, n, strictly):
        values = np.sort(np.random.default_rng(9).integers(0, n, n)).astype(np.float32)
        queries = np.concatenate([values[:5], values[-3:], [-1e10, 1e10, n / 2 + 0.25, -np.inf, np.inf]]).astype(
            np.float32
        )
        counted = jax.jit(count_at_most, static_argnums=2)(jnp.asarray(values), jnp.asarray(queries), strictly)
        np.testing.assert_array_equal(counted, np.searchsorted(values, queries, "left" if strictly else "right"))


def test_samples_stay_float32_however_coarse_the_inputs_type_is():
    distances, _ = sampling.stratified(None, jnp.bfloat16(1.0), jnp.bfloat16(3.0), 64)
    assert distances.dtype == jnp.float32
    assert len(np.unique(np.array(distances))) == 64


def test_keys_of_the_old_kind_draw_what_new_ones_do_and_other_numbers_of_weights_than_bins_are_refused():
    near, far = jnp.zeros(3), jnp.ones(3)
    old, new = (sampling.stratified(make(3), near, far, 4) for make in (jax.random.PRNGKey, jax.random.key))
    same_bits(old, new)
    both = zip(sampling.split(jax.random.PRNGKey(3)), sampling.split(jax.random.key(3)), strict=True)
    assert all(np.array_equal(*map(jax.random.key_data, pair)) for pair in both)
    unchecked = inspect.unwrap(sampling.importance)  # as without the annotations, which are executed here
    with pytest.raises(ValueError, match="9 edges have one weight less"):
        unchecked(None, jnp.arange(9.0), jnp.ones(9), 4)
