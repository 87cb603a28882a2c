"""FLIP against a float64 twin with whole 2D filters, against the authors' package, and against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import batch_law, close, gradient_law, numbers

from spnr_jax.scoring.flip import flip, flip_map

BLACK, WHITE = jnp.zeros((14, 11, 3)), jnp.ones((14, 11, 3))
IMAGE = numbers(0, 2, 3, 14, 11, 3, low=0.0)
REFERENCE = jnp.clip(IMAGE + 0.3 * numbers(1, 2, 3, 14, 11, 3), 0, 1)
error_map = jax.jit(flip_map, static_argnums=2)
value_and_gradients = jax.jit(jax.value_and_grad(flip, (0, 1)))


def correlate(plane, taps):
    half = len(taps) // 2
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(plane, half, mode="edge"), taps.shape)
    return np.einsum("ijkl,kl->ij", windows, taps)


def hyab(p, q):
    return np.abs(p[..., 0] - q[..., 0]) + np.hypot(p[..., 1] - q[..., 1], p[..., 2] - q[..., 2])


def twin(image, reference, pixels_per_degree=67.0206):
    """The error map from the paper's formulas: whole filters, and colours through YCxCz with their offsets."""
    to_xyz = np.array(
        [[0.4123864, 0.3575915, 0.1804505], [0.2126368, 0.7151830, 0.0721802], [0.0193306, 0.1191972, 0.9503726]]
    )
    white = to_xyz.sum(axis=1)
    radius = int(np.ceil(3 * np.sqrt(0.04 / (2 * np.pi**2)) * pixels_per_degree))
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1] / pixels_per_degree
    filters = []
    for terms in ([(1, 0.0047)], [(1, 0.0053)], [(34.1, 0.04), (13.5, 0.025)]):
        s = sum(a * np.sqrt(np.pi / b) * np.exp(-(np.pi**2) * (x**2 + y**2) / b) for a, b in terms)
        filters.append(s / s.sum())

    def lab(rgb):
        t = (rgb @ to_xyz.T) / white
        t = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
        lightness = 116 * t[..., 1] - 16
        a, b = 500 * (t[..., 0] - t[..., 1]), 200 * (t[..., 1] - t[..., 2])
        return np.stack([lightness, 0.01 * lightness * a, 0.01 * lightness * b], axis=-1)

    deviation = 0.5 * 0.082 * pixels_per_degree
    radius = int(np.ceil(3 * deviation))
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    bell = np.exp(-(x**2 + y**2) / (2 * deviation**2))
    detectors = []
    for taps in (-x * bell, (x**2 / deviation**2 - 1) * bell):
        detectors.append(np.where(taps > 0, taps / taps[taps > 0].sum(), taps / -taps[taps < 0].sum()))

    colors, strengths = [], []
    for picture in (np.float64(image), np.float64(reference)):
        linear = np.where(picture > 0.04045, ((picture + 0.055) / 1.055) ** 2.4, picture / 12.92)
        xyz = (linear @ to_xyz.T) / white
        planes = 116 * xyz[..., 1] - 16, 500 * (xyz[..., 0] - xyz[..., 1]), 200 * (xyz[..., 1] - xyz[..., 2])
        f = [correlate(plane, taps) for plane, taps in zip(planes, filters, strict=True)]
        luminance = (f[0] + 16) / 116
        seen = np.stack([luminance + f[1] / 500, luminance, luminance - f[2] / 200], axis=-1) * white
        colors.append(lab(np.clip(seen @ np.linalg.inv(to_xyz).T, 0, 1)))
        plane = (planes[0] + 16) / 116
        strengths.append([np.hypot(correlate(plane, d), correlate(plane, d.T)) for d in detectors])
    largest = hyab(lab(np.array([0.0, 1, 0])), lab(np.array([0.0, 0, 1]))) ** 0.7
    error = hyab(*colors) ** 0.7
    knee = 0.4 * largest
    color = np.where(error < knee, 0.95 / knee * error, 0.95 + 0.05 * (error - knee) / (largest - knee))
    feature = np.sqrt(np.max([np.abs(p - q) for p, q in zip(*strengths, strict=True)], axis=0) / np.sqrt(2))
    return color ** (1 - feature)


@pytest.mark.parametrize("pixels_per_degree", [67.0206, 20.0])
def test_is_the_papers_formulas_with_whole_filters_in_float64(pixels_per_degree):
    for image, reference in ((IMAGE[0, 0], REFERENCE[0, 0]), (IMAGE[1, 2], WHITE), (0.02 * IMAGE[0, 1], BLACK)):
        close(
            error_map(image, reference, pixels_per_degree),
            twin(image, reference, pixels_per_degree),
            rtol=1e-4,
            atol=1e-4,
        )


