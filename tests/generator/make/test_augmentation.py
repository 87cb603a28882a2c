"""Laws of variants: a rotation of all base colours, inside the gamut; a linear map under which a surface stays one."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from support.handmade import ball, box, enclosed_volume, plain

from data_gen.make import augmentation
from data_gen.make.augmentation import Reshaping, draw_reshaping, reshape
from spnr_jax.formats.assets import Asset, Material
from spnr_jax.formats.surface_points import sample_surface

UNIT = st.floats(0, 1, width=32)
SEEDS = st.integers(0, 2**32 - 1)
SLOW = settings(deadline=None, max_examples=25)


def distances(colours):
    return np.linalg.norm(colours[:, None] - colours[None], axis=-1)


def painted(texels, flat, corners) -> Asset:
    """A box with a texture, a ball of one colour and a box with colours at its vertices."""
    texture = Material(base_color=texels, roughness=np.float32(0.5), metallic=np.float32(0))
    tinted = box((0, 1, 0), material=plain(flat))
    tinted = type(tinted)(**{**vars(tinted), "colors": np.resize(corners, tinted.positions.shape)})
    return Asset(parts=(box(material=texture, texcoords=True), ball((1, 0, 0), material=plain(flat)), tinted))


ASSETS = st.builds(
    painted,
    arrays(np.float32, (3, 2, 3), elements=UNIT),
    arrays(np.float32, (3,), elements=UNIT),
    arrays(np.float64, (5, 3), elements=UNIT),
)


@SLOW
@given(ASSETS, SEEDS)
def test_colours_are_rotated_within_the_gamut_everywhere_and_nothing_else_changes(asset, seed):
    rotated, rotation = augmentation.rotate_colors(asset, seed)
    before, after = augmentation.base_colors(asset), augmentation.base_colors(rotated)
    assert 0 <= after.min() <= after.max() <= 1
    np.testing.assert_allclose(distances(after), distances(before), atol=1e-5)
    before, after = (sample_surface(shape, 200, 3) for shape in (asset, rotated))
    np.testing.assert_allclose(after.base_color, before.base_color @ rotation.matrix.T, atol=1e-5)
    for name in ("positions", "normals", "roughness", "metallic", "face"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


@given(st.floats(0, 360))
def test_it_is_a_rotation_that_keeps_greys(degrees):
    matrix = augmentation.grey_rotation(degrees)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_allclose(matrix @ np.full(3, 0.3), np.full(3, 0.3))
    assert np.trace(matrix) == pytest.approx(1 + 2 * np.cos(np.radians(degrees)))


def test_colours_that_leave_no_room_are_permuted_and_the_object_says_so():
    asset = Asset(parts=(ball(material=plain((1, 0, 0))), box(material=plain((0, 1, 1)))))
    rotated, rotation = augmentation.rotate_colors(asset, 0)
    assert rotation.describe()["fallback"]
    assert rotation.degrees in (120, 240)
    assert {tuple(part.material.base_color.round(6)) for part in rotated.parts} in (
        {(0, 1, 0), (1, 0, 1)},
        {(0, 0, 1), (1, 1, 0)},
    )


def test_muted_colours_turn_any_way_and_the_seed_decides_which():
    asset = Asset(parts=(ball(material=plain((0.5, 0.4, 0.45))),))
    turns = [augmentation.rotate_colors(asset, seed)[1] for seed in range(200)]
    assert not any(turn.fallback for turn in turns)
    assert np.histogram([turn.degrees for turn in turns], 6, (30, 330))[0].min() > 15
    assert turns[7].describe() == augmentation.rotate_colors(asset, 7)[1].describe()


def test_a_rare_saturated_texel_is_not_overlooked():
    texels = np.full((4096, 3), 0.5, np.float32)
    texels[2573] = (1, 0, 0.2)
    for seed in range(20):
        rotated = texels @ augmentation.draw_rotation(texels, seed).matrix.T
        assert -1e-5 < rotated.min() <= rotated.max() < 1 + 1e-5


# shape


@given(SEEDS)
def test_faces_still_look_outwards_the_volume_grows_by_the_stretch_and_up_stays_up(seed):
    shape = draw_reshaping(seed)
    (part,) = reshape(Asset(parts=(box((0.3, 0.2, 0.1)),)), shape).parts
    assert enclosed_volume(part.positions, part.faces) == pytest.approx(np.abs(shape.stretch).prod())  # of a cube of 1
    up = shape.matrix() @ [0, 1, 0]
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
