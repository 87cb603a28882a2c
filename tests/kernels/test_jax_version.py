"""JAX computes right: jaxlib 0.10.2 sums rows of products wrongly on a CPU from some sizes on (jax-ml/jax#39103).

Both sides of the sizes from which the fault was seen; it shows with the compiler options of these tests, too.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlib import version
from support.surfel_clouds import camera, surfels

import spnr_jax
from spnr_jax.kernels import cameras, voxels
from spnr_jax.surfels import features, lighting, projection

SIZES = [("float32", 32768), ("float32", 32769), ("float64", 16384), ("float64", 16385)]


@pytest.mark.parametrize(("kind", "rows"), SIZES)
def test_a_sum_over_the_rows_of_vmapped_products_is_right(kind, rows):
    with jax.enable_x64(kind == "float64"):
        number = jnp.arange(rows, dtype=kind)
        vectors = jnp.stack([number, 0 * number, 0 * number], axis=1)
        matrix = jnp.eye(3, dtype=kind)
        squared = jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(vectors)
        np.testing.assert_array_equal(squared, np.arange(rows, dtype=kind) ** 2)


def shell(kind, rows):
    """Discs on a ball that each direction sees at random, a camera, the room's light, features and a volume."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(rows, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    columns = {"base_color": rng.uniform(size=(rows, 3)), "visible": rng.uniform(size=(rows, 64))}
    made = surfels(0.6 * direction, direction, 0.01, **columns), camera(64, (1.4, 0.9, 1.7)), lighting.room_light()
    made = *made, rng.normal(size=(rows, 8)), rng.normal(size=(16, 16, 16, 4))

    def cast(x):
        return jnp.asarray(x, kind if jnp.issubdtype(np.asarray(x).dtype, np.floating) else None)

    return jax.tree.map(cast, made)


KERNELS = {
    "attributes": lambda discs, view, light, *_: features.attributes(discs, light, view),
    "arriving": lambda discs, view, light, *_: lighting.arriving(discs, light),
    "footprints": lambda discs, view, *_: projection.footprints(discs, view)[:6],
    "project": lambda discs, view, *_: cameras.project(view, discs.position),
    "scatter_mean": lambda discs, view, light, told, _: voxels.scatter_mean(discs.position, told, discs.mask, 16),
    "trilinear": lambda discs, view, light, told, volume: voxels.trilinear(volume, discs.position),
}


@pytest.mark.parametrize(("kind", "rows"), SIZES[1::2])
def test_kernels_that_reduce_over_points_are_the_same_compiled(kind, rows):
    with jax.enable_x64(kind == "float64"):
        arguments = shell(kind, rows)
        for name, kernel in KERNELS.items():
            for plain, compiled in zip(
                *map(jax.tree.leaves, (kernel(*arguments), jax.jit(kernel)(*arguments))), strict=True
            ):
                scale = max(1.0, float(jnp.abs(plain).max()))
                np.testing.assert_allclose(compiled, plain, rtol=1e-4, atol=1e-5 * scale, err_msg=name)


def test_a_jaxlib_that_is_known_to_compute_wrong_numbers_is_named_in_one_line(monkeypatch):
    monkeypatch.setattr(version, "__version__", "0.10.2")
    with pytest.warns(UserWarning, match=r"jaxlib 0\.10\.2 computes wrong numbers on a CPU.*pip install") as found:
        spnr_jax.warn_of_wrong_numbers()
    assert len(found) == 1
    assert "\n" not in str(found[0].message)
    monkeypatch.setattr(version, "__version__", "0.10.1")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        spnr_jax.warn_of_wrong_numbers()