def scene(seed):
    """A shaded ball on white, as pictures of objects look, with a little noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-1:1:48j, -1:1:64j]
    height = 1 - x**2 - y**2
    shade = np.clip(0.3 + 0.7 * np.sqrt(np.maximum(height, 0)) + 0.3 * x, 0, 1)[..., None] * rng.random(3)
    return np.float32(np.clip(np.where(height[..., None] > 0.2, shade, 1) + 0.02 * rng.normal(size=(48, 64, 3)), 0, 1))


def test_the_mean_is_that_of_the_authors_package():
    package = pytest.importorskip("flip_evaluator", reason="the parity test needs flip-evaluator (extra dev)")
    rng = np.random.default_rng(0)
    random = [np.float32(rng.random((48, 64, 3))) for _ in range(2)]
    corners = [np.float32(rng.integers(0, 2, (48, 64, 3))) for _ in range(2)]
    flat = [np.full((48, 64, 3), value, np.float32) for value in (0, 1, 0.5)]
    near = random[0], np.float32(np.clip(random[0] + 1e-3 * rng.normal(size=random[0].shape), 0, 1))
    pairs = [
        random,
        corners,
        near,
        flat[:2],
        flat[1:],
        (scene(0), scene(1)),
        (scene(0), flat[1]),
        (flat[0], 1e-3 * random[0]),
    ]
    for image, reference in pairs:
        expected_map, expected, settings = package.evaluate(reference, image, "LDR", applyMagma=False)
        assert settings["ppd"] == pytest.approx(67.02, abs=0.01)
        measured = np.asarray(error_map(image, reference))
        assert measured.mean(dtype=np.float64) == pytest.approx(expected_map.mean(dtype=np.float64), abs=2e-5)
        assert measured.mean(dtype=np.float64) == pytest.approx(expected, abs=1e-4)  # summed in float32 there
        assert np.abs(measured - expected_map[..., 0]).max() < 2e-3


def test_obeys_the_batch_law():
    batch_law(flip, IMAGE, REFERENCE)


def test_identical_images_differ_by_nothing_and_have_no_gradient():
    value, gradient = value_and_gradients(IMAGE[0, 0], IMAGE[0, 0])
    assert value == 0
    assert all((g == 0).all() for g in gradient)
    assert (error_map(IMAGE, IMAGE) == 0).all()


def test_is_symmetric_and_between_0_and_1():
    corners = jnp.round(IMAGE)
    for image, reference in ((IMAGE, REFERENCE), (corners, 1 - corners)):
        forward = error_map(image, reference)
        close(forward, error_map(reference, image))
        assert 0 <= forward.min() <= forward.max() <= 1 + 1e-6


def test_green_and_blue_are_as_far_apart_as_colours_can_be():
    green, blue = jnp.zeros_like(BLACK).at[..., 1].set(1), jnp.zeros_like(BLACK).at[..., 2].set(1)
    close(error_map(green, blue), np.ones((14, 11)))


def test_flat_greys_differ_by_their_lightness_alone():
    lab_green, lab_blue = (87.735, -86.183, 83.180), (32.297, 79.188, -107.860)  # published L*a*b* of sRGB, D65
    chroma = np.hypot(*(lab_green[0] * lab_green[i] - lab_blue[0] * lab_blue[i] for i in (1, 2))) / 100
    largest = (lab_green[0] - lab_blue[0] + chroma) ** 0.7
    assert flip(BLACK, WHITE) == pytest.approx(0.95 + 0.05 * (100**0.7 / largest - 0.4) / 0.6, abs=1e-4)
    grey = 0.01 * WHITE  # dark enough for the straight part of L*: 903.3 times the luminance
    assert flip(BLACK, grey) == pytest.approx(0.95 / 0.4 * (903.3 * 0.01 / 12.92) ** 0.7 / largest, rel=1e-3)


def test_a_fine_pattern_is_seen_less_the_further_away_the_viewer_is():
    pattern = jnp.broadcast_to((jnp.indices((30, 30)).sum(axis=0) % 2).astype(jnp.float32)[..., None], (30, 30, 3))
    grey = jnp.full((30, 30, 3), 0.7354)  # half the light of white
    near, middle, far = (error_map(pattern, grey, distance)[15, 15] for distance in (5.0, 15.0, 67.0))
    assert near > middle > 0.9
    assert far < 0.01


def test_a_difference_at_an_edge_counts_more_than_the_same_colours_alone():
    half = WHITE.at[:, :5].set(0.2)
    moved = WHITE.at[:, :6].set(0.2)
    assert flip_map(half, WHITE)[7, 4] > flip_map(jnp.full_like(WHITE, 0.2), WHITE)[7, 4] - 0.05
    assert flip_map(half, moved)[7, 5] > flip_map(half, moved)[7, 10]


def test_gradients_are_those_of_float64_and_of_finite_differences():
    gradient_law(flip, IMAGE[0, 0] * 0.8 + 0.1, REFERENCE[0, 0] * 0.8 + 0.1)


@pytest.mark.parametrize("image", [BLACK, WHITE, IMAGE[0, 0], jnp.round(IMAGE[0, 1])])
@pytest.mark.parametrize("reference", [BLACK, WHITE, REFERENCE[0, 0]])
def test_gradients_are_finite_at_the_extremes(image, reference):
    value, gradients = value_and_gradients(image, reference)
    assert jnp.isfinite(value)
    assert all(jnp.isfinite(gradient).all() for gradient in gradients)
