"""JAX computes right: jaxlib 0.10.2 sums rows of products wrongly on a CPU from some sizes on (jax-ml/jax#39103).

Both sides of the sizes from which the fault was seen; it shows with the compiler options of these tests, too.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlib import version

import spnr_jax

SIZES = [("float32", 32768), ("float32", 32769), ("float64", 16384), ("float64", 16385)]


@pytest.mark.parametrize(("kind", "rows"), SIZES)
def test_a_sum_over_the_rows_of_vmapped_products_is_right(kind, rows):
    with jax.enable_x64(kind == "float64"):
        number = jnp.arange(rows, dtype=kind)
        vectors = jnp.stack([number, 0 * number, 0 * number], axis=1)
        matrix = jnp.eye(3, dtype=kind)
        squared = jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(vectors)
        np.testing.assert_array_equal(squared, np.arange(rows, dtype=kind) ** 2)


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
