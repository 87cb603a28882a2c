"""What a long training asks of glibc's allocator, so that memory does not grow; other C libraries are left alone."""

import ctypes
import os
from collections.abc import Callable

ARENA_MAX = -8  # M_ARENA_MAX of malloc.h


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
