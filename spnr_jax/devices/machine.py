"""The machine that a measurement was made on, in words."""

import os
import platform
from pathlib import Path

import jax

CPUINFO = Path("/proc/cpuinfo")
INSTRUCTION_SETS = ("avx2", "fma", "avx512f", "avx512_vnni", "avx512_bf16", "amx_bf16", "asimd", "sve")


def hardware() -> str:
    """The device that JAX uses, in words."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return f"{jax.device_count()} x {device.device_kind}"
    names = _told("model name")
    return f"{len(os.sched_getaffinity(0))} cores of {names[0] if names else platform.machine()}"


def processor() -> str:
    """The processor's name, and which of its instruction sets matter to products of matrices."""
    names, flags = _told("model name"), _told("flags") or _told("Features")
    known = flags[0].split() if flags else []
    sets = [name for name in INSTRUCTION_SETS if name in known]
    return f"{names[0] if names else platform.machine()} ({', '.join(sets) or 'instruction sets unknown'})"


def flags() -> str:
    """Everything that the kernel says the first core can do."""
    return next(iter(_told("flags") or _told("Features")), platform.machine())


def load() -> float:
    """Threads that ran or waited to run on this machine, mean of the last minute: those of others, too."""
    return round(os.getloadavg()[0], 1)


def _told(name: str) -> list[str]:
    """What the kernel says of each core under this name; nothing where it says nothing."""
    lines = CPUINFO.read_text().splitlines() if CPUINFO.is_file() else []
    return [line.split(":", 1)[1].strip() for line in lines if line.split(":")[0].strip() == name]
