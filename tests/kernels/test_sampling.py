"""Stratified samples, inverse-CDF samples, and the merge of two sorted lists."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from support.laws import close, extremes, extremes_law, hypotheses, numbers, same_bits, sorted_distances

from spnr_jax.kernels import sampling
from spnr_jax.kernels.sampling import count_at_most, importance, merge

EDGES = jnp.sort(numbers(2, 2, 3, 9), axis=-1)
WEIGHTS = jnp.abs(numbers(3, 2, 3, 8))
KEYS = [None, 11]


drawn = jax.jit(importance, static_argnames=("num_samples", "padding"))
stratified = jax.jit(sampling.stratified, static_argnums=3)
strata = jax.jit(sampling.strata, static_argnums=(1, 2))


def fresh(seed):
    return None if seed is None else jax.random.key(seed)


class TestStratified:
    def test_no_gradient_is_lost_where_the_compiler_computes_a_distance_twice(self):
        """Once with a fused multiply-add and once without: jnp.clip compares the two in its gradient."""
        near = np.float32([0.6369617, 0.26978672, 0.04097353])
        extremes_law(lambda near, far: stratified(None, near, far, 5), (near, 2 * near))

    @pytest.mark.parametrize("seed", KEYS)
    def test_one_sample_lies_in_each_part_of_rays_of_any_length_also_of_the_rounding_of_their_distance(self, seed):
        start, rounding = jnp.abs(numbers(4, 1000)), jnp.float32(2**-23)
        near = jnp.concatenate([jnp.array([0.0, 1e10, 1.0, 0.0]), start, start, start])
        ends = (start * (1 + steps * rounding) for steps in (0, 1, 3))
        far = jnp.concatenate([jnp.array([0.0, 1.1e10, 1 + 1e-7, 1e-8]), *ends])
        distances, edges = stratified(fresh(seed), near, far, 16)
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

    def test_keys_of_rays_draw_for_each_what_they_draw_for_it_alone(self):
        together = [strata(keys, (3,), 5) for keys in sampling.split(jax.random.split(fresh(4), 3))]
        alone = [[strata(key, (), 5) for key in jax.random.split(of_ray)] for of_ray in jax.random.split(fresh(4), 3)]
        same_bits(together, [jnp.stack(x) for x in zip(*alone, strict=True)])


class TestImportance:
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

    @hypotheses
    @given(sorted_distances(3, 9), extremes(3, 8, signed=False))
    def test_importance_samples_lie_where_the_mass_reaches_their_share(self, edges, weights):
        distances = np.asarray(drawn(None, edges, weights, 5))
        assert (
            (distances >= edges[:, :1]) & (distances <= edges[:, -1:]) & (np.diff(distances, prepend=edges[:, :1]) >= 0)
        ).all()
        at = (np.arange(5) + 0.5) / 5
        for i in range(3):
            mass = np.float64(weights[i]) + 1e-5
            cumulative = np.concatenate([[0], np.cumsum(mass) / mass.sum()])
            around = np.spacing(distances[i]) * 2
            below, above = (
                np.interp(np.float64(distances[i]) + side * around, edges[i], cumulative, left=0, right=1)
                for side in (-1, 1)
            )
            assert ((below <= at + 2e-6) & (above >= at - 2e-6)).all()

    @pytest.mark.parametrize("bins", [1000, 100_000])
    def test_a_flat_distribution_stays_flat_and_half_of_a_peak_stays_in_it(self, bins):
        edges = np.linspace(0, 1, bins + 1, dtype=np.float32)
        flat = np.ones(bins, np.float32)
        peak = flat.copy()
        peak[bins // 3] += bins
        samples = np.asarray(jax.jit(sampling.importance, static_argnums=3)(None, edges[None], flat[None], 1000))[0]
        assert np.abs(samples - (np.arange(1000) + 0.5) / 1000).max() < 1e-3
        samples = np.asarray(jax.jit(sampling.importance, static_argnums=3)(None, edges[None], peak[None], 1000))[0]
        width = 1 / bins
        in_peak = (samples >= bins // 3 * width - 1e-6) & (samples <= (bins // 3 + 1) * width + 1e-6)
        assert in_peak.mean() == pytest.approx(0.5, abs=0.01)

    @pytest.mark.parametrize("padding", [1e-5, 0.0])
    def test_a_ray_without_weights_is_sampled_evenly(self, padding):
        edges, weights = jnp.linspace(0.0, 1.0, 9), jnp.zeros(8)
        close(drawn(None, edges, weights, num_samples=4, padding=padding), (np.arange(4) + 0.5) / 4)

    def test_no_gradient_passes_through_where_the_samples_lie(self):
        gradients = jax.grad(lambda e, w: jnp.sum(importance(None, e, w, 5)), (0, 1))(EDGES, WEIGHTS)
        close(gradients, (jnp.zeros_like(EDGES), jnp.zeros_like(WEIGHTS)))


class TestMerge:
    @staticmethod
    def lists(n, m):
        """Sorted lists full of ties, within each list and between them."""
        draws = np.random.default_rng(8).integers(0, 6, (2, 3, n + m)).astype(np.float32)
        return tuple(jnp.asarray(np.sort(x, axis=-1)) for x in (draws[..., :n], draws[..., n:]))

    @pytest.mark.parametrize(("n", "m"), [(1, 1), (4, 9), (2, 300)])
    def test_is_the_stable_sort_with_ties(self, n, m):
        first, second = self.lists(n, m)
        order, rank = jax.jit(merge)(first, second)
        expected = np.argsort(np.concatenate([first, second], axis=-1), axis=-1, kind="stable")
        np.testing.assert_array_equal(order, expected)
        np.testing.assert_array_equal(rank, np.argsort(expected, axis=-1, kind="stable"))


class TestCount:
    @pytest.mark.parametrize("strictly", [False, True])
    @pytest.mark.parametrize("n", [1, 7, 511, 512])
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


def test_keys_of_the_old_kind_draw_what_new_ones_do():
    near, far = jnp.zeros(3), jnp.ones(3)
    old, new = (sampling.stratified(make(3), near, far, 4) for make in (jax.random.PRNGKey, jax.random.key))
    same_bits(old, new)
    both = zip(sampling.split(jax.random.PRNGKey(3)), sampling.split(jax.random.key(3)), strict=True)
    assert all(np.array_equal(*map(jax.random.key_data, pair)) for pair in both)
