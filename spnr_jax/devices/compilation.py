"""Compiled programs are kept on the disk, for the next process that needs them."""

import os
from pathlib import Path

SHORTEST = 0.1  # seconds of compilation from which on a program is kept
# options of XLA for an outermost jit: a third to two thirds off the compilation of long programs, which run as long
QUICK = {"xla_cpu_use_fusion_emitters": False}
QUICKEST = QUICK | {"xla_backend_optimization_level": 1}


def folder() -> Path:
    """Where this package keeps what can be made again, of this user."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "spnr_jax"


def keep_programs() -> None:
    """Lets a second run skip XLA's compilation; JAX_COMPILATION_CACHE_DIR moves the cache.

    On some processors XLA logs two long errors for each program that it reads, though nothing is wrong with it
    (openxla/xla#44565).  Where JAX is not imported yet they stay off the terminal; TF_CPP_MIN_LOG_LEVEL=2 shows them.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
