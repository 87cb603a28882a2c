"""What is asked of glibc's allocator, for speed and so that memory does not grow; other C libraries are left alone."""

import ctypes
import os
from collections.abc import Callable

TRIM_THRESHOLD, MMAP_MAX, ARENA_MAX = -1, -4, -8  # M_... of malloc.h


def keep_arrays() -> None:
    """Makes JAX on a CPU reuse the heap of the step before (mallopt), without page faults; call it before JAX computes.

    Else the system fetches and clears a step's temporary memory each time, a fifth of the step.  JAX computes in the
    thread that calls it then: other threads' arenas hold 64 MB at most, whatever glibc is asked.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    keep()


def keep() -> None:
    """Has memory that is freed stay in the process until it is given back."""
    _ask(lambda libc: libc.mallopt(MMAP_MAX, 0))
    _ask(lambda libc: libc.mallopt(TRIM_THRESHOLD, 2**31 - 1))


def few_arenas() -> None:
    """Has the threads that begin from now on share arenas, as many as there are cores.

    Each batch, row and checkpoint is made by other threads than the one before; with an arena for each, what they free
    stays scattered over all of them.  With fewer arenas than cores the threads of one step would wait for each other.
    """
    _ask(lambda libc: libc.mallopt(ARENA_MAX, os.cpu_count() or 1))


def give_back() -> None:
    """Has freed memory go back to the system: of Orbax's glibc keeps 130 MB, and 1 MB more after each save."""
    _ask(lambda libc: libc.malloc_trim(0))


def _ask(what: Callable[[ctypes.CDLL], int]) -> None:
    try:
        what(ctypes.CDLL("libc.so.6"))
    except (OSError, AttributeError):
        return  # another C library
