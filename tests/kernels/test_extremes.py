"""Every kernel at inputs that nobody meant to give it, against its float64 twin; gradients are finite and float64's.

Sizes run from 1e-30 to 1e30 wherever float32 can hold the answer, and include zeros, ties, one-hot inputs and subnormal
numbers (zeros to XLA).  Each module's own tests have the closed forms, batch ranks and special cases.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import reference
from support.laws import TINY, close, extremes, float64_law, hypotheses, numbers

from spnr_jax.kernels import cameras, colors, compositing, numerics, sampling, voxels
from spnr_jax.nn.encoding import encode_direction
from spnr_jax.nn.normalization import BatchNorm

BINS, SAMPLES, POINTS = 8, 5, 12
FINITE = 1e30  # a floor under which gradients only have to be finite
seeds = st.integers(0, 999)


@st.composite
def intervals(draw, *shape):
    """Sorted distances (*shape) of one size, which is any; some have ties, some are all equal."""
    parts = draw(st.sampled_from([1, 4, 1000]))
    x = np.round(parts * np.random.default_rng(draw(seeds)).random(shape)) / parts
    return np.float32(np.sort(x, axis=-1) * 10.0 ** draw(st.integers(-30, 30)))


def on_grid(positions):
    """Positions whose place in a volume float32 computes without rounding, so that both precisions see one voxel."""
    return np.where(np.abs(positions) < 8, np.round(positions * 2**20) / 2**20, positions).astype(np.float32)


def inside_or_not(seed, scale=1.3):
    return on_grid(scale * np.asarray(numbers(seed, POINTS, 3)))


class TestVectors:
    @hypotheses
    @given(extremes(4, 3, low=-36, high=36))
    def test_length_and_direction_of_any_vector(self, vectors):
        vectors = np.where(np.abs(vectors) < TINY, 0, vectors)
        length, unit = float64_law(lengths, vectors)
        expected = np.linalg.norm(np.float64(vectors), axis=-1)
        close(length, expected, rtol=1e-6, atol=0)
        directions = np.float64(vectors) / np.where(expected > 0, expected, 1)[:, None]
        close(unit, directions, rtol=1e-6, atol=1e-37)

    @hypotheses
    @given(extremes(6), extremes(6, low=-17, high=17))
    def test_a_quotient_is_the_quotient_or_zero(self, numerator, denominator):
        quotient = float64_law(numerics.safe_divide, numerator, denominator)
        zero = np.abs(denominator) < TINY
        expected = np.float64(numerator) / np.where(zero, 1, np.float64(denominator))
        expected = np.where(zero | (np.abs(expected) < TINY), 0, expected)
        held = np.abs(expected) < 3e38
        close(quotient[held], expected[held], rtol=1e-6, atol=1e-37)

    @hypotheses
    @given(extremes(6, high=36))
    def test_softplus_of_any_number(self, x):
        close(float64_law(numerics.softplus, x), reference.softplus(x), rtol=1e-6, atol=1e-37)

    @hypotheses
    @given(extremes(6, high=15, signed=False))
    def test_the_transfer_functions_of_any_number(self, x):
        encoded, linear = float64_law(transfer, x)
        x = np.float64(x)
        with np.errstate(under="ignore"):
            close(encoded, np.where(x > 0.0031308, 1.055 * x ** (1 / 2.4) - 0.055, 12.92 * x), 2e-6, 1e-37)
            close(linear, np.where(x > 0.04045, ((x + 0.055) / 1.055) ** 2.4, x / 12.92), 1e-5, 1e-37)


def lengths(vectors):
    return numerics.length(vectors), numerics.normalize(vectors)


def transfer(x):
    return colors.linear_to_srgb(x), colors.srgb_to_linear(x)


class TestBox:
    @hypotheses
    @given(extremes(5, 3, low=-30, high=4), extremes(5, 3))
    def test_the_interval_of_any_ray(self, origins, directions):
        directions = np.asarray(numerics.normalize(jnp.asarray(directions)))
        near, far = float64_law(box, origins, directions, floors=(FINITE, FINITE))  # ties are split or not
        assert ((near >= 0) & (near <= far)).all()
        for i in range(5):
            expected = reference.box_interval(origins[i], directions[i]) if directions[i].any() else None
            expected = expected or (0.0, 0.0)
            rounding = 1e-6 * (1 + np.abs(origins[i]).max())
            if expected[1] - expected[0] > rounding:
                close((near[i], far[i]), expected, rtol=1e-5, atol=rounding)
            else:
                assert far[i] - near[i] <= 2 * rounding, "a ray that touches may hit or miss"

    @hypotheses
    @given(extremes(5, 3), extremes(5, 3))
    def test_rays_from_anywhere_have_finite_intervals_and_a_miss_has_none(self, origins, directions):
        near, far, hit = jax.jit(cameras.intersect_box)(origins, numerics.normalize(jnp.asarray(directions)))
        assert (np.isfinite(near) & np.isfinite(far) & (near >= 0)).all()
        assert ((near < far) == hit).all()
        assert (far[~hit] == 0).all()


def box(origins, directions):
    return cameras.intersect_box(origins, directions)[:2]


class TestSampling:
    @hypotheses
    @given(extremes(3, signed=False), extremes(3, signed=False))
    def test_stratified_samples_are_the_middles_of_any_interval(self, near, length):
        far = near + length
        long = (length > 1e-5 * near).all()  # shorter ones round to either edge, and so do their gradients
        distances, edges = float64_law(middles, near, far, floors=(0, 0) if long else (FINITE, FINITE))
        for i in range(3):
            expected = near[i] + (np.float64(far[i]) - near[i]) * np.arange(2 * SAMPLES + 1) / (2 * SAMPLES)
            close((edges[i], distances[i]), (expected[::2], expected[1::2]), rtol=2e-6, atol=TINY)
        assert ((edges[:, :-1] <= distances) & (distances <= edges[:, 1:])).all()

    @hypotheses
    @given(intervals(3, BINS + 1), extremes(3, BINS, signed=False))
    def test_importance_samples_lie_where_the_mass_reaches_their_share(self, edges, weights):
        distances = np.asarray(drawn(edges, weights))
        assert (
            (distances >= edges[:, :1]) & (distances <= edges[:, -1:]) & (np.diff(distances, prepend=edges[:, :1]) >= 0)
        ).all()
        at = (np.arange(SAMPLES) + 0.5) / SAMPLES
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


def middles(near, far):
    return sampling.stratified(None, near, far, SAMPLES)


@jax.jit
def drawn(edges, weights):
    return sampling.importance(None, edges, weights, SAMPLES)


class TestCompositing:
    @hypotheses
    @given(extremes(3, BINS, signed=False), extremes(3, BINS, signed=False))
    def test_weights_of_any_density_and_length(self, density, delta):
        weights, residual = float64_law(compositing.volume_weights, density, delta)
        assert (weights >= 0).all()
        close(weights.sum(-1) + residual, np.ones(3), rtol=0, atol=1e-6)
        for i in range(3):
            close((weights[i], residual[i]), reference.volume_weights(density[i], delta[i]), rtol=1e-5, atol=1e-12)

    @hypotheses
    @given(extremes(3, BINS, signed=False), extremes(3, BINS, 2), st.sampled_from([0, 1, -1e-30, 1e30]))
    def test_colours_of_any_size_over_any_background(self, density, values, background):
        weights = np.asarray(compositing.volume_weights(jnp.asarray(density), jnp.ones((3, BINS)))[0])
        color = float64_law(over, weights, values, np.full(2, background, np.float32), floors=(0, 0, 1))
        largest = max(np.abs(values).max(), abs(background))
        for i in range(3):
            expected = reference.composite(weights[i], values[i], background)
            close(color[i], expected, rtol=0, atol=2e-6 * largest + TINY)

    @hypotheses
    @given(extremes(3, BINS, signed=False), intervals(3, BINS + 2))
    def test_the_distance_of_any_ray_lies_between_its_first_sample_and_its_end(self, density, edges):
        distances, far = edges[:, 1:-1], edges[:, -1]
        distance, weights = float64_law(seen_at, density, distances, far, floors=(1e-3 * float(far.max()) ** 2, 1, 1))
        slack = 2e-6 * far
        assert ((distance >= distances[:, 0] - slack) & (distance <= far + slack)).all()
        for i in range(3):
            expected = reference.composite(weights[i], distances[i][:, None], far[i])[0]
            close(distance[i], expected, rtol=2e-6, atol=slack[i])


def over(weights, values, background):
    return compositing.composite(weights, values, jnp.broadcast_to(background, (*weights.shape[:-1], 2)))


def seen_at(density, distances, far):
    delta = compositing.interval_lengths(distances, far)
    weights, _ = compositing.volume_weights(density, jax.lax.stop_gradient(delta))
    return compositing.expected_distance(weights, distances, far), jax.lax.stop_gradient(weights)


class TestVoxels:
    @hypotheses
    @given(
        st.sampled_from([1, 4]),
        st.one_of(extremes(POINTS, 3), seeds),
        extremes(POINTS, 2),
        seeds,
        st.sampled_from([0, 0.6, 1]),
    )
    def test_means_of_any_points_wherever_they_are(self, resolution, positions, features, seed, share):
        positions = inside_or_not(positions) if isinstance(positions, int) else on_grid(positions)
        mask = np.random.default_rng(seed).random(POINTS) < share
        volume, occupancy = float64_law(scattering(resolution), features, positions, np.float32(mask))
        expected = reference.scatter_mean(positions, features, mask, resolution)
        close(occupancy, expected[1])
        close(volume, expected[0], rtol=1e-6, atol=1e-6 * np.abs(features).max() + TINY)

    @hypotheses
    @given(st.sampled_from([1, 4]), extremes(128), st.one_of(extremes(POINTS, 3), seeds))
    def test_lookups_in_any_volume_from_anywhere(self, resolution, values, positions):
        positions = inside_or_not(positions) if isinstance(positions, int) else on_grid(positions)
        volume = values[: 2 * resolution**3].reshape(*[resolution] * 3, 2)
        found = float64_law(voxels.trilinear, volume, positions, floors=(0, np.abs(volume).max()))
        for i in range(POINTS):
            close(found[i], reference.trilinear(volume, positions[i]), rtol=0, atol=1e-6 * np.abs(volume).max() + TINY)


@functools.cache
def scattering(resolution):
    return lambda features, positions, mask: voxels.scatter_mean(positions, features, mask > 0.5, resolution)


class TestBatchNorm:
    @hypotheses
    @given(extremes(POINTS, 3, high=17), seeds, st.sampled_from([0, 0.5, 1]), st.sampled_from([0, 1e30, np.nan]))
    def test_statistics_of_any_features_whatever_fills_the_padding(self, x, seed, share, fill):
        mask = np.random.default_rng(seed).random(POINTS) < share
        out, stats = float64_law(normalized(fill), x, np.float32(mask))
        expected, mean, variance = reference.batch_norm(x[mask])
        # a mean is rounded relative to its size, and the output counts in standard deviations
        rounding = 1e-6 * np.abs(x).max() / np.sqrt(variance + 1e-5)
        close(out[mask], expected, rtol=1e-5, atol=rounding.max() + 1e-6)
        assert np.isfinite(out[mask]).all()
        close(stats["mean"], 0.1 * mean, rtol=1e-5, atol=1e-6 * np.abs(x).max() + TINY)
        count = max(mask.sum(), 1)
        unbiased = variance * count / max(count - 1, 1)
        close(stats["variance"], 0.9 + 0.1 * unbiased, rtol=1e-5, atol=1e-6 * np.abs(x).max() ** 2)


@functools.cache
def normalized(fill):
    def kernel(x, mask):
        real = mask > 0.5
        x = jnp.where(real[:, None], x, fill)
        variables = {
            "params": {"scale": jnp.ones(3, x.dtype), "bias": jnp.zeros(3, x.dtype)},
            "batch_stats": {"mean": jnp.zeros(3, x.dtype), "variance": jnp.ones(3, x.dtype)},
        }
        out, updated = BatchNorm().apply(variables, x, real, True, mutable=["batch_stats"])
        return jnp.where(real[:, None], out, 0), jax.lax.stop_gradient(updated["batch_stats"])

    return kernel


@hypotheses
@given(extremes(4, 3, high=3))
def test_ten_frequencies_of_coordinates_up_to_a_thousand_are_off_by_less_than_a_thousandth(x):
    x = np.clip(x, -1e3, 1e3)
    encoded = float64_law(ten_frequencies, x)
    parts = [np.float64(x)] + [f(np.float64(x) * 2**k) for k in range(10) for f in (np.sin, np.cos)]
    assert np.abs(encoded - np.concatenate(parts, axis=-1)).max() < 1e-3


def ten_frequencies(x):
    return encode_direction(x, 10)
