"""Strict interpreter: shape annotations are executed, ranks are not promoted, keys are used once, warnings are errors.

The hook must be installed before a test module imports spnr_jax; `test_types_are_checked.py` proves that it was.
Matrix products run in full float32 (a GPU would round them to TF32); on a CPU this changes nothing.  At these sizes a
test waits for the compiler alone, so XLA's CPU backend optimises as little as it can: 12 instead of 29 seconds for the
training step.  Nothing but rounding depends on it.  Each worker compiles on its own core, without source lines in its
programs: a tenth of the time each.  What took long to compile is kept in pytest's own folder, for the
other workers and for the next run (JAX_COMPILATION_CACHE_DIR moves it, `-p no:cacheprovider` does without).  Tracing
makes millions of objects, among which the garbage collector looks less often than it would.
"""

import gc
import os
import signal
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).parents[1]
QUICK_COMPILATION = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
LONG = 0.3  # seconds of a compilation that is kept
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_COMPILATION}".strip()  # read at the first use

gc.set_threshold(100_000, 50, 50)
modules = [path.relative_to(ROOT).with_suffix("").parts for path in sorted((ROOT / "spnr_jax").rglob("*.py"))]
# of options annotations are not executed: tyro's mark of a missing value stands for a Path
checked = [".".join(parts) for parts in modules if parts[-1] not in ("__init__", "commands", "cli")]
install_import_hook([*checked, "experiments.baselines"], "beartype.beartype")

# a shell that starts the suite in the background has it ignore Ctrl-C, and its children with it
signal.signal(signal.SIGINT, signal.default_int_handler)

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_default_matmul_precision", "highest")
jax.config.update("jax_traceback_in_locations_limit", 0)


@pytest.fixture(autouse=True)
def _obey_ctrl_c():
    """A command that another test ran to its end in this process may have left its own answer to Ctrl-C."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config):
    """Programs are kept in .pytest_cache, unless the environment names another folder."""
    if hasattr(config, "cache") and jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("programs")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", LONG)
