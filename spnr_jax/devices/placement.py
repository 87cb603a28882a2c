"""Many devices, many hosts: a mesh of all devices, over which the objects of a batch are divided.

The program is the one of a single device: placed inputs and the mesh in use are all that differs, and XLA adds the
communication.  Parameters and optimisers are on every device whole.  Where a program packs rays by what they meet
(`occupancy.map_existing`), each device packs those of its own objects (`split_objects`): XLA would let all of them
compute all.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from spnr_jax.errors import UserError, first_line

OBJECTS = "objects"
END_TIMEOUT = 30  # seconds that a process which ended waits for the others
HEARTBEAT_TIMEOUT = 20  # seconds of silence after which a process counts as gone, and the others end


def join(coordinator: str | None = None, num_processes: int | None = None, process_id: int | None = None) -> None:
    """Joins this process to the others of its training, before anything else of JAX runs.

    Without arguments JAX asks the launcher's environment (SLURM, Open MPI, Kubernetes).  ValueError if that says
    nothing, or the others cannot be reached.
    """
    given = coordinator, num_processes, process_id
    if None in given and given != (None, None, None):
        raise UserError("--coordinator, --num-processes and --process-id: expected all three, or none in a launcher")
    if num_processes is not None and not 0 <= (process_id or 0) < num_processes:
        raise UserError(f"--process-id {process_id}: expected 0 to {num_processes - 1} of --num-processes")
    try:
        jax.distributed.initialize(
            *given, heartbeat_timeout_seconds=HEARTBEAT_TIMEOUT, shutdown_timeout_seconds=END_TIMEOUT
        )
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"the processes do not find each other ({error}); start them by srun, mpirun or an indexed Kubernetes job, "
            "or give --coordinator HOST:PORT --num-processes N --process-id I"
        ) from None


def device_mesh() -> Mesh | None:
    """All devices of all processes in one axis; None if there is one alone."""
    count = jax.device_count()
    return jax.make_mesh((count,), (OBJECTS,), axis_types=(AxisType.Auto,)) if count > 1 else None


def using(mesh: Mesh | None) -> AbstractContextManager:
    """The context in which jitted functions are called that compute on the mesh; nothing without one."""
    return nullcontext() if mesh is None else jax.set_mesh(mesh)


def leads() -> bool:
    """Whether this is the process that writes what is written once."""
    return jax.process_index() == 0


def sharding_of_all(mesh: Mesh) -> NamedSharding:
    """The sharding of what every device holds whole."""
    return NamedSharding(mesh, PartitionSpec())


def by_object(mesh: Mesh) -> NamedSharding:
    """The sharding of arrays whose first axis are objects."""
    return NamedSharding(mesh, PartitionSpec(OBJECTS))


def own_objects(mesh: Mesh, batch_objects: int) -> range:
    """Places in the global batch of the objects on this process's devices; ValueError if they cannot be divided."""
    if batch_objects % mesh.size:
        raise UserError(
            f"batch_objects {batch_objects} cannot be divided among {mesh.size} devices; use a multiple, or show JAX "
            "fewer devices (CUDA_VISIBLE_DEVICES)"
        )
    places = by_object(mesh).addressable_devices_indices_map((batch_objects,)).values()
    starts, stops = zip(*(place[0].indices(batch_objects)[:2] for place in places if place), strict=True)
    return range(min(starts), max(stops))


def place_batch(own: Any, mesh: Mesh | None, batch_objects: int) -> Any:
    """The global batch on the mesh, of which this process holds `own_objects`; without a mesh on the first device."""
    if mesh is None:
        return jax.device_put(own)
    put = partial(jax.make_array_from_process_local_data, by_object(mesh))
    return jax.tree.map(lambda x: put(x, (batch_objects, *x.shape[1:])), own)


def on_this_process(tree: Any) -> Any:
    """What every device holds whole, as arrays of one device of this process."""
    return jax.tree.map(lambda x: x.addressable_data(0), tree)


def first_alone(work: Callable[[], object]) -> None:
    """Runs the work on the first process while the others wait; if it raises there, ValueError on these."""
    if jax.process_count() == 1:
        work()
        return
    error = None
    if leads():
        try:
            work()
        except Exception as raised:  # noqa: BLE001 - raised again, when the others know
            error = raised
    failed = multihost_utils.broadcast_one_to_all(error is not None)
    if error:
        raise error
    if failed:
        raise UserError("the first process of this training stopped, and says why")


class Agreement:
    """A flag that is true where any process has set it, all-reduced; delayed by one call, so that it never blocks."""

    def __init__(self, mesh: Mesh | None) -> None:
        """Nobody has asked yet."""
        self._mesh = mesh
        self._said: jax.Array | None = None

    def __call__(self, asked: bool) -> bool:
        """Whether any process had asked at the call before; of a single process, whether it asks now."""
        if self._mesh is None or jax.process_count() == 1:
            return asked
        own = np.full(jax.local_device_count(), asked)
        earlier, self._said = self._said, jnp.any(jax.make_array_from_process_local_data(by_object(self._mesh), own))
        return earlier is not None and bool(earlier)


def explain_lost_process(error: jax.errors.JaxRuntimeError, run: object) -> Exception:
    """What to raise of an error of the runtime: of several processes, that another one is gone."""
    if jax.process_count() == 1:
        return error
    return ValueError(
        f"{run}: another process of this training ended ({first_line(error)}); start all again, and they go on from "
        "the last checkpoint"
    )


def object_groups(count: int) -> int:
    """How many groups the mesh in use divides so many objects into; 1 without a mesh, or if it does not divide them."""
    mesh = jax.sharding.get_abstract_mesh()
    groups = mesh.size if OBJECTS in mesh.auto_axes else 1  # within `split_objects` each device has its own already
    return 1 if count % groups else groups


def split_objects(function: Callable[..., Any], whole: Any, *parts: Any) -> Any:
    """`function(whole, *parts)`, in which each device of the mesh in use has its own objects alone.

    Arrays of the parts and of what is returned have objects first; `whole` is what all share.
    """
    if object_groups(jax.tree.leaves(parts)[0].shape[0]) == 1:  # also of the one object that makes a network's weights
        return function(whole, *parts)
    specs = (PartitionSpec(), *[PartitionSpec(OBJECTS)] * len(parts))
    # unchecked: a scan that starts from a constant is refused, although all results differ by device
    divided = jax.shard_map(function, in_specs=specs, out_specs=PartitionSpec(OBJECTS), check_vma=False)
    return divided(whole, *parts)
