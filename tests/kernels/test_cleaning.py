import numpy as np
import pytest
from support.surfel_clouds import cloud, even_square

import spnr_jax
from spnr_jax.kernels.cleaning import denoise, find_outliers, measure_noise
from spnr_jax.surfels.sides import spiral

SIZE = np.array([1.0, 0.7, 0.5])
SEAT, BACK, LEG = (1, 0.08, 1), (1, 1, 0.08), (0.06, 1, 0.06)
CHAIR = [(SEAT, (0, 0, 0)), (BACK, (0, 0.54, -0.46))]
CHAIR += [(LEG, (x, -0.54, z)) for x in (-0.45, 0.45) for z in (-0.45, 0.45)]


def box(count: int, spread: str, size=SIZE) -> np.ndarray:
    """Points on a box around 0, as many on a face as its area asks for."""
    areas = np.prod(size) / np.repeat(size, 2)
    faces = []
    for face, number in enumerate(np.round(count * areas / areas.sum()).astype(int)):
        rng = np.random.default_rng([count, face])
        plane = even_square(number) if spread == "even" else rng.uniform(-1, 1, (number, 2))
        faces.append(np.insert(plane, face // 2, 2 * (face % 2) - 1, axis=1))
    return np.concatenate(faces) * size / 2


def sphere(count: int, spread: str) -> np.ndarray:
    points = spiral(count) if spread == "even" else np.random.default_rng(count).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def chair(count: int, spread: str) -> np.ndarray:
    areas = [x * y + y * z + z * x for (x, y, z), _ in CHAIR]
    parts = zip(CHAIR, areas, strict=True)
    return np.concatenate([box(round(count * a / sum(areas)), spread, np.array(s)) + at for (s, at), a in parts])


SHAPES = {"sphere": sphere, "box": box, "chair": chair}


def from_sphere(points: np.ndarray) -> np.ndarray:
    return np.abs(np.linalg.norm(points, axis=1) - 1)


def from_box(points: np.ndarray) -> np.ndarray:
    beyond = np.abs(points) - SIZE / 2
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return np.where(outside > 0, outside, -beyond.max(axis=1))


def with_outliers(points: np.ndarray, seed: int) -> np.ndarray:
    """The points, and behind them 1 % of their number spread over a box three times as wide as theirs."""
    reach = 1.5 * np.ptp(points, axis=0)
    return np.concatenate([points, np.random.default_rng(seed).uniform(-reach, reach, (len(points) // 100, 3))])


@pytest.mark.parametrize("spread", ["even", "random"])
@pytest.mark.parametrize("count", [300, 20000])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_clean_cloud_comes_back_itself(shape, count, spread):
    plain = cloud(SHAPES[shape](count, spread))
    before = plain.positions.copy()
    cleaned, lines = spnr_jax.clean(plain)
    assert cleaned is plain
    np.testing.assert_array_equal(plain.positions, before)
    assert lines == []


def test_a_density_that_varies_smoothly_loses_nothing():
    x, y = ((even_square(20000) + 1) / 2).T
    assert not find_outliers(np.stack([x**3, y, 0 * x], axis=-1)).any()


@pytest.mark.parametrize("count", [2000, 20000])
@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_nine_in_ten_uniform_outliers_go_and_the_surface_stays(shape, count):
    apart = [find_outliers(with_outliers(SHAPES[shape](count, "random"), seed)) for seed in range(3)]
    assert np.mean([mask[-(count // 100) :] for mask in apart]) >= 0.9
    assert np.mean([mask[: -(count // 100)] for mask in apart]) < 0.001


@pytest.mark.ci
@pytest.mark.parametrize(("shape", "distance"), [("sphere", from_sphere), ("box", from_box)])
def test_averaging_takes_three_fifths_of_the_noise_of_one_per_cent(shape, distance):
    surface = SHAPES[shape](60000, "random")
    noisy = surface + np.random.default_rng(0).normal(size=surface.shape) * 0.01
    cleaned, lines = spnr_jax.clean(cloud(noisy))
    assert distance(np.asarray(cleaned.positions)).mean() < 0.4 * distance(noisy).mean()
    assert lines[-1].startswith("averaged ")


@pytest.mark.parametrize("share", [0.3, 0.6, 1.2])
def test_the_noise_is_measured_in_the_units_of_the_points(share):
    points = sphere(20000, "even")
    true = share * np.sqrt(4 * np.pi / len(points))
    sigma, _ = measure_noise(7 * (points + np.random.default_rng(0).normal(size=points.shape) * true))
    np.testing.assert_allclose(sigma, 7 * true, rtol=0.2)


def test_materials_are_averaged_with_the_points_and_normals_stay_of_unit_length():
    points = sphere(4000, "even")
    rng = np.random.default_rng(0)
    values = {"normals": points, "base_color": np.repeat(points[:, :1], 3, axis=1) + rng.normal(size=(4000, 3)) * 0.1}
    means, values = denoise(points, values, 0.1, 0.056)
    assert len(means) == len(points)
    np.testing.assert_allclose(np.linalg.norm(values["normals"], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(values["normals"], means, atol=0.1)
    assert np.abs(values["base_color"] - means[:, :1]).mean() < 0.06
    against = np.where(rng.uniform(size=(4000, 1)) < 0.5, points, -points)
    lengths = np.linalg.norm(denoise(points, {"normals": against}, 0.25, 0.056)[1]["normals"], axis=1)
    assert np.all((np.abs(lengths - 1) < 1e-6) | (lengths == 0))
    assert (lengths == 0).any()


def layers(sigma, apart):
    """A red plate, and a blue one over it, with noise; heights where they were, and colours."""
    rng = np.random.default_rng(0)
    height = np.repeat([0.0, apart], 5000)
    flat = np.stack([*rng.uniform(-0.5, 0.5, (2, 10_000)), height], axis=1)
    color = np.where(height[:, None] > 0, [0.1, 0.1, 0.8], [0.8, 0.1, 0.1])
    return flat + rng.normal(size=flat.shape) * sigma, height, color


def test_two_layers_of_different_colours_nearer_than_the_noise_are_told_apart():
    points, height, color = layers(sigma=0.02, apart=0.02)
    order = np.lexsort(points.T)
    moved, values = denoise(points, {"base_color": color}, 0.02, 0.01)
    for layer in (height[order] > 0, height[order] == 0):
        inner = layer & (np.abs(moved[:, :2]).max(axis=1) < 0.4)
        assert np.abs(moved[inner, 2] - height[order][inner]).mean() < 0.4 * 0.016
    plain, mixed = denoise(points, {"roughness": color[:, 0]}, 0.02, 0.01)
    assert np.abs(plain[:, 2] - height[order]).mean() > 0.5 * 0.016
    upper = np.argsort(moved[:, 2])[-1000:]
    assert values["base_color"][upper, 2].mean() > 0.6 > 0.5 > mixed["roughness"].mean()


def test_noise_of_colours_hardly_keeps_points_from_being_averaged():
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(-0.5, 0.5, (2, 10_000)), np.zeros((1, 10_000))]).T
    noisy = flat + rng.normal(size=flat.shape) * 0.02
    left = [
        denoise(noisy, {"base_color": 0.5 + rng.normal(size=(10_000, 3)) * spread}, 0.02, 0.01)[0][:, 2].std()
        for spread in (0, 0.05, 0.15)
    ]
    assert max(left) < 1.35 * left[0] < 0.5 * 0.02


def test_the_order_of_the_points_does_not_matter():
    surface = with_outliers(sphere(5000, "random"), 0)
    noisy = surface + np.random.default_rng(1).normal(size=surface.shape) * 0.03
    turned = np.random.default_rng(2).permutation(len(noisy))
    (first, said), (second, again) = (spnr_jax.clean(cloud(points)) for points in (noisy, noisy[turned]))
    assert said == again
    assert len(said) == 2
    ordered = [np.asarray(c.positions)[np.lexsort(np.round(c.positions, 4).T)] for c in (first, second)]
    np.testing.assert_allclose(*ordered, atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 10, 99])
def test_a_few_points_stay_as_they_are(count):
    plain = cloud(np.random.default_rng(0).normal(size=(count, 3)))
    assert spnr_jax.clean(plain, "strong") == (plain, [])


@pytest.mark.parametrize("count", [1, 200, 5000])
def test_points_that_coincide_or_lie_on_a_line_stay_as_they_are(count):
    same, line = np.ones((count, 3)), np.linspace(0, 1, count)[:, None] * [1, 2, 3]
    for positions in (same, line, np.repeat(line, 3, axis=0)):
        plain = cloud(positions)
        assert spnr_jax.clean(plain)[0] is plain


def test_a_point_far_away_is_removed_and_the_rest_averaged():
    noisy = sphere(20000, "random") + np.random.default_rng(0).normal(size=(20000, 3)) * 0.03
    cleaned, lines = spnr_jax.clean(cloud(np.concatenate([noisy, [[1e30, 0, 0]]])))
    assert np.abs(cleaned.positions).max() < 2
    assert len(lines) == 2
    assert np.isfinite(denoise(np.concatenate([noisy, [[1e30, 0, 0]]]), {}, 0.05, 0.025)[0]).all()


def test_masked_points_neither_count_nor_stay_where_something_is_done():
    scan = with_outliers(sphere(2000, "even"), 0)
    padded = cloud(np.concatenate([scan, np.full((50, 3), 9.0)])).replace(mask=np.arange(len(scan) + 50) < len(scan))
    cleaned, lines = spnr_jax.clean(padded)
    expected, said = spnr_jax.clean(cloud(scan))
    np.testing.assert_array_equal(cleaned.positions, expected.positions)
    assert cleaned.mask.all()
    assert lines == said
