"""Splats drawn: a plain twin, closed forms, order, gradients."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import splat_balls, splat_twin

from spnr_jax.gaussians import drawing
from spnr_jax.gaussians.harmonics import C0, basis, coefficients, degree_of, half_turn_signs
from spnr_jax.kernels.records import Gaussians


def one(position=(0.0, 0.0, 0.0), width=0.1, opacity=0.8, color=(1.0, 0.5, 0.0)):
    return Gaussians(
        position=np.float32([position]),
        rotation=np.float32([[1, 0, 0, 0]]),
        scale=np.full((1, 3), width, np.float32),
        opacity=np.float32([opacity]),
        harmonics=((np.float32([[color]]) - 0.5) / C0).astype(np.float32),
    )


def _looked(splats, size):
    foot, _ = drawing.looked(splats, splat_balls.camera(size=size), jnp.float32(drawing.DILATION))
    return foot, splats.opacity


def joined(*splats):
    return jax.tree.map(lambda *x: np.concatenate(x), *splats)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_picture_is_that_of_the_plain_twin(degree):
    splats, camera = splat_balls.ball(120, degree), splat_balls.camera(size=32)
    image, opacity = drawing.draw(splats, camera)
    wanted, wanted_opacity = splat_twin.draw(splats, camera, drawing.DILATION)
    np.testing.assert_allclose(image, wanted, atol=3e-4)
    np.testing.assert_allclose(opacity, wanted_opacity, atol=3e-4)


def test_a_splat_in_the_middle_has_its_opacity_and_colour_there():
    camera = splat_balls.camera(0, 0, size=33)
    image, opacity = drawing.draw(one(), camera, dilation=0)
    assert opacity[16, 16] == pytest.approx(0.8, abs=1e-4)
    np.testing.assert_allclose(image[16, 16], 0.8 * np.array([1, 0.5, 0]) + 0.2, atol=1e-4)
    variance = (0.1 * float(camera.intrinsics[0, 0]) / 3) ** 2
    assert opacity[16, 17] == pytest.approx(0.8 * np.exp(-0.5 / variance), abs=1e-3)


def test_a_splat_smaller_than_a_pixel_hides_as_much_as_it_should():
    """On average over where in a pixel it lies: a picture samples it at the pixels' middles."""
    camera = splat_balls.camera(0, 0, size=33)
    pixel = 3 / float(camera.intrinsics[0, 0])
    across = (np.arange(4) + 0.5) / 4 * pixel
    large, small = (
        np.mean([drawing.draw(one((x, y, 0), width=width), camera)[1].sum() for x in across for y in across])
        for width in (0.1, 0.01)
    )
    assert small == pytest.approx(large / 100, rel=0.05)


def test_what_is_nearer_hides_what_is_behind_in_whatever_order_they_come():
    near, far = one((0, 0, 0.5), color=(1, 0, 0), opacity=0.9), one((0, 0, -0.5), color=(0, 0, 1), opacity=0.9)
    camera = splat_balls.camera(0, 0, size=33)
    first, _ = drawing.draw(joined(near, far), camera, dilation=0)
    second, _ = drawing.draw(joined(far, near), camera, dilation=0)
    np.testing.assert_array_equal(first, second)
    red, green, blue = first[16, 16]
    assert red > 0.8
    assert blue < 0.2
    assert green < 0.05


def test_nothing_in_sight_is_the_background():
    away = one((0.0, 0.0, 10.0))  # behind the camera
    image, opacity = drawing.draw(away, splat_balls.camera(0, 0, size=8), background=0.25)
    assert (image == 0.25).all()
    assert (opacity == 0).all()


def test_every_second_pixel_is_that_of_the_whole_picture():
    splats, camera = splat_balls.ball(), splat_balls.camera(size=32)
    whole, _ = drawing.draw(splats, camera)
    for column, row in ((0, 0), (1, 0), (1, 1)):
        share, _ = drawing.draw(splats, drawing.every(camera, 2, column, row), dilation=drawing.DILATION / 4)
        np.testing.assert_allclose(share, whole[row::2, column::2], atol=2e-3)


def test_gradients_are_those_of_differences():
    splats, camera = splat_balls.ball(30), splat_balls.camera(size=16)
    foot, _ = drawing.looked(splats, camera, jnp.float32(0.3))
    found = drawing.lists(foot, splats.opacity, 16, 16)
    pattern = np.random.default_rng(0).normal(size=(len(found.pixel), 4)).astype(np.float32)

    @jax.jit
    def value(scale, opacity, harmonics):
        changed = dataclasses.replace(splats, scale=scale, opacity=opacity, harmonics=harmonics)
        seen = drawing.footprints(changed, camera)
        color = drawing.colors(changed, camera.cam_to_world[:, 3])
        return jnp.sum(pattern * drawing.blend(seen, color, opacity, found, 16))

    arguments = [jnp.asarray(x) for x in (splats.scale, splats.opacity, splats.harmonics)]
    gradients = jax.grad(value, argnums=(0, 1, 2))(*arguments)
    for i, (argument, gradient) in enumerate(zip(arguments, gradients, strict=True)):
        step = 1e-3 * np.random.default_rng(1).normal(size=argument.shape).astype(np.float32) * np.abs(argument).mean()
        ends = [value(*[x + sign * step if j == i else x for j, x in enumerate(arguments)]) for sign in (-1, 1)]
        assert float(ends[1] - ends[0]) / 2 == pytest.approx(float(jnp.sum(gradient * step)), rel=0.05, abs=2e-4)


def test_harmonics_are_orthonormal_and_turn_half_around_by_signs():
    nodes = np.random.default_rng(0).normal(size=(200_000, 3))
    nodes /= np.linalg.norm(nodes, axis=1, keepdims=True)
    values = basis(nodes, 3)
    np.testing.assert_allclose(4 * np.pi * values.T @ values / len(nodes), np.eye(16), atol=0.03)
    np.testing.assert_allclose(basis(nodes * [1, -1, -1], 3), values * half_turn_signs(3), atol=1e-12)
    assert [degree_of(coefficients(degree)) for degree in range(4)] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="got 5"):
        degree_of(5)


def test_a_small_picture_of_many_splats_is_as_opaque_as_a_large_one():
    splats = splat_balls.ball(2000)
    small, large = (drawing.draw(splats, splat_balls.camera(size=size))[1] for size in (24, 96))
    inside = np.s_[8:16, 8:16]
    assert drawing.lists(*_looked(splats, 24), 24, 24).splats.shape[0] >= 32
    np.testing.assert_allclose(small[inside], large.reshape(24, 4, 24, 4).mean(axis=(1, 3))[inside], atol=0.12)


def test_the_lists_are_no_longer_than_asked_for_and_hold_the_nearest():
    many = joined(*(one((0, 0, 0.1 * i), opacity=0.5) for i in range(8)))
    foot, _ = drawing.looked(many, splat_balls.camera(0, 0, size=9), jnp.float32(0.3))
    found = drawing.lists(foot, many.opacity, 9, 9, most=4)
    middle = found.splats[:, found.pixel.tolist().index(4 * 9 + 4)]
    assert middle.tolist() == [7, 6, 5, 4]
