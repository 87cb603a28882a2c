"""Guarded division, unit vectors, and the gather and scatter that stay flat under vmap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers

from spnr_jax.kernels.numerics import (
    clamp,
    gather_rows,
    per_feature,
    safe_divide,
    scatter_rows,
    softplus,
)

INDEX = jnp.asarray(np.random.default_rng(7).integers(0, 5, (2, 3, 4)), jnp.int32)


class TestSafeDivide:
    def test_a_zero_denominator_gives_zero_in_value_and_gradient(self):
        value, gradient = jax.value_and_grad(lambda a, b: jnp.sum(safe_divide(a, b)), (0, 1))(
            jnp.array([1.0, 0.0, -1e10]), jnp.zeros(3)
        )
        assert value == 0
        close(gradient, (jnp.zeros(3), jnp.zeros(3)))


class TestClamp:
    def test_is_clip_and_its_gradient_goes_to_what_it_returns(self):
        x = jnp.array([-2.0, 0.3, 5.0, -1.0, 1.0])
        (value, pull_back) = jax.vjp(clamp, x, jnp.full(5, -1.0), jnp.full(5, 1.0))
        close(value, jnp.clip(x, -1, 1), rtol=0, atol=0)
        expected = [[0, 1, 0, 1, 1], [1, 0, 0, 0, 0], [0, 0, 1, 0, 0]]
        close(pull_back(jnp.ones(5)), tuple(jnp.array(row, jnp.float32) for row in expected))


def test_per_feature_broadcasts_over_the_last_axis_alone():
    close(jnp.zeros((4, 2, 3)) + per_feature(jnp.arange(3.0), jnp.zeros((4, 2, 3))), np.tile(np.arange(3.0), (4, 2, 1)))


class TestRows:
    """`gather_rows` and `scatter_rows` against plain indexing, in every way that vmap can map them."""

    table, values = numbers(3, 2, 3, 5, 2), numbers(4, 2, 3, 4, 2)
    maps = pytest.mark.parametrize("axes", [(0, 0), (0, None), (None, 0)], ids=["both", "table", "index"])

    @staticmethod
    def plain_gather(table, index):
        return table[index]

    @staticmethod
    def plain_scatter(index, values):
        return jnp.zeros((5, 2)).at[index].add(values)

    @staticmethod
    def scatter(index, values):
        return scatter_rows(index, values, 5)

    def nested(self, kernel, axes):
        return jax.vmap(jax.vmap(kernel, in_axes=axes), in_axes=axes)

    @maps
    def test_gather_is_indexing_under_nested_vmap(self, axes):
        arguments = [x if a == 0 else x[0, 0] for x, a in zip((self.table, INDEX), axes, strict=True)]
        close(*(jax.jit(self.nested(f, axes))(*arguments) for f in (gather_rows, self.plain_gather)), rtol=0, atol=0)

    @maps
    def test_scatter_is_addition_under_nested_vmap(self, axes):
        arguments = [x if a == 0 else x[0, 0] for x, a in zip((INDEX, self.values), axes, strict=True)]
        close(*(jax.jit(self.nested(f, axes))(*arguments) for f in (self.scatter, self.plain_scatter)))

    def test_different_axes_may_be_mapped_one_after_the_other(self):
        def mapped(kernel):  # the table alone outside, the index alone inside
            return jax.vmap(jax.vmap(kernel, (None, 0)), (0, None))(self.table[0], INDEX[0])

        close(mapped(gather_rows), mapped(self.plain_gather))

    @pytest.mark.parametrize("mapped", [False, True])
    def test_first_and_second_order_gradients_are_those_of_indexing(self, mapped):
        def derivatives(gather, scatter):
            def energy(table, values, index):
                return jnp.sum(gather(table**2, index) ** 3) + jnp.sum(scatter(index, values**2) ** 3 * table)

            def slope(table, values, index):
                gradient = jax.grad(energy, (0, 1))(table, values, index)
                return jnp.sum(gradient[0] ** 2) + jnp.sum(jnp.sin(gradient[1]))

            first, second = jax.grad(energy, (0, 1)), jax.grad(slope, (0, 1))
            if mapped:
                first, second = jax.vmap(jax.vmap(first)), jax.vmap(jax.vmap(second))
                arguments = (self.table, self.values, INDEX)
            else:
                arguments = (self.table[0, 0], self.values[0, 0], INDEX[0, 0])
            return jax.jit(lambda *a: (first(*a), second(*a)))(*arguments)

        close(derivatives(gather_rows, self.scatter), derivatives(self.plain_gather, self.plain_scatter), rtol=1e-4)

    def test_no_index_gathers_nothing_and_scatters_zeros(self):
        none = jnp.zeros((0,), jnp.int32)
        assert gather_rows(self.table[0, 0], none).shape == (0, 2)
        close(self.scatter(none, jnp.zeros((0, 2))), jnp.zeros((5, 2)))


class TestSoftplus:
    def test_its_second_derivative_is_that_of_log_one_plus_exp(self):
        x = np.linspace(-3, 3, 7, dtype=np.float32)
        second = jax.jit(jax.vmap(jax.grad(jax.grad(softplus))))(jnp.asarray(x))
        close(second, 1 / (1 + np.exp(-x)) / (1 + np.exp(x)))
