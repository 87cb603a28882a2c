"""Strict interpreter: shape annotations are executed, ranks are never promoted, no key is used twice, warnings are errors.

The import hook must be installed before any test module imports spnr_jax; `test_types_are_checked.py` proves that it was.
Matrix products run in full float32 (a GPU would round them to TF32); on a CPU this changes nothing.  LLVM optimises
nothing: at these sizes a test waits for the compiler, and the program that XLA hands to LLVM is the same.
"""

import os

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"

import jax
from jaxtyping import install_import_hook

install_import_hook("spnr_jax", "beartype.beartype")

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_default_matmul_precision", "highest")
