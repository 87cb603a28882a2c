"""Compiled programs are kept on the disk, for the next process that needs them."""

import contextlib
import os
import time
from pathlib import Path

SHORTEST = 0.1  # seconds of compilation from which on a program is kept
# options of XLA for an outermost jit: a third to two thirds off the compilation of long programs, which run as long
QUICK = {"xla_cpu_use_fusion_emitters": False}
QUICKEST = QUICK | {"xla_backend_optimization_level": 1}

LOOKED_AT = "looked-at"  # file whose time says up to when entries are known to be whole


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
    with contextlib.suppress(OSError):  # there is none yet, or it is not ours to mend
        remove_broken(Path(jax.config.values["jax_compilation_cache_dir"]))


def remove_broken(cache: Path) -> None:
    """Removes entries that are cut off, as a process leaves them that was killed while it wrote.

    JAX would warn of them and compile in every run, for it does not write over what is there.  Only what was written
    since the last look is read.
    """
    from jax._src.compilation_cache import decompress_executable  # there is no public way to read an entry

    begin, mark = time.time_ns(), cache / LOOKED_AT
    last = mark.stat().st_mtime_ns if mark.exists() else 0
    for entry in os.scandir(cache):
        if entry.name.endswith("-cache") and entry.stat().st_mtime_ns >= last:
            try:
                decompress_executable(Path(entry.path).read_bytes())
            except OSError:  # another process removed it, or it is another user's
                continue
            except Exception:  # of whichever library unpacks them
                Path(entry.path).unlink(missing_ok=True)
    mark.touch()
    os.utime(mark, ns=(begin, begin))
