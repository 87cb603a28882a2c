"""The convolution forms of the CPU against XLA's native one."""

import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from support.laws import close, numbers, same_bits

from spnr_jax.nn.convolution import Conv, conv, upsample_conv


def native(x, kernel, stride=1, padding=1):
    n = x.ndim - 2
    axes = "DHW"[-n:]
    numbering = (f"N{axes}C", f"{axes}IO", f"N{axes}C")
    return lax.conv_general_dilated(x, kernel, (stride,) * n, [(padding, padding)] * n, dimension_numbers=numbering)


def repeated(x, kernel):
    for axis in range(1, x.ndim - 1):
        x = jnp.repeat(x, 2, axis=axis)
    return native(x, kernel)


def value_and_gradients(form, x, kernel):
    """Output, and gradients of a random projection of it by input and kernel."""

    def projected(x, kernel):
        out = form(x, kernel)
        weights = np.random.default_rng(9).normal(size=out.shape)
        return jnp.vdot(jnp.asarray(weights, jnp.float32), out), out

    return jax.jit(jax.value_and_grad(projected, (0, 1), has_aux=True))(x, kernel)


WINDOWS = [(3, 1, 1, 8), (3, 2, 1, 3), (2, 1, 1, 8), (4, 2, 1, 5), (4, 1, 1, 1), (1, 1, 0, 3)]
# 2D, and 3D above and at the size where the CPU turns to one matrix product
CASES = [((5, 6), *window) for window in WINDOWS] + [((6, 5, 7), *window) for window in WINDOWS]
CASES += [(shape, *window) for shape in ((4, 4, 4), (2, 2, 3)) for window in WINDOWS[:2]]


@pytest.mark.parametrize(("shape", "window", "stride", "padding", "features"), CASES)
def test_is_the_native_convolution_in_value_and_gradients(shape, window, stride, padding, features):
    x, kernel = numbers(0, 2, *shape, 3), numbers(1, *[window] * len(shape), 3, features)

    def both(form):
        return value_and_gradients(lambda x, k: form(x, k, stride, padding), x, kernel)

    close(both(conv), both(native), rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("shape", [(5, 3), (1, 1), (1, 2), (5, 2, 6), (1, 1, 1), (2, 1, 2)], ids=str)
def test_upsample_conv_is_the_convolution_of_every_pixel_repeated(shape):
    x, kernel = numbers(4, 2, *shape, 3), numbers(5, *[3] * len(shape), 3, 4)
    close(value_and_gradients(upsample_conv, x, kernel), value_and_gradients(repeated, x, kernel), 1e-4, 2e-5)


@pytest.mark.parametrize("window", [2, 3])
def test_second_order_gradients_are_those_of_the_native_form(window):
    """R1 differentiates the discriminator's gradient."""
    x, kernel = numbers(8, 1, 5, 5, 2), numbers(9, window, window, 2, 1)

    def penalty(form):
        def squared(x, kernel):
            return jnp.sum(jax.grad(lambda x: jnp.sum(jnp.tanh(form(x, kernel))))(x) ** 2)

        return jax.jit(jax.value_and_grad(squared, (0, 1)))(x, kernel)

    close(penalty(conv), penalty(native), rtol=1e-4, atol=1e-5)


def test_forward_mode_and_vmap_over_inputs_and_kernels_are_those_of_the_native_form():
    x, kernel = numbers(10, 3, 2, 5, 6, 2), numbers(11, 3, 3, 3, 2, 5)

    def mapped(form):
        def both(x, kernel):
            return jax.jvp(form, (x, kernel), (0.5 * x, 2 * kernel)), value_and_gradients(form, x, kernel)

        return jax.jit(jax.vmap(both))(x, kernel)

    close(mapped(conv), mapped(native), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("shape", [(6, 6), (6, 5, 6)], ids=["2D", "3D"])
@pytest.mark.parametrize("window", [3, 4])
def test_no_gradient_has_axes_in_an_order_that_xla_puts_right_outside_of_loops_alone(shape, window):
    x, kernel = numbers(14, 2, *shape, 2), numbers(15, *[window] * len(shape), 2, 5)
    for stride in (1, 2):
        gradient = jax.grad(lambda x, k, stride=stride: jnp.sum(jnp.sin(conv(x, k, stride))), (0, 1))
        program = jax.jit(gradient).lower(x, kernel).as_text()
        found = set(re.findall(r"dim_numbers = (.*?),\s*window", program))
        assert found == {"[b, 0, 1, f]x[0, 1, i, o]->[b, 0, 1, f]"}


def test_the_layer_is_that_of_flax():
    x, own, flax = numbers(16, 2, 6, 5, 3), Conv(8), nn.Conv(8, (3, 3))
    variables = own.init(jax.random.key(0), x)
    same_bits(variables, flax.init(jax.random.key(0), x))
    variables = jax.tree.map(lambda a: a + 0.1, variables)  # a bias of 0 says nothing

    def gradient(layer):
        return jax.jit(jax.value_and_grad(lambda v: jnp.sum(jnp.sin(layer.apply(v, x)))))(variables)

    close(own.apply(variables, x), flax.apply(variables, x), atol=1e-5)
    close(gradient(own), gradient(flax), rtol=1e-4, atol=1e-5)
