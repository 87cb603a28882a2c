"""Strict interpreter: shape annotations are executed, ranks are not promoted, keys are used once, warnings are errors.

The hook must be installed before a test module imports spnr_jax; `test_types_are_checked.py` proves that it was.
Matrix products run in full float32 (a GPU would round them to TF32); on a CPU this changes nothing.  At these sizes a
test waits for the compiler alone, so XLA's CPU backend optimises as little as it can: 12 instead of 29 seconds for the
training step.  Nothing but rounding depends on it.
"""

import os
import signal

import jax
from jaxtyping import install_import_hook

QUICK_COMPILATION = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_COMPILATION}".strip()  # read at the first use

install_import_hook("spnr_jax", "beartype.beartype")

# a shell that starts the suite in the background has it ignore Ctrl-C, and its children with it
signal.signal(signal.SIGINT, signal.default_int_handler)

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_default_matmul_precision", "highest")
