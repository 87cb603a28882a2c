"""Laws of light in pictures of the package's network: black, sums, multiples, turns, a white body, extremes."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from support.surfel_clouds import cloud, shape

import spnr_jax
from spnr_jax.formats.images import read_light
from spnr_jax.kernels.imaging import srgb_to_linear
from spnr_jax.surfels.lighting import directions

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
    return cloud(positions, base_color=color, roughness=rng.uniform(0.2, 0.9, 1400), metallic=positions[:, 1] > 0.3)


@pytest.fixture(scope="module")
def volume(model, body):
    return model.encode(body)


def linear(model, volume, light, azimuth=30.0, quality="best"):
    """Linear light of the solid pixels, and which they are; without the network none is quite solid."""
    found = model.render(volume, model.camera(volume, azimuth, resolution=SIZE), quality, light)
    solid = np.asarray(found.acc) > (0.9 if quality == "draft" else 0.999)
    straight = (np.asarray(found.image) - 1 + np.asarray(found.acc)[..., None]) / np.maximum(found.acc, 1e-3)[..., None]
    assert solid.sum() > 500
    return np.asarray(srgb_to_linear(jnp.clip(jnp.asarray(straight), 0, 1))), solid


@pytest.mark.ci
def test_black_light_gives_black(model, volume):
    image, solid = linear(model, volume, spnr_jax.ambient((0.0, 0.0, 0.0)))
    assert image[solid].max() < 2e-3  # what an opacity of .999 leaves of the white behind


def test_light_a_plus_light_b_is_their_sum_and_a_multiple_a_multiple(model, volume):
    one, other = 0.3 * read_light("studio"), 0.3 * read_light("sunset")
    pictures = [linear(model, volume, light) for light in (one, other, one + other, 2 * one)]
    a, b, both, twice = (image for image, _ in pictures)
    clear = pictures[0][1] & (np.minimum(a, b).min(axis=-1) > 1e-3) & (np.maximum(both, twice).max(axis=-1) < 0.99)
    assert clear.sum() > 300  # where nothing is clipped
    np.testing.assert_allclose(both[clear], (a + b)[clear], atol=2e-3)
    np.testing.assert_allclose(twice[clear], 2 * a[clear], atol=2e-3)


def turned_together(model, body, volume, light, quality="best", seen_from_everywhere=False):
    """Differences in linear light between a picture and that of object, camera and light turned; share not solid."""
    turn = 16 * 5.625
    angle = np.deg2rad(turn)
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned = dataclasses.replace(body, positions=np.float32(body.positions @ rotation.T))
    volumes = [volume, model.encode(turned)]
    if seen_from_everywhere:
        volumes = [unshadowed(volume) for volume in volumes]
    before, solid = linear(model, volumes[0], light, 30.0, quality)
    after, also = linear(model, volumes[1], light.turned(turn), 30.0 + turn, quality)
    return np.abs(after - before)[solid & also], np.mean(solid != also)


def unshadowed(volume):
    """The volume as if every direction saw every point."""
    surfels = volume.scene.surfels
    surfels = dataclasses.replace(surfels, visible=jnp.ones_like(surfels.visible))
    return dataclasses.replace(volume, scene=dataclasses.replace(volume.scene, surfels=surfels))


def test_object_camera_and_light_turned_together_give_nearly_the_same_picture(model, body, volume):
    """Not exactly: the 64 directions that see the points stand still."""
    off, unlike = turned_together(model, body, volume, read_light("studio"))
    assert np.mean(off) < 0.01
    assert unlike < 0.01


def test_what_is_not_shadowed_turns_with_object_camera_and_light(model, body, volume):
    off, unlike = turned_together(model, body, volume, read_light("studio"), "draft", seen_from_everywhere=True)
    assert np.median(off) < 1e-3
    assert np.mean(off) < 5e-3
    assert unlike < 0.01


@pytest.mark.parametrize(("quality", "within"), [("best", 0.1), ("draft", 0.03)])
def test_uniform_light_shows_the_albedo_of_a_matt_convex_body(model, quality, within):
    """What it mirrors is that of a black body, and is taken away.  The network adds 7 to 9 % to the darkest channel."""

    def shown(albedo):
        columns = {"base_color": np.tile(albedo, (3000, 1)), "roughness": np.ones(3000)}
        volume = model.encode(cloud(shape("sphere", 3000)[0], **columns))
        return linear(model, volume, 0.9 * spnr_jax.ambient(), quality=quality)

    color = 0.8, 0.5, 0.2
    (body, solid), (black, _) = shown(color), shown((0.0, 0.0, 0.0))
    np.testing.assert_allclose((body - black)[solid].mean(axis=0), 0.9 * np.array(color), rtol=within)


@pytest.mark.parametrize("radiance", [1e-6, 1e6])
def test_no_light_gives_nan(model, volume, radiance):
    lamp = np.zeros((32, 64, 3), np.float32)
    lamp[8, 20] = 1e5
    for light in (spnr_jax.ambient(), spnr_jax.light_of(lamp)):
        found = model.render(volume, model.camera(volume, resolution=SIZE), light=radiance * light)
        assert np.isfinite(np.asarray(found.image)).all()
        assert np.asarray(found.image).min() >= 0
        assert np.asarray(found.image).max() <= 1 + 1e-6


def test_light_comes_from_where_it_stands(model):
    """A ball lit from the right is brighter there, and so is its picture from behind, on the other side."""
    volume = model.encode(cloud(shape("sphere", 1400)[0], roughness=np.ones(1400)))
    right = spnr_jax.light_of(np.maximum(directions(32) @ [1, 0, 0], 0)[..., None] ** 4 * np.ones(3, np.float32))
    for azimuth, side in ((0.0, 1), (180.0, -1)):
        image, solid = linear(model, volume, right, azimuth)
        columns = np.arange(SIZE)[None] - SIZE / 2
        assert side * np.sum(image.mean(axis=-1) * columns * solid) > 0
