"""Radiance field: direction encoding, density, and the head that is applied once per ray."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference
from support.laws import close, numbers

from spnr_jax.kernels.compositing import composite, volume_weights
from spnr_jax.kernels.numerics import normalize
from spnr_jax.nn.paper_layers import RadianceField

MODULE = RadianceField(width=6, num_features=7, direction_frequencies=2)
X, DIRECTIONS = numbers(0, 2, 3, 5, 4), normalize(numbers(1, 2, 3, 3))


def everything(module, x, directions):
    view = module.view(directions)
    density, (rgb, hidden) = module(x, view)
    weights, _ = volume_weights(density, jnp.full(density.shape, 0.3))
    emitted = composite(weights, rgb), composite(weights, hidden)
    return density, rgb, hidden, weights, view, module.finish(emitted, jnp.sum(weights, axis=-1), view)


VARIABLES = jax.jit(lambda key: MODULE.init(key, X, DIRECTIONS, method=everything))(jax.random.key(0))
VARIABLES = jax.tree.map(lambda x: x + 0.3 * numbers(2, *x.shape), VARIABLES)
apply = jax.jit(lambda x, directions: MODULE.apply(VARIABLES, x, directions, method=everything))


def test_density_and_colour_are_those_of_the_layers_written_out():
    density, rgb, hidden, _, view, _ = apply(X, DIRECTIONS)
    params = jax.tree.map(np.float64, VARIABLES["params"])
    expected = reference.softplus(np.float64(X) @ params["hidden"]["kernel"] + params["hidden"]["bias"])
    out = expected @ params["head"]["kernel"] + params["head"]["bias"]
    close(hidden, expected)
    close(density, reference.softplus(out[..., 0] - 1))
    close(rgb, 1 / (1 + np.exp(-out[..., 1:] - np.float64(view)[..., None, :3])))


def test_finishing_the_composited_hidden_layer_composites_the_features_of_every_sample():
    _, rgb, hidden, weights, view, finished = apply(X, DIRECTIONS)
    params = jax.tree.map(np.float64, VARIABLES["params"])
    per_sample = np.float64(hidden) @ params["features"]["kernel"] + params["feature_bias"]
    per_sample = per_sample + np.float64(view)[..., None, 3:]
    colors = np.concatenate([np.float64(rgb) - 1, per_sample], axis=-1)  # on white: colours above it are added to it
    expected = np.einsum("...s,...sf->...f", np.float64(weights), colors) + np.eye(7)[:3].sum(axis=0)
    close(finished, expected, atol=1e-5)


def test_density_does_not_see_the_direction_and_colour_and_features_do():
    density, rgb, _, _, _, rest = apply(X, DIRECTIONS)
    other_density, other_rgb, _, _, _, other_rest = apply(X, -DIRECTIONS)
    close(other_density, density, rtol=0, atol=0)
    assert (jnp.abs(other_rgb - rgb) > 1e-4).any()
    assert (jnp.abs(other_rest - rest) > 1e-4).any()


def test_a_field_that_does_not_see_the_direction_has_no_weights_for_it_and_one_colour_from_all_sides():
    module = RadianceField(width=6, num_features=7, direction_frequencies=2, sees_direction=False)
    params = {name: layer for name, layer in VARIABLES["params"].items() if name != "direction"}
    made = jax.eval_shape(lambda key: module.init(key, X, DIRECTIONS, method=everything), jax.random.key(0))
    assert set(made["params"]) == set(params)
    one, other = (module.apply({"params": params}, X, d, method=everything) for d in (DIRECTIONS, -DIRECTIONS))
    close(one, other, rtol=0, atol=0)
    close(one[0], apply(X, DIRECTIONS)[0])


@pytest.mark.parametrize("scale", [0.0, 1e-8, 1e4, -1e4])
def test_is_finite_in_value_and_gradient_however_large_the_volume_is(scale):
    def total(x):
        density, rgb, hidden, *_ = MODULE.apply(VARIABLES, x, DIRECTIONS, method=everything)
        return jnp.sum(density) + jnp.sum(rgb) + jnp.sum(hidden), (density, rgb)

    (_, (density, rgb)), gradient = jax.jit(jax.value_and_grad(total, has_aux=True))(scale * X)
    assert jnp.isfinite(gradient).all()
    assert ((density >= 0) & jnp.isfinite(density)).all()
    assert ((rgb >= 0) & (rgb <= 1)).all()
