"""Layers of the paper's network: what they may not see, and their extremes; test_parity.py has their twins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers

from spnr_jax.kernels.compositing import composite, volume_weights
from spnr_jax.kernels.imaging import resize_bilinear, srgb_to_linear
from spnr_jax.kernels.numerics import normalize
from spnr_jax.nn.paper_layers import (
    BRIGHTNESS_AND_HUE,
    Discriminator,
    RadianceField,
    UNet3D,
    Upsampler,
    whiten_materials,
)


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


ROWS, VALUES = jnp.asarray(np.random.default_rng(0).integers(0, 513, (2, 20)), jnp.int32), numbers(1, 2, 20, 3)


@pytest.fixture(scope="module")
def unet():
    module = UNet3D(resolution=8, base_width=4, num_stages=2, num_groups=2)
    return jax.jit(module.apply), jax.jit(module.init)(jax.random.key(0), ROWS, VALUES)


class TestUNet3D:
    def test_without_its_decoder_the_stem_alone_reaches_the_output(self, unet):
        """Skips are additions: blocks of zeros add relu(bias) = 0 to what the stem sends across."""
        apply, variables = unet
        whole = variables["params"]
        silent = {name: b if name == "stem" else jax.tree.map(jnp.zeros_like, b) for name, b in whole.items()}
        stem, out = (apply({"params": params}, ROWS, VALUES) for params in (silent, whole))
        assert (stem >= 0).all()
        assert (stem > 0).any()
        assert (out >= stem).all(), "a decoder block adds its ReLU"
        assert (out > stem).any()

    def test_moving_the_points_by_whole_coarse_voxels_moves_the_volume_with_them(self):
        """Far from the border; the statistics of a group do not see where in the volume its voxels are."""
        module = UNet3D(resolution=32, base_width=4, num_stages=1, num_groups=2)
        cells, values = np.random.default_rng(3).integers(12, 16, (1, 20, 3)), numbers(4, 1, 20, 3)
        variables = jax.jit(module.init)(jax.random.key(0), jnp.zeros((1, 20), jnp.int32), values)
        run = jax.jit(module.apply)

        def volume(shift):
            rows = (cells + shift) @ np.array([32**2, 32, 1])
            return np.asarray(run(variables, jnp.asarray(rows, jnp.int32), values))[0]

        still, moved = volume(0), volume(np.array([4, 2, -2]))
        close(moved[12:24, 10:22, 6:18], still[8:20, 8:20, 8:20], rtol=1e-3, atol=2e-4)
        assert np.abs(still[8:20, 8:20, 8:20] - still[4:16, 6:18, 10:22]).max() > 0.1


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


def test_finishing_the_composited_hidden_layer_composites_the_features_of_every_sample():
    _, rgb, hidden, weights, view, finished = apply_field(X, DIRECTIONS)
    params = jax.tree.map(np.float64, FIELD_VARIABLES["params"])
    per_sample = np.float64(hidden) @ params["features"]["kernel"] + params["feature_bias"]
    per_sample = per_sample + np.float64(view)[..., None, 3:]
    colors = np.concatenate([np.float64(rgb) - 1, per_sample], axis=-1)  # on white: colours above it are added to it
    expected = np.einsum("...s,...sf->...f", np.float64(weights), colors) + np.eye(7)[:3].sum(axis=0)
    close(finished, expected, atol=1e-5)


def test_the_density_does_not_see_the_direction_and_colour_and_features_do():
    density, rgb, _, _, _, rest = apply_field(X, DIRECTIONS)
    other_density, other_rgb, _, _, _, other_rest = apply_field(X, -DIRECTIONS)
    close(other_density, density, rtol=0, atol=0)
    assert (jnp.abs(other_rgb - rgb) > 1e-4).any()
    assert (jnp.abs(other_rest - rest) > 1e-4).any()


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


def test_condition_and_mask_change_the_discriminators_mind_and_other_images_do_not():
    image, condition, mask = numbers(0, 2, 24, 24, 3), numbers(1, 2, 24, 24, 3), numbers(2, 2, 24, 24) > 0
    module = Discriminator(width=4, num_groups=2)
    variables = jax.jit(module.init)(jax.random.key(0), image, condition, mask)
    apply = jax.jit(module.apply)
    logits = apply(variables, image, condition, mask)
    assert (jnp.abs(apply(variables, image, 1 - condition, mask) - logits) > 1e-4).any()
    assert (jnp.abs(apply(variables, image, condition, ~mask) - logits) > 1e-4).any()
    other = jnp.concatenate([1 - image[:1], image[1:]])
    close(apply(variables, other, condition, mask)[1], logits[1])
