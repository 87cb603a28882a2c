"""Laws of light in pictures of the package's network: sums, multiples, turns, a matt body, where light comes from."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from support.surfel_clouds import cloud, shape

import spnr_jax
from spnr_jax.formats.images import read_light
from spnr_jax.kernels.imaging import srgb_to_linear
from spnr_jax.surfels.lighting import texel_directions

pytestmark = pytest.mark.ci
COUNT = 1400  # points of every body: few programs
SIZE = 132  # more than those of pictures that are drawn at twice the size: means of sRGB are not linear in the light


@pytest.fixture(scope="module")
def model():
    return spnr_jax.load("surfels")


@pytest.fixture(scope="module")
def body():
    """A ball with a rod through it, of several materials."""
    ball, rod = shape("sphere", 900)[0], shape("rod", 500)[0]
    positions = np.concatenate([ball, rod + [0, 0.35, 0]])
    rng = np.random.default_rng(3)
    color = np.where(positions[:, :1] > 0, [0.7, 0.3, 0.2], [0.2, 0.4, 0.6])
    return cloud(positions, base_color=color, roughness=rng.uniform(0.2, 0.9, COUNT), metallic=positions[:, 1] > 0.3)


@pytest.fixture(scope="module")
def volume(model, body):
    return model.encode(body, densify=False)


def linear(model, volume, light, azimuth=30.0, quality="best"):
    """Linear light of the solid pixels, and which they are; without the network none is quite solid."""
    found = model.render(volume, model.camera(volume, azimuth, resolution=SIZE), quality, light)
    solid = np.asarray(found.acc) > (0.9 if quality == "draft" else 0.999)
    straight = (np.asarray(found.image) - 1 + np.asarray(found.acc)[..., None]) / np.maximum(found.acc, 1e-3)[..., None]
    assert solid.sum() > 500
    return np.asarray(srgb_to_linear(jnp.clip(jnp.asarray(straight), 0, 1))), solid


def test_light_a_plus_light_b_is_their_sum_and_a_multiple_a_multiple(model, volume):
    one, other = 0.3 * read_light("studio"), 0.3 * read_light("sunset")
    pictures = [linear(model, volume, light) for light in (one, other, one + other, 2 * one)]
    a, b, both, twice = (image for image, _ in pictures)
    clear = pictures[0][1] & (np.minimum(a, b).min(axis=-1) > 1e-3) & (np.maximum(both, twice).max(axis=-1) < 0.99)
    assert clear.sum() > 300  # where nothing is clipped
    np.testing.assert_allclose(both[clear], (a + b)[clear], atol=2e-3)
    np.testing.assert_allclose(twice[clear], 2 * a[clear], atol=2e-3)


def test_lights_stay_in_single_precision_whatever_numbers_change_them():
    light = read_light("studio")
    for changed in (light.turned(10), light.turned(np.float64(3)), np.float64(2) * light, light / np.float64(3)):
        assert changed.tables.dtype == np.float32


@pytest.mark.parametrize(("shadowed", "most"), [(True, 0.01), (False, 5e-3)])
def test_object_camera_and_light_turned_together_give_nearly_the_same_picture(model, body, volume, shadowed, most):
    """Not exactly where there are shadows: the 64 directions that see the points stand still."""
    turn, light = 16 * 5.625, read_light("studio")
    angle = np.deg2rad(turn)
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned = dataclasses.replace(body, positions=np.float32(body.positions @ rotation.T))

    def drawn(volume, light, azimuth):
        if not shadowed:
            visibility = jnp.ones_like(volume.surfels.visibility)
            volume = volume.replace(surfels=volume.surfels.replace(visibility=visibility))
        return linear(model, volume, light, azimuth)

    before, solid = drawn(volume, light, 30.0)
    after, also = drawn(model.encode(turned, densify=False), light.turned(turn), 30.0 + turn)
    assert np.mean(np.abs(after - before)[solid & also]) < most
    assert np.mean(solid != also) < 0.01


@pytest.mark.parametrize(("quality", "within"), [("best", 0.1), ("draft", 0.03)])
def test_uniform_light_shows_the_albedo_of_a_matt_convex_body(model, quality, within):
    """What it mirrors is that of a black body, and is taken away.  The network adds 7 to 9 % to the darkest channel."""

    def shown(albedo):
        columns = {"base_color": np.tile(albedo, (COUNT, 1)), "roughness": np.ones(COUNT)}
        volume = model.encode(cloud(shape("sphere", COUNT)[0], **columns), densify=False)
        return linear(model, volume, 0.9 * spnr_jax.ambient(), quality=quality)

    color = 0.8, 0.5, 0.2
    (body, solid), (black, _) = shown(color), shown((0.0, 0.0, 0.0))
    np.testing.assert_allclose((body - black)[solid].mean(axis=0), 0.9 * np.array(color), rtol=within)


def test_light_comes_from_where_it_stands(model):
    """A ball lit from the right is brighter there, and so is its picture from behind, on the other side."""
    volume = model.encode(cloud(shape("sphere", COUNT)[0], roughness=np.ones(COUNT)), densify=False)
    right = spnr_jax.light_of(np.maximum(texel_directions(32) @ [1, 0, 0], 0)[..., None] ** 4 * np.ones(3, np.float32))
    for azimuth, side in ((30.0, 1), (210.0, -1)):
        image, solid = linear(model, volume, right, azimuth)
        columns = np.arange(SIZE)[None] - SIZE / 2
        assert side * np.sum(image.mean(axis=-1) * columns * solid) > 0
