"""Light from all around: integrals, linearity in the map, energy, the borders of a map; maps that are computed."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers
from support.surfel_clouds import surfels

from spnr_jax.formats.images import read_light
from spnr_jax.kernels.records import Light
from spnr_jax.surfels import lighting, skies
from spnr_jax.surfels.lighting import HEIGHT, WIDTH, light_of, resample, solid_angles, texel_directions
from spnr_jax.surfels.sides import DIRECTIONS

COLOR = np.array([0.3, 1.0, 2.0])
irradiance, reflect = map(jax.jit, (lighting.irradiance, lighting.reflect))
arriving, project_harmonics = jax.jit(lighting.gather_irradiance), jax.jit(lighting.project_harmonics)
harmonics = jax.jit(lighting.harmonics)


def envmap(seed=0, height=HEIGHT):
    return np.random.default_rng(seed).uniform(0, 2, (height, 2 * height, 3)).astype(np.float32)


def smooth(towards):
    """A radiance without edges."""
    x, y, z = np.moveaxis(towards, -1, 0)
    return np.stack([1 + x, np.exp(y), 1.5 + y * z - 0.5 * z], axis=-1)


def columns(towards):
    return list(jnp.asarray(towards, jnp.float32).reshape(-1, 3).T)


def test_the_room_of_the_package_is_what_its_map_gives():
    scale = 0.5917323  # by which a white diffuse sphere averages 0.6 linear, measured by `data_gen.render.light`
    close(lighting.room_light().tables, light_of(scale * skies.indoor_envmap()).tables, rtol=1e-5, atol=1e-6)


def test_all_tables_of_constant_light_are_that_light():
    light = light_of(np.broadcast_to(COLOR, (20, 40, 3)))
    close(light.tables, np.broadcast_to(COLOR, light.tables.shape), rtol=1e-4)
    close(light_of(jnp.ones((20, 40, 3), jnp.bfloat16)).tables, np.ones(light.tables.shape), rtol=1e-4)
    towards = columns(numbers(0, 50, 3))
    for found in (irradiance(light, towards), reflect(light, towards, numbers(1, 50, low=0.0))):
        close(jnp.stack(found, axis=-1), np.broadcast_to(COLOR, (50, 3)), rtol=1e-4)


def test_everything_is_linear_in_the_map():
    one, other = envmap(1), envmap(2)
    found = surfels(numbers(0, 30, 3), jnp.asarray(DIRECTIONS[:30]), 0.1, visibility=numbers(1, 30, 64, low=0.0))
    towards, roughness = columns(DIRECTIONS), numbers(2, 64, low=0.0)
    turn = np.float32([[0, 0.6, 0.8], [1, 0, 0], [0, 0.8, -0.6]])

    def told(radiance):
        light = light_of(radiance)
        seen = irradiance(light, towards) + reflect(light, towards, roughness)
        return light.tables, seen, arriving(found, light), project_harmonics(light, turn)

    sums = jax.tree.map(lambda a, b: 2 * a + 3 * b, told(one), told(other))
    close(told(2 * one + 3 * other), sums, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("size", [(1, 2), (7, 14), (16, 33), (33, 66), (50, 100), (1023, 128)])
@pytest.mark.parametrize("height", [32, 5])
def test_another_size_keeps_the_energy_and_loses_no_lamp(size, height):
    radiance = np.zeros((*size, 3), np.float32)
    radiance[size[0] // 2, size[1] // 3] = 1e4  # one texel is all the light there is
    radiance[0, 0] = 7

    def energy(values):
        edges = np.cos(np.pi * np.arange(len(values) + 1) / len(values))
        return np.einsum("hwc,h->c", np.float64(values), edges[:-1] - edges[1:]) * 2 * np.pi / values.shape[1]

    small = resample(radiance, height)
    assert small.shape == (height, 2 * height, 3)
    close(energy(small), energy(radiance), rtol=1e-4)
    assert small.min() >= 0


def test_what_arrives_at_a_surfel_that_all_directions_see_is_nearly_its_irradiance():
    light = light_of(smooth(texel_directions(HEIGHT)).astype(np.float32))
    found = surfels(np.zeros((64, 3)), DIRECTIONS, 0.1)
    open_light = np.stack(irradiance(light, columns(DIRECTIONS)), axis=-1)
    close(arriving(found, light), open_light, rtol=0.08, atol=0.05)
    blind = surfels(np.zeros((64, 3)), DIRECTIONS, 0.1, visibility=np.zeros((64, 64)))
    assert np.all(np.asarray(arriving(blind, light)) == 0)


def test_the_harmonics_are_orthonormal_and_project_light_in_the_axes_of_the_camera():
    basis = np.stack(harmonics(*columns(texel_directions(HEIGHT))))
    close(basis * solid_angles(HEIGHT).reshape(-1) @ basis.T, np.eye(9), atol=5e-3)
    constant = project_harmonics(light_of(np.ones((32, 64, 3), np.float32)), np.eye(3, dtype=np.float32))
    close(constant, np.eye(9)[:, :1] * 4 * 0.282095 * np.ones(3), atol=5e-3)
    ahead = np.float32([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # a camera that looks along -x, where z is x
    tilted = project_harmonics(
        Light(tables=light_of(smooth(texel_directions(HEIGHT)).astype(np.float32)).tables), ahead
    )
    close(tilted[2, 0], 4 / 3 * 0.488603, rtol=1e-2)  # red is 1 + x, and behind the camera is +x
    close(tilted[np.array([1, 3]), 0], np.zeros(2), atol=1e-2)


def test_lamps_and_turned_lights_of_traced_angles_are_those_of_numbers_and_have_gradients():
    studio = read_light("studio")  # of NumPy arrays
    close(
        jax.jit(lambda degrees: studio.turned(degrees).tables)(17.0), studio.turned(17.0).tables, rtol=1e-5, atol=1e-5
    )

    def shone(azimuth, elevation, degrees):
        return skies.sun(azimuth, elevation, 30.0).turned(degrees).tables

    angles = jnp.array([30.0, 40.0, 17.0])
    close(jax.jit(lambda x: shone(*x))(angles), shone(30.0, 40.0, 17.0), rtol=1e-3, atol=1e-3)

    @jax.jit
    def over(angles):  # what a surface has that faces +x
        return shone(*angles)[0, HEIGHT // 2, 3 * WIDTH // 4, 0]

    slopes = jax.jit(jax.grad(over))(angles)
    assert np.isfinite(np.asarray(slopes)).all()
    for i in range(3):
        step = jnp.zeros(3).at[i].set(0.5)
        close(slopes[i], over(angles + step) - over(angles - step), rtol=0.1, atol=2e-4)


@pytest.mark.parametrize(("azimuth", "elevation", "size"), [(0, 0, 20), (90, 30, 0.5), (200, -60, 80), (10, 90, 5)])
def test_a_lamp_throws_what_it_is_said_to_and_shines_from_where_it_is_said_to(azimuth, elevation, size):
    envmap = skies.lamp(azimuth, elevation, size, (1.0, 0.5, 2.0))
    area = solid_angles(skies.HEIGHT)[..., None]
    facing = np.maximum(texel_directions(skies.HEIGHT) @ skies.direction_from_angles(azimuth, elevation), 0)[..., None]
    close((envmap * facing * area).sum(axis=(0, 1)), np.array([1.0, 0.5, 2.0]), rtol=1e-4)
    middle = (envmap[..., :1] * texel_directions(skies.HEIGHT) * area).sum(axis=(0, 1))
    turn, rise = np.deg2rad([azimuth, elevation])  # from +z towards +x, and up
    place = np.array([np.cos(rise) * np.sin(turn), np.sin(rise), np.cos(rise) * np.cos(turn)])
    close(middle / np.linalg.norm(middle), place, atol=0.02)


@pytest.mark.parametrize("name", skies.NAMED)
def test_lights_of_the_package_are_radiance_of_any_size_that_normalises_to_a_mean(name):
    for height in (16, 128):
        envmap = skies.NAMED[name](height)
        assert envmap.shape == (height, 2 * height, 3)
        assert np.isfinite(envmap).all()
        assert envmap.min() >= 0
        mean = (skies.normalise(envmap, 0.6) * solid_angles(height)[..., None]).sum() / (4 * np.pi * 3)
        assert mean == pytest.approx(0.6, rel=1e-3)


@pytest.mark.parametrize("made", [lighting.ambient, partial(skies.sun, 40, 30, 20)])
def test_a_color_is_an_array_or_one_number_or_three_traced_or_not(made):
    expected = made(np.full(3, 0.5)).tables
    close(made(0.5).tables, expected)
    close(jax.jit(lambda x: made((x, x, 0.5)).tables)(0.5), expected, rtol=1e-5, atol=1e-5)
