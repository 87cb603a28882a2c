"""Pixels of several rays: the mean of the object's light, its opacity and depth; one ray where that is enough."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers
from support.tiny_model import MODEL, camera, cloud, wobbled

from experiments.baselines.npbg import NPBGConfig
from spnr_jax.config import RenderOptions
from spnr_jax.kernels import cameras
from spnr_jax.kernels.imaging import average
from spnr_jax.kernels.records import Rendering
from spnr_jax.method import inference
from spnr_jax.method.inference import rays_per_side
from spnr_jax.method.model import Model

SIDE = 2
WITHOUT_UPSAMPLER = dataclasses.replace(MODEL, render_resolution=16, image_resolution=16)


def linear(encoded):
    encoded = np.float64(encoded)
    return np.where(encoded > 0.04045, ((encoded + 0.055) / 1.055) ** 2.4, encoded / 12.92)


def encoded(light):
    return np.where(light > 0.0031308, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055, 12.92 * light)


def rendering(seed=0, size=6):
    """Colours of any opacity on white."""
    acc, straight = numbers(seed, 2, size, size, low=0.05), numbers(seed + 1, 2, size, size, 3, low=0.0)
    image = acc[..., None] * straight + 1 - acc[..., None]
    return Rendering(
        image=image, image_lr=image, depth=numbers(seed + 2, 2, size, size, low=2, high=4), acc=acc
    ), straight


def test_light_opacity_and_depth_are_those_of_a_loop_over_pixels():
    wide, straight = rendering()
    narrow = average(wide, SIDE)
    for v, y, x in np.ndindex(2, 3, 3):
        square = v, slice(2 * y, 2 * y + 2), slice(2 * x, 2 * x + 2)
        acc = np.float64(wide.acc[square])
        close(narrow.acc[v, y, x], acc.mean())
        close(narrow.depth[v, y, x], np.mean(wide.depth[square]))
        light = np.mean(acc[..., None] * linear(straight[square]), axis=(0, 1)) / acc.mean()
        close(narrow.image[v, y, x], acc.mean() * encoded(light) + 1 - acc.mean(), atol=1e-4)


def test_nothing_is_white_and_its_gradient_finite():
    acc = jnp.zeros((1, 4, 4))
    image = jnp.ones((1, 4, 4, 3))

    def mean(image, acc):
        return jnp.mean(average(Rendering(image=image, image_lr=image, depth=acc, acc=acc), SIDE).image)

    value, gradient = jax.value_and_grad(mean, argnums=(0, 1))(image, acc)
    assert value == 1
    assert all(jnp.isfinite(g).all() for g in gradient)


@pytest.mark.parametrize(("size", "side"), [(16, 1), (32, 1), (8, 2), (4, 4), (11, 1)])
def test_rays_lie_as_close_as_in_the_training(size, side):
    assert rays_per_side(WITHOUT_UPSAMPLER, size) == side
    assert rays_per_side(NPBGConfig(image_resolution=32), size) == 1, "it sees all pixels at once"
    assert rays_per_side(MODEL, 4) == 1, "it doubles its pictures"


def test_a_small_picture_is_the_large_one_averaged():
    variables = wobbled(jax.jit(inference.network(WITHOUT_UPSAMPLER).init)(jax.random.key(0), cloud(), camera()), 4)
    scene = inference.jitted_encode(variables, cloud(), config=WITHOUT_UPSAMPLER)
    small, large = camera(8, target=0.0171), cameras.resize(camera(8, target=0.0171), 16, 16)
    whole = inference.jitted_render(variables, scene, large, config=WITHOUT_UPSAMPLER)
    assert np.ptp(np.asarray(whole.acc)) > 0.5
    several = inference.jitted_render(
        variables, scene, small, config=WITHOUT_UPSAMPLER, options=RenderOptions(rays_per_side=2)
    )
    apart = np.abs(np.asarray(several.image - average(whole, 2).image))
    assert np.mean(apart > 1e-4) < 0.01  # but for a ray that rounding moves over a face of a cell


@pytest.mark.ci
def test_the_handle_takes_several_rays_for_the_best_picture_alone():
    variables = wobbled(jax.jit(inference.network(WITHOUT_UPSAMPLER).init)(jax.random.key(0), cloud(), camera()), 4)
    handle, single = (
        Model(config=WITHOUT_UPSAMPLER, variables=variables),
        jax.tree.map(lambda x: np.asarray(x[0]), cloud()),
    )
    volume = handle.encode(single)
    view, wide = (handle.camera(volume, azimuth=17.3, elevation=36.1, resolution=n) for n in (8, 16))
    large = handle.render(volume, wide, "best")
    expected = average(jax.tree.map(lambda x: x[None], large), 2)
    apart = np.abs(np.asarray(handle.render(volume, view, "best").image - expected.image[0]))
    assert np.mean(apart > 1e-4) < 0.02  # one pixel: a ray that rounding moves over a face of a cell
    assert np.abs(np.asarray(handle.render(volume, view, "trained").image - expected.image[0])).max() > 0.01
