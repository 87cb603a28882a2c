"""Empty space: open voxels, paths through them, and work that follows what exists."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, same_bits

from spnr_jax.kernels import voxels
from spnr_jax.kernels.records import Rays
from spnr_jax.kernels.voxels import map_existing

RNG = np.random.default_rng(0)
open_path, distance_at = jax.jit(voxels.open_path, static_argnames="num_cells"), jax.jit(voxels.distance_at)


class TestDilate:
    @pytest.mark.parametrize("reach", [0, 1, 2, 9])
    def test_voxels_within_reach_of_an_occupied_one_are_near_points(self, reach):
        occupied = RNG.random((2, 6, 6, 6)) < 0.01
        expected = np.zeros_like(occupied)
        for where, z, y, x in np.argwhere(occupied):
            lowest = np.maximum([z - reach, y - reach, x - reach], 0)
            expected[where, *(slice(lo, at + reach + 1) for lo, at in zip(lowest, (z, y, x), strict=True))] = True
        same_bits(voxels.dilate(jnp.array(occupied), reach), jnp.array(expected))


class TestPath:
    """Rays through a grid of 4^3 voxels of which some are open."""

    near, far = jnp.array([0.0, 0.5, 1.0]), jnp.array([2.0, 1.5, 1.0])
    rays = Rays(origins=jnp.array([[-1.0, 0.1, 0.1]] * 3), directions=jnp.array([[1.0, 0.0, 0.0]] * 3))

    def path(self, row, cells=8):
        """Open voxels of the row that the rays run along."""
        grid = jnp.zeros((4, 4, 4), bool).at[2, 2].set(jnp.array(row))
        return open_path(grid, self.rays, self.near, self.far, num_cells=cells)

    def test_open_length_is_that_of_open_voxels_and_places_jump_over_gaps_on_their_edge_before_them(self):
        path = self.path([True, False, True, True])  # open from 0 to 0.5 and from 1 to 2
        close(path.travelled[:, -1], np.array([1.5, 0.5, 0.0]))
        close(path.travelled[0], np.array([0, 0.25, 0.5, 0.5, 0.5, 0.75, 1, 1.25, 1.5]))
        at = jnp.array([[0.1, 0.49, 0.5, 0.51, 0.7, 1.4, 1.5]] * 3)
        close(distance_at(path, at)[0], np.array([0.1, 0.49, 0.5, 1.01, 1.2, 1.9, 2.0]), atol=1e-6)

    def test_paths_have_no_gradient(self):
        def ends(far):
            return jnp.sum(open_path(jnp.ones((4, 4, 4), bool), self.rays, self.near, far, num_cells=5).edges)

        assert (jax.grad(ends)(self.far) == 0).all()

    def test_each_object_has_its_own_voxels(self):
        grids = jnp.array(RNG.random((2, 4, 4, 4)) < 0.5)
        rays, near, far = jax.tree.map(lambda x: jnp.stack([x, x]), (self.rays, self.near, self.far))
        both = open_path(grids, rays, near, far, num_cells=8)
        for i in range(2):
            close(
                jax.tree.map(lambda x, i=i: x[i], both),
                open_path(grids[i], self.rays, self.near, self.far, num_cells=8),
            )


class TestMapExisting:
    exists = jnp.array(RNG.random(23) < 0.4)
    x, w = jnp.array(RNG.normal(size=(23, 3))), jnp.array(RNG.normal(size=3))

    def mapped(self, w, x, exists, block):
        return map_existing(lambda x: jnp.sin(x) @ w, exists, (x,), jnp.full(x.shape[0], 7.0), block)

    @pytest.mark.parametrize("block", [1, 4, 23, 100])
    def test_rows_that_exist_get_the_function_and_the_others_what_is_empty(self, block):
        mapped = jax.jit(self.mapped, static_argnums=3)
        for share in (0.0, 0.4, 1.0):
            exists = jnp.array(RNG.random(23) < share)
            close(mapped(self.w, self.x, exists, block), jnp.where(exists, jnp.sin(self.x) @ self.w, 7.0))

    def test_the_gradient_is_that_of_the_rows_that_exist(self):
        def plain(w, x):
            return jnp.sum(jnp.where(self.exists, jnp.sin(x) @ w, 7.0) ** 2)

        def ours(w, x):
            return jnp.sum(self.mapped(w, x, self.exists, 4) ** 2)

        found, expected = (jax.jit(jax.grad(f, (0, 1)))(self.w, self.x) for f in (ours, plain))
        close(found, expected, rtol=1e-4)

    def test_only_blocks_that_hold_an_existing_row_are_computed(self):
        ran = []

        def function(x):
            jax.debug.callback(lambda: ran.append(1))
            return x[:, 0]

        mapped = jax.jit(lambda x, exists: map_existing(function, exists, (x,), jnp.zeros(23), 4))
        for existing, blocks in ((0, 0), (1, 1), (4, 1), (5, 2), (23, 6)):
            ran.clear()
            jax.block_until_ready(mapped(self.x, jnp.arange(23) >= 23 - existing))
            jax.effects_barrier()
            assert len(ran) == blocks
