"""How programs of JAX run: over all devices, and from traces that are cached on disk beside XLA's programs.

Several devices form a mesh, over which the objects of a batch are divided.  The program is that of a single device:
placed inputs and the active mesh are the only differences, and XLA adds the communication.  Parameters and optimisers
are replicated.  Where a program packs rays by what they hit (`voxels.map_existing`), each device packs those of its own
objects (`split_objects`): otherwise XLA would let every device compute all of them.

With cached traces (`CachedProgram`), a new process neither traces nor compiles.  A trace is a function that
`jax.export` has written; its name depends on shapes, static arguments, the package's sources, JAX and the platform.
"""

import contextlib
import functools
import hashlib
import inspect
import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, Self

import jax
import numpy as np
from jax import export
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from spnr_jax.errors import UserError

# --- many devices -----------------------------------------------------------------------------------------------------


OBJECTS = "objects"


def device_mesh() -> Mesh | None:
    """All devices in one axis; None for a single device."""
    count = jax.device_count()
    return jax.make_mesh((count,), (OBJECTS,), axis_types=(AxisType.Auto,)) if count > 1 else None


def use_mesh(mesh: Mesh | None) -> AbstractContextManager:
    """Context in which jitted functions compute on the mesh; does nothing for None."""
    return nullcontext() if mesh is None else jax.set_mesh(mesh)


def check_divides(mesh: Mesh | None, batch_objects: int) -> None:
    """ValueError if the objects of a batch cannot be divided among the devices."""
    if mesh is not None and batch_objects % mesh.size:
        raise UserError(
            f"batch_objects {batch_objects} cannot be divided among {mesh.size} devices; use a multiple, or show JAX "
            "fewer devices (CUDA_VISIBLE_DEVICES)"
        )


def place_batch(batch: Any, mesh: Mesh | None) -> Any:
    """The batch with its objects, the first axes of its arrays, divided among the devices of the mesh."""
    return jax.device_put(batch, None if mesh is None else NamedSharding(mesh, PartitionSpec(OBJECTS)))


def on_first_device(tree: Any) -> Any:
    """Replicated arrays as arrays of one device."""
    return jax.tree.map(lambda x: x.addressable_data(0), tree)


def object_groups(count: int) -> int:
    """Number of groups that the active mesh divides the objects into; 1 without a mesh, or if it cannot divide them."""
    mesh = jax.sharding.get_abstract_mesh()
    groups = mesh.size if OBJECTS in mesh.auto_axes else 1  # within `split_objects`, each device already has its own
    return 1 if count % groups else groups


def split_objects(function: Callable[..., Any], whole: Any, *parts: Any) -> Any:
    """`function(whole, *parts)`, where each device of the active mesh has only its own objects.

    Arrays of the parts and of the result have objects first; `whole` is shared by all.
    """
    if object_groups(jax.tree.leaves(parts)[0].shape[0]) == 1:  # also for the one object that initialises a network
        return function(whole, *parts)
    specs = (PartitionSpec(), *[PartitionSpec(OBJECTS)] * len(parts))
    # unchecked: a scan that starts from a constant is refused, although all results differ by device
    divided = jax.shard_map(function, in_specs=specs, out_specs=PartitionSpec(OBJECTS), check_vma=False)
    return divided(whole, *parts)


# --- cached traces ----------------------------------------------------------------------------------------------------


DIGEST = hashlib.sha256().digest_size


class CachedProgram:
    """A function under `jax.jit` whose traces are cached; its keyword-only arguments are static.

    Calls with tracers or sharded arrays bypass the cache.
    """

    instances: ClassVar[list[Self]] = []

    def __init__(self, function: Callable[..., Any], options: dict[str, Any] | None = None) -> None:
        """`options` are XLA's."""
        functools.update_wrapper(self, function)
        self.function, self.options = function, options
        static = [name for name, x in inspect.signature(function).parameters.items() if x.kind is x.KEYWORD_ONLY]
        self.jitted = jax.jit(function, static_argnames=static, compiler_options=options)
        self.programs: dict[Any, Callable[..., Any]] = {}
        CachedProgram.instances.append(self)

    def __call__(self, *args: Any, **static: Any) -> Any:
        """The result of the function."""
        leaves, tree = jax.tree.flatten(args)
        if not all(_is_plain(leaf) for leaf in leaves):
            return self.jitted(*args, **static)
        key = tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves), tuple(sorted(static.items()))
        program = self.programs.get(key)  # another thread may make room
        if program is None:
            make_room()
            program = self.programs[key] = self._program(tree, leaves, static, key)
        return program(*leaves)

    def _program(self, tree: Any, leaves: list, static: dict[str, Any], key: Any) -> Callable[..., Any]:
        """A function of the leaves; from a trace if programs are cached on disk."""
        folder = jax.config.values["jax_compilation_cache_dir"]
        if not folder:
            return lambda *leaves: self.jitted(*jax.tree.unflatten(tree, leaves), **static)
        trace = self._load(Path(folder), tree, leaves, static, key)
        return jax.jit(trace.call, compiler_options=self.options)

    def _load(self, folder: Path, tree: Any, leaves: list, static: dict[str, Any], key: Any) -> export.Exported:
        """The trace for these arguments: from disk, or a new one, which is written to disk."""
        name = self.function.__name__
        versions = jax.__version__, jax.default_backend(), jax.config.values["jax_enable_x64"]
        depends = repr((self.function.__module__, name, versions, key)).encode() + _digest_sources()
        file = folder / f"trace-{name}-{hashlib.sha256(depends).hexdigest()}"
        with contextlib.suppress(OSError):
            written = file.read_bytes()
            if hashlib.sha256(written[DIGEST:]).digest() == written[:DIGEST]:
                return export.deserialize(bytearray(written[DIGEST:]))
        shapes = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
        flat = jax.jit(lambda *leaves: self.function(*jax.tree.unflatten(tree, leaves), **static))
        trace = export.export(flat)(*shapes)
        content = bytes(trace.serialize())
        with contextlib.suppress(OSError):  # disk full or folder read-only: it is traced again next time
            folder.mkdir(parents=True, exist_ok=True)
            unfinished = file.with_name(f".unfinished-{os.getpid()}-{file.name}")
            unfinished.write_bytes(hashlib.sha256(content).digest() + content)
            os.replace(unfinished, file)
        return trace


MAPS, MOST_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
FULL = 0.5  # share of the maps, from which on programs are dropped


def make_room() -> None:
    """Drops JAX's compiled programs when the process has used half of the memory maps that Linux grants it.

    XLA takes three maps for each kernel on a CPU, a thousand for a size of clouds; where none is left it crashes.  What
    is needed again is compiled again, or read from the disk.
    """
    with contextlib.suppress(OSError):  # another system
        if MAPS.read_bytes().count(b"\n") > FULL * int(MOST_MAPS.read_text()):
            jax.clear_caches()
            for kept in CachedProgram.instances:
                kept.programs.clear()


def _is_plain(leaf: Any) -> bool:
    """Whether it is an array on the host or on a single device."""
    if isinstance(leaf, jax.core.Tracer):
        return False
    return isinstance(leaf, np.ndarray) or (isinstance(leaf, jax.Array) and len(leaf.devices()) == 1)


@functools.cache
def _digest_sources() -> bytes:
    """A digest of the package's code."""
    found = hashlib.sha256()
    root = resources.files("spnr_jax")
    assert isinstance(root, Path)
    for path in sorted(root.rglob("*.py")):
        found.update(path.read_bytes())
    return found.digest()
