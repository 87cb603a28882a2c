"""3D U-Net: the sparse stem, the widths of its stages, and the skips."""

import jax
import jax.numpy as jnp
import numpy as np
from support.laws import close, numbers

from spnr_jax.nn.paper_layers import UNet3D

ROWS = jnp.asarray(np.random.default_rng(0).integers(0, 513, (2, 20)), jnp.int32)
VALUES = numbers(1, 2, 20, 3)
MODULE = UNet3D(resolution=8, base_width=4, num_stages=2, num_groups=2)
VARIABLES = jax.jit(MODULE.init)(jax.random.key(0), ROWS, VALUES)
apply = jax.jit(MODULE.apply)


def test_objects_do_not_see_each_other():
    whole, other = (apply(VARIABLES, rows, VALUES) for rows in (ROWS, ROWS.at[0].set(ROWS[0, ::-1] // 2)))
    close(other[1], whole[1], atol=1e-5)
    assert (other[0] != whole[0]).any()


def test_without_its_decoder_the_stem_alone_reaches_the_output():
    """Skips are additions: blocks of zeros add relu(bias) = 0 to what the stem sends across."""
    silent = {
        name: block if name == "stem" else jax.tree.map(jnp.zeros_like, block)
        for name, block in VARIABLES["params"].items()
    }
    stem, out = (apply({"params": p}, ROWS, VALUES) for p in (silent, VARIABLES["params"]))
    assert (stem >= 0).all()
    assert (stem > 0).any()
    assert (out >= stem).all(), "a decoder block adds its ReLU"
    assert (out > stem).any()


def test_moving_the_points_by_whole_coarse_voxels_moves_the_volume_with_them():
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
