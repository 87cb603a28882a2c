"""What the network sees of a G-buffer, and the maps that it lights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close
from support.surfel_clouds import camera, shape, surfels

from spnr_jax.kernels.records import Camera
from spnr_jax.nn import shader
from spnr_jax.surfels import blending, splatting
from spnr_jax.surfels.lighting import WIDTH, light_of

VIEW = (1.4, 0.9, 1.7)
BALL = surfels(*shape("sphere", 500))


def sky():
    return np.random.default_rng(0).uniform(0, 2, (32, WIDTH, 3)).astype(np.float32)


@jax.jit
def drawn(found, light, view):
    found = shader.face_camera(found, view)
    foot = splatting.project_discs(found, view)
    entries, _ = splatting.make_entries(foot, view, capacity=2**15)
    buffer = blending.blend(entries, foot, found, shader.compute_attributes(found, light, view), view, slots=24**2)
    return buffer, *shader.compute_inputs(buffer, light, view)[:2]


def test_normals_of_discs_seen_from_behind_are_turned_to_the_camera_and_others_kept():
    positions, normal, _ = shape("sphere", 500)
    view = camera(24)
    turned = shader.face_camera(BALL, view).normal
    towards = np.asarray(view.cam_to_world)[:, 3] - positions
    assert np.all(np.sum(towards * np.asarray(turned), axis=1) >= 0)
    close(turned, normal * np.where(np.sum(towards * normal, axis=1) < 0, -1, 1)[:, None])


def test_the_network_sees_no_light():
    (_, one, _), (_, other, _) = (drawn(BALL, light_of(scale * sky()), camera(24)) for scale in (0.0, 3.0))
    assert one.shape == (24, 24, shader.NUM_FEATURES)
    close(one, other)


@pytest.mark.parametrize(("name", "column"), [("materials_unknown", 30), ("learned", 31)])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_one_input_says_whether_materials_are_unknown_and_one_whether_points_are_learned_and_no_other_does(
    name, column, share
):
    said = dataclasses.replace(BALL, **{name: jnp.full(500, share)})
    (buffer, one, _), (_, other, _) = (drawn(found, light_of(sky()), camera(24, VIEW)) for found in (BALL, said))
    one, other = np.array(one), np.array(other)
    assert np.all(one[..., column] == 0)
    inside = np.asarray(buffer.opacity) > 0.9
    expected = share * (buffer.opacity / (buffer.opacity + shader.FAINT))[inside]
    close(other[inside, column], expected, atol=1e-5)
    close(np.delete(one, column, axis=-1), np.delete(other, column, axis=-1))


def test_the_last_number_tells_a_texture_from_one_colour():
    patches = np.where(np.random.default_rng(0).random((500, 1)) < 0.5, 0.1, 0.9) * np.ones(3)
    painted = surfels(*shape("sphere", 500), base_color=patches)
    (buffer, one, _), (_, other, _) = (drawn(found, light_of(sky()), camera(24, VIEW)) for found in (BALL, painted))
    inside = np.asarray(buffer.opacity) > 0.9
    assert np.asarray(one)[inside, -1].max() < 1e-2
    assert 0.1 < np.asarray(other)[inside, -1].mean() <= 0.4 + 1e-3


def test_without_points_everything_is_finite_and_what_the_network_sees_is_0():
    found = surfels(np.float32([[0, 0, 9.0]] * 500), (0, 0, 1.0), 0.1)
    buffer, seen, maps = drawn(found, light_of(sky()), camera(24))
    assert np.all(np.asarray(seen) == 0)
    assert np.isfinite(np.asarray(maps)).all()
    assert np.all(np.asarray(maps)[..., 4] == 0)


def test_a_pixel_in_a_dent_lies_behind_the_mean_around_it_and_one_on_a_bump_before():
    depth = jnp.full((32, 32), 2.0).at[8, 8].set(2.2).at[24, 24].set(1.8)
    zeros, ones = jnp.zeros((32, 32)), jnp.ones((32, 32))
    normal = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (32, 32, 3))
    buffer = shader.GBuffer(
        opacity=ones, coverage=ones, depth=depth, depth_deviation=zeros, log_spacing=jnp.log(0.1 * ones),
        normal=normal, color=normal, attributes=jnp.full((32, 32, 19), 0.5),
        sharp_weight=ones, centre_offset=jnp.zeros((32, 32, 2)),
    )  # fmt: skip
    view = Camera(cam_to_world=jnp.eye(3, 4), intrinsics=camera(32).intrinsics, height=32, width=32)
    seen = jax.jit(shader.compute_inputs)(buffer, light_of(sky()), view).inputs
    for column in (7, 8):
        assert seen[8, 8, column] > 0.3
        assert seen[24, 24, column] < -0.3
        close(seen[16, 16, column], 0.0, atol=1e-4)


@pytest.mark.parametrize("doublings", [1, 2])
def test_the_pixels_that_the_network_makes_of_one_do_not_alternate(doublings):
    network, inputs = shader.Shader((4,), 4), jnp.full((1, 32, 32, shader.NUM_FEATURES), 0.5)
    shapes = jax.eval_shape(lambda: network.init(jax.random.key(0), inputs, doublings))
    noise = np.random.default_rng(0)
    weights = jax.tree.map(lambda x: jnp.asarray(noise.normal(size=x.shape), jnp.float32), shapes)
    far = 16 * 2**doublings  # from the border, where all pixels have equal neighbors
    square = np.asarray(network.apply(weights, inputs, doublings))[0, far - 8 : far + 8, far - 8 : far + 8]
    signs = (-1.0) ** np.arange(16)
    scale = np.abs(square).max()
    assert scale > 0.1
    np.testing.assert_allclose(np.einsum("hwc,h->wc", square, signs) / 16, 0, atol=1e-4 * scale)
    np.testing.assert_allclose(np.einsum("hwc,w->hc", square, signs) / 16, 0, atol=1e-4 * scale)
