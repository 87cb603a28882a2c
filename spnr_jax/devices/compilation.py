"""Compiled programs are kept on the disk, for the next process that needs them."""

from pathlib import Path

SHORTEST = 0.1  # seconds of compilation from which on a program is kept


def folder() -> Path:
    """Where this package keeps what can be made again, of this user."""
    return Path.home() / ".cache" / "spnr_jax"


def keep_programs() -> None:
    """Lets a second run skip XLA's compilation, and of pictures all that comes before it.

    JAX_COMPILATION_CACHE_DIR moves both; with JAX_ENABLE_COMPILATION_CACHE=0 nothing is kept.
    """
    import jax

    from spnr_jax.devices import kept_programs  # here: `--help` does without JAX

    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
    place = str(jax.config.values["jax_compilation_cache_dir"])
    if jax.config.values["jax_enable_compilation_cache"] and "://" not in place:
        kept_programs.keep_in(Path(place) / "programs")
