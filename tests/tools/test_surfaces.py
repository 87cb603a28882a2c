"""The surface that pictures show: its depth."""

import numpy as np
import pytest
from support import tiny_untrained
from support.surfel_clouds import cloud

import spnr_jax
from spnr_jax.kernels.records import Rendering
from spnr_jax.tools.surfaces import surface_depth

UNIT = 10.0  # half diagonal of the cloud, in its own units


@pytest.fixture(scope="module")
def scene():
    """Volume and camera of a cube of points that is large and far from 0."""
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3) * UNIT / np.sqrt(3)
    model = spnr_jax.load(tiny_untrained.run())
    volume = model.encode(cloud(corners + [50, 0, -20]))
    return volume, model.camera(volume, 0.0, 0.0, 24)


def rendering(depth, acc):
    image = np.zeros((*depth.shape, 3), np.float32)
    return Rendering(image=image, image_lr=image, depth=np.float32(depth), acc=np.float32(acc))


def test_the_background_that_shines_through_is_taken_out_again(scene):
    volume, camera = scene
    size = (5, 5)  # the middle pixel looks along the axis: the box's back is at 3 + 1 units of the box
    acc = np.random.default_rng(0).uniform(0.55, 1, size)
    distance, back = 3.2 * UNIT, 4 * UNIT
    mean = acc * distance + (1 - acc) * back
    hit = surface_depth(rendering(mean, acc), camera, volume)
    np.testing.assert_allclose(hit[2, 2], distance, rtol=1e-4)
    opaque = surface_depth(rendering(np.full(size, distance), np.ones(size)), camera, volume)
    np.testing.assert_allclose(opaque, distance, rtol=1e-6)


def test_what_lets_most_of_the_light_pass_has_no_depth(scene):
    volume, camera = scene
    acc = np.array([[0.0, 0.49], [0.51, 1.0]])
    hit = surface_depth(rendering(np.full((2, 2), 30.0), acc), camera, volume)
    np.testing.assert_array_equal(np.isnan(hit), acc < 0.5)
