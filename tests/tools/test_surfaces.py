"""The surface that pictures show: its depth."""

import numpy as np
import pytest
from support.tiny_model import MODEL

from spnr_jax.kernels.records import Rendering, Volume
from spnr_jax.method.model import Model
from spnr_jax.tools.surfaces import surface_depth

UNIT = 10.0  # half diagonal of the cloud, in its own units


@pytest.fixture(scope="module")
def scene():
    """Volume and camera of a cloud that is large and far from 0."""
    volume = Volume(scene=None, centre=np.float32([50, 0, -20]), scale=np.asarray(1 / UNIT, np.float32))
    return volume, Model(config=MODEL, params={}).camera(volume, 0.0, 0.0, 24)


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
