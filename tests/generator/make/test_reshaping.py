"""Laws of reshaped variants: a linear map of the shape under which surface, normals and outsides stay what they are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.handmade import ball, box

from data_gen.make.augmentation import MOST_BEND, MOST_STRETCH, Reshaping, draw_reshaping, reshape
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.formats.mesh.surface_points import sample_surface

SEEDS = st.integers(0, 2**32 - 1)


def volume(part):
    a, b, c = np.moveaxis(part.positions[part.faces], 1, 0)
    return np.sum(a * np.cross(b, c)) / 6


@given(SEEDS)
def test_faces_still_look_outwards_and_the_volume_grows_by_the_stretch(seed):
    shape = draw_reshaping(seed)
    (part,) = reshape(Asset(parts=(box((0.3, 0.2, 0.1)),)), shape).parts
    assert volume(part) == pytest.approx(volume(box()) * np.abs(shape.stretch).prod())


@given(SEEDS)
def test_up_stays_up(seed):
    up = draw_reshaping(seed).matrix() @ [0, 1, 0]
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_the_points_of_the_new_shape_are_on_the_mapped_surface_with_its_normals(seed):
    shape, sphere = draw_reshaping(seed), Asset(parts=(ball(rows=40),))
    found = sample_surface(reshape(sphere, shape), 300, 5)
    before = found.positions @ np.linalg.inv(shape.matrix()).T
    np.testing.assert_allclose(np.linalg.norm(before, axis=1), 0.5, atol=5e-3)
    gradient = before @ np.linalg.inv(shape.matrix())  # of |M^-1 x|^2 / 2: the ellipsoid's normal
    cosine = np.sum(gradient * found.normals, axis=1) / np.linalg.norm(gradient, axis=1)
    assert cosine.min() > 0.995


def test_a_quarter_turn_takes_front_to_right_and_a_mirror_takes_right_to_left():
    turn = Reshaping(stretch=np.ones(3), degrees=90.0, roughness_exponent=1.0)
    np.testing.assert_allclose(turn.matrix() @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    mirror = Reshaping(stretch=np.array([-1.0, 1, 1]), degrees=0.0, roughness_exponent=1.0)
    np.testing.assert_allclose(mirror.matrix() @ [1, 0, 0], [-1, 0, 0])


def test_the_draws_fill_their_ranges_and_the_seed_decides():
    drawn = [draw_reshaping(seed) for seed in range(200)]
    stretch = np.array([shape.stretch for shape in drawn])
    assert np.abs(stretch).min() >= 1 / MOST_STRETCH
    assert np.abs(stretch).max() <= MOST_STRETCH
    assert 60 < np.sum(stretch[:, 0] < 0) < 140
    assert (stretch[:, 1:] > 0).all()
    assert np.histogram([shape.degrees for shape in drawn], 6, (0, 360))[0].min() > 15
    exponents = np.array([shape.roughness_exponent for shape in drawn])
    assert 1 / MOST_BEND <= exponents.min() < 0.6
    assert 1.6 < exponents.max() <= MOST_BEND
    assert drawn[7].describe() == draw_reshaping(7).describe()
