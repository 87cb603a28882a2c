"""The most memory that a process held while it did something: the kernel counts, and can be told to begin anew."""

import gc
import resource
from pathlib import Path

from spnr_jax.devices import allocator


def forget_peak() -> None:
    """Gives unused memory back and has the kernel count the peak from here on, where it can (Linux)."""
    gc.collect()
    allocator.give_back()
    counter = Path("/proc/self/clear_refs")
    if counter.exists():
        counter.write_text("5")


def peak_mb() -> int:
    """Largest resident memory since `forget_peak`, in MB of 2^20 bytes; since the start where that does nothing."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) // 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
