"""Maps that are computed: what lamps throw, named lights, random ones."""

import numpy as np
import pytest
from support.laws import close

from spnr_jax.surfels import skies
from spnr_jax.surfels.envmaps import directions, solid_angles


@pytest.mark.parametrize(("azimuth", "elevation", "size"), [(0, 0, 20), (90, 30, 0.5), (200, -60, 80), (10, 90, 5)])
def test_a_lamp_throws_what_it_is_said_to_and_shines_from_where_it_is_said_to(azimuth, elevation, size):
    envmap = skies.lamp(azimuth, elevation, size, (1.0, 0.5, 2.0))
    area = solid_angles(skies.HEIGHT)[..., None]
    facing = np.maximum(directions(skies.HEIGHT) @ skies.towards(azimuth, elevation), 0)[..., None]
    close((envmap * facing * area).sum(axis=(0, 1)), np.array([1.0, 0.5, 2.0]), rtol=1e-4)
    middle = (envmap[..., :1] * directions(skies.HEIGHT) * area).sum(axis=(0, 1))
    close(middle / np.linalg.norm(middle), skies.towards(azimuth, elevation), atol=0.02)


def test_azimuth_0_is_in_front_90_to_the_right_and_elevation_90_above():
    found = [skies.towards(*angles) for angles in ((0, 0), (90, 0), (0, 90))]
    close(np.stack(found), np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), atol=1e-6)


@pytest.mark.parametrize("name", skies.NAMED)
def test_lights_of_the_package_are_radiance_of_any_size_that_normalises_to_a_mean(name):
    for height in (16, 128):
        envmap = skies.NAMED[name](height)
        assert envmap.shape == (height, 2 * height, 3)
        assert np.isfinite(envmap).all()
        assert envmap.min() >= 0
        mean = (skies.normalised(envmap, 0.6) * solid_angles(height)[..., None]).sum() / (4 * np.pi * 3)
        assert mean == pytest.approx(0.6, rel=1e-3)


def test_random_maps_follow_from_their_generator_and_differ():
    maps = [skies.random_map(np.random.default_rng(seed), 32) for seed in (0, 0, 1, 2, 3)]
    np.testing.assert_array_equal(maps[0], maps[1])
    assert all(np.isfinite(x).all() and x.min() >= 0 and x.max() > 0 for x in maps)
    assert len({x.tobytes() for x in maps}) == 4


def test_black_stays_black_when_it_is_normalised():
    np.testing.assert_array_equal(skies.normalised(np.zeros((4, 8, 3), np.float32)), 0)
