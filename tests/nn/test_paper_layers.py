"""Layers of the paper's network: what they may not see, and their extremes; test_parity.py has their twins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers

from spnr_jax.kernels.compositing import composite, volume_weights
from spnr_jax.kernels.imaging import resize_bilinear, srgb_to_linear
from spnr_jax.kernels.numerics import normalize
from spnr_jax.nn.paper_layers import BRIGHTNESS_AND_HUE, RadianceField, Upsampler, whiten_materials


class TestMaterials:
    def test_spread_materials_part_brightness_from_hue_and_lose_nothing(self):
        grey = jnp.tile(jnp.linspace(0, 1, 5)[:, None], (1, 3))
        close(whiten_materials(grey)[:, 1:], np.zeros((5, 2)), atol=1e-5)
        close(whiten_materials(grey)[jnp.array([0, -1]), 0], np.array([-2.0, 2.0]), atol=1e-5)
        colors = jax.random.uniform(jax.random.key(3), (40, 3))
        encoded = np.linalg.solve(np.float64(BRIGHTNESS_AND_HUE).T, np.float64(whiten_materials(colors)).T).T + 0.5
        close(srgb_to_linear(jnp.asarray(encoded, jnp.float32)), colors, atol=1e-5)
        close(whiten_materials(jnp.array([[0.0], [0.5], [1.0]])), np.array([[-1.0], [0.0], [1.0]]))
        assert jnp.isfinite(jax.grad(lambda x: whiten_materials(x).sum())(jnp.zeros((1, 3)))).all()


FIELD = RadianceField(width=6, num_features=7, direction_frequencies=2)
X, DIRECTIONS = numbers(0, 2, 3, 5, 4), normalize(numbers(1, 2, 3, 3))


def everything(module, x, directions):
    view = module.view(directions)
    density, (rgb, hidden) = module(x, view)
    weights, _ = volume_weights(density, jnp.full(density.shape, 0.3))
    emitted = composite(weights, rgb), composite(weights, hidden)
    return density, rgb, hidden, weights, view, module.decode(emitted, jnp.sum(weights, axis=-1), view)


FIELD_VARIABLES = jax.jit(lambda key: FIELD.init(key, X, DIRECTIONS, method=everything))(jax.random.key(0))
FIELD_VARIABLES = jax.tree.map(lambda x: x + 0.3 * numbers(2, *x.shape), FIELD_VARIABLES)
apply_field = jax.jit(lambda x, directions: FIELD.apply(FIELD_VARIABLES, x, directions, method=everything))


def test_a_field_that_does_not_see_the_direction_has_no_weights_for_it_and_one_colour_from_all_sides():
    module = RadianceField(width=6, num_features=7, direction_frequencies=2, sees_direction=False)
    params = {name: layer for name, layer in FIELD_VARIABLES["params"].items() if name != "direction"}
    made = jax.eval_shape(lambda key: module.init(key, X, DIRECTIONS, method=everything), jax.random.key(0))
    assert set(made["params"]) == set(params)
    one, other = (module.apply({"params": params}, X, d, method=everything) for d in (DIRECTIONS, -DIRECTIONS))
    close(one, other, rtol=0, atol=0)
    close(one[0], apply_field(X, DIRECTIONS)[0])


@pytest.mark.parametrize("scale", [0.0, 1e-8, 1e4, -1e4])
def test_the_field_is_finite_in_value_and_gradient_however_large_the_volume_is(scale):
    def total(x):
        density, rgb, hidden, *_ = FIELD.apply(FIELD_VARIABLES, x, DIRECTIONS, method=everything)
        return jnp.sum(density) + jnp.sum(rgb) + jnp.sum(hidden), (density, rgb)

    (_, (density, rgb)), gradient = jax.jit(jax.value_and_grad(total, has_aux=True))(scale * X)
    assert jnp.isfinite(gradient).all()
    assert ((density >= 0) & jnp.isfinite(density)).all()
    assert ((rgb >= 0) & (rgb <= 1)).all()


def test_a_fresh_upsampler_gives_the_bilinear_picture():
    x = numbers(0, 2, 4, 6, 5)
    found = jax.jit(lambda key: Upsampler(width=4).init_with_output(key, x)[0])(jax.random.key(0))
    close(found, resize_bilinear(x[..., :3], 8, 12), rtol=0, atol=0)
