"""The gather and scatter of rows that stay flat under vmap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers

from spnr_jax.kernels.voxels import gather_rows, scatter_rows

INDEX = jnp.asarray(np.random.default_rng(7).integers(0, 5, (2, 3, 4)), jnp.int32)


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
