"""jaxlib 0.10.2 sums rows of products wrongly on a CPU (jax-ml/jax#39103): it is warned of."""

import warnings

import pytest
from jaxlib import version

import spnr_jax


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
