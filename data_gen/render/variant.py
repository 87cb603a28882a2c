"""Which Mitsuba does the rendering: the compiled LLVM variant where it works, plain scalar code everywhere else.

Dr.Jit aborts the whole process with some LLVM versions, so a library is tried in a child process first. The choice
and the notice about it are made once, in the parent; workers are told the variant's name.
"""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

from spnr_jax.errors import UserError

LLVM, SCALAR = "llvm_ad_rgb", "scalar_rgb"
OLDEST_LLVM = 16  # older libraries are refused by Dr.Jit or abort
LIBRARY_PATTERNS = ("lib*/libLLVM*", "lib/*/libLLVM*", "lib/llvm*/lib/libLLVM*", "opt/llvm/lib/libLLVM*")
LIBRARY_NAME = re.compile(r"libLLVM(?:-|\.so\.)(\d+)[\d.]*(?:\.so[\d.]*|\.dylib)?")  # not libLLVMX86Desc.a
LIBRARY_ROOTS = ("/usr", "/usr/local", "/opt/homebrew", sys.prefix, sys.base_prefix)
SLOW_NOTICE = (
    "rendering with Mitsuba's scalar_rgb: no usable LLVM library was found; to render about three times faster, "
    "install LLVM 17 or newer (Debian and Ubuntu: libllvm19), or set DRJIT_LIBLLVM_PATH to its libLLVM file"
)
PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
ball = {"type": "sphere", "bsdf": {"type": "twosided", "inner": {"type": "principled"}}}
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "light": {"type": "constant"}, "ball": ball})
sensor = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}})
print(float(mi.render(scene, sensor=sensor, spp=2).array[0]))
"""


def choose_variant(requested: str = "auto") -> tuple[str, str | None]:
    """(variant, notice): the fastest variant that works here, and one line for the user if it is the slow one.

    Sets DRJIT_LIBLLVM_PATH for this process and its children when it settles on a library.
    """
    if requested not in ("auto", SCALAR, LLVM):
        raise UserError(f"variant: expected auto, {SCALAR} or {LLVM}, got {requested!r}")
    if requested == SCALAR:
        return SCALAR, None
    for library in llvm_libraries()[:2]:
        if probe(library):
            os.environ["DRJIT_LIBLLVM_PATH"] = str(library)
            return LLVM, None
    if requested == LLVM:
        raise UserError(f"variant: {LLVM} does not run here; install LLVM 17 or newer, or use --variant {SCALAR}")
    return SCALAR, SLOW_NOTICE


def llvm_libraries() -> list[Path]:
    """The LLVM libraries worth trying: the one the user named, or all that are found, newest first."""
    if named := os.environ.get("DRJIT_LIBLLVM_PATH"):
        return [Path(named)]
    found = {path for root in LIBRARY_ROOTS for pattern in LIBRARY_PATTERNS for path in Path(root).glob(pattern)}
    versions = {path: int(match[1]) for path in sorted(found) if (match := LIBRARY_NAME.fullmatch(path.name))}
    usable = (path for path, version in versions.items() if version >= OLDEST_LLVM)
    return sorted(usable, key=versions.__getitem__, reverse=True)


def probe(library: Path) -> bool:
    """Whether a child process can render a small scene with this LLVM library."""
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": str(library)}
    command = [sys.executable, "-c", PROBE]
    try:
        return subprocess.run(command, env=environment, capture_output=True, timeout=120).returncode == 0
    except subprocess.TimeoutExpired:
        return False


def mitsuba_module(variant: str | None = None):
    """The mitsuba module with `variant` set (scalar code if none was ever chosen), on one thread.

    One thread each because objects are spread over processes; it also fixes how Mitsuba cuts the image into blocks,
    and with it the random numbers: the bytes do not depend on the machine's core count.
    """
    mi = importlib.import_module("mitsuba")
    if variant is not None or mi.variant() is None:
        mi.set_variant(variant or SCALAR)
        mi.set_log_level(mi.LogLevel.Error)  # else it warns about every rounded sample count
        importlib.import_module("drjit").set_thread_count(1)
    return mi
