"""Whole programs on the disk: a process that needs one again neither traces, lowers nor compiles it.

JAX's own cache saves the compilation alone; tracing and lowering a picture's programs takes longer than drawing it.
A program is found by what it depends on: its name and static arguments, shapes and types of its arrays, every file of
this package, versions, flags, the processor.  Without a folder (`keep_in`), on several devices or others than CPUs, and
within other programs, the function is called as it is.

The files hold machine code and pickles, as those of JAX's cache hold machine code: whoever may write in the folder says
what this process does.
"""

import hashlib
import os
import pickle
import platform
import tempfile
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, update_wrapper
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

PACKAGES = "jax", "jaxlib", "flax", "numpy"
ENDING = ".program"
# a full disk, or one that cannot be written to; a program that XLA cannot write down, with constants or some sorts
UNKEPT = OSError, NotImplementedError, jax.errors.JaxRuntimeError
MOST = 1000  # files that are kept, of the newest; pictures of an object need six or so

_folders: list[Path] = []  # the one that programs are kept in, or none
_programs: dict[tuple, jax.stages.Compiled] = {}
_making = threading.RLock()  # JAX's cache is off for all threads while one is made


def keep_in(folder: Path | None) -> None:
    """Has programs kept in a folder from now on; None: nowhere."""
    _folders[:] = [] if folder is None else [folder]
    _programs.clear()


def kept(program: Any, static: tuple[str, ...] = ()) -> Any:
    """A jitted function whose programs are kept; its static arguments, given by name, are `static`."""
    name = f"{program.__module__}.{program.__qualname__}"

    def call(*arrays: Any, **options: Any) -> Any:
        dynamic = {key: value for key, value in options.items() if key not in static}
        leaves, tree = jax.tree.flatten((arrays, dynamic))
        if not _folders or not _on_one_cpu() or any(isinstance(x, jax.core.Tracer) for x in leaves):
            return program(*arrays, **options)
        place = name, tuple(options[key] for key in static), tree, tuple(map(_kind, leaves)), _settings()
        if place not in _programs:
            with _making:
                if place not in _programs:
                    _programs[place] = _found_or_made(place, lambda: program.lower(*arrays, **options))
        return _programs[place](*arrays, **dynamic)

    return update_wrapper(call, program)


def _kind(leaf: Any) -> tuple:
    """What a program is compiled for of an argument."""
    of = jax.typeof(leaf)
    return of.shape, of.dtype.name, of.weak_type


def _settings() -> tuple:
    """Options of JAX that programs depend on, and that may change while the process runs."""
    config = jax.config.values
    names = "jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_rank_promotion", "jax_debug_nans"
    return tuple(config[name] for name in names)


@cache
def _on_one_cpu() -> bool:
    return jax.default_backend() == "cpu" and jax.device_count() == 1


def _found_or_made(place: tuple, lower: Callable[[], jax.stages.Lowered]) -> jax.stages.Compiled:
    path = _folders[0] / (hashlib.sha256(f"{_here()} {place}".encode()).hexdigest() + ENDING)
    with suppress(Exception):  # whatever is wrong with a file, it is made again
        os.utime(path)  # used lately
        return serialize_executable.deserialize_and_load(*pickle.loads(zlib.decompress(path.read_bytes())))
    with _without_cache():
        made = lower().compile()
    with suppress(*UNKEPT):
        _write(path, zlib.compress(pickle.dumps(serialize_executable.serialize(made)), 1))
    return made


@contextmanager
def _without_cache() -> Iterator[None]:
    """JAX's cache is off: what was loaded from it cannot be kept again, its functions would be lacking."""
    before = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()  # it asks whether it is on but once
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        compilation_cache.reset_cache()


@cache
def _here() -> str:
    """What all programs depend on: the package's code, versions, flags, the processor."""
    from spnr_jax.devices import machine  # here: what draws a picture without a command needs one module less

    found = hashlib.sha256()
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        found.update(f"{path.relative_to(package)}\n".encode() + path.read_bytes())
    versions = [version(name) for name in PACKAGES]
    return f"{found.hexdigest()} {versions} {platform.python_version()} {os.environ.get('XLA_FLAGS')} {machine.flags()}"


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, unfinished = tempfile.mkstemp(dir=path.parent, prefix=".unfinished-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(unfinished, path)
    except OSError:
        Path(unfinished).unlink(missing_ok=True)
        raise
    for old in sorted(path.parent.glob(f"*{ENDING}"), key=os.path.getmtime)[:-MOST]:
        old.unlink(missing_ok=True)
