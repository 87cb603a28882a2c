"""Many devices, many hosts: processes that know each other, a mesh of their devices, and what lies where on it.

    objects   the axis of the mesh over which the objects of a batch are divided: each device renders its own
    depth     the axis over which the first grid axis (z) of every volume is divided, and with it the rays through it,
              for volumes too big for one device

The program is the one of a single device: placed inputs and the mesh in use are all that differs, and XLA adds the
communication.  Parameters and optimisers are on every device whole.
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

from spnr_jax.types import Batch, Rays

OBJECTS, DEPTH = "objects", "depth"
END_TIMEOUT = 30  # seconds that a process which ended waits for the others


def initialize(coordinator: str | None = None, num_processes: int | None = None, process_id: int | None = None) -> None:
    """Joins this process to the others of its training, before anything else of JAX runs.

    Without arguments JAX asks the launcher's environment (SLURM, Open MPI, Kubernetes).  ValueError if that says
    nothing, or the others cannot be reached.
    """
    given = coordinator, num_processes, process_id
    if None in given and given != (None, None, None):
        raise ValueError("--coordinator, --num-processes and --process-id: expected all three, or none in a launcher")
    if num_processes is not None and not 0 <= (process_id or 0) < num_processes:
        raise ValueError(f"--process-id {process_id}: expected 0 to {num_processes - 1} of --num-processes")
    try:
        jax.distributed.initialize(*given, shutdown_timeout_seconds=END_TIMEOUT)
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"the processes do not find each other ({error}); start them by srun, mpirun or an indexed Kubernetes job, "
            "or give --coordinator HOST:PORT --num-processes N --process-id I"
        ) from None


def device_mesh(depth: int = 1) -> Mesh:
    """All devices of all processes, `depth` of them to each volume; ValueError if these do not divide their number."""
    count = jax.device_count()
    if depth < 1 or count % depth:
        raise ValueError(f"--depth-devices {depth}: expected a divisor of the {count} devices")
    return jax.make_mesh((count // depth, depth), (OBJECTS, DEPTH), axis_types=(AxisType.Auto,) * 2)


def using(mesh: Mesh | None) -> AbstractContextManager:
    """The context in which jitted functions are called that compute on the mesh; nothing without one."""
    return nullcontext() if mesh is None else jax.set_mesh(mesh)


def leads() -> bool:
    """Whether this is the process that writes what is written once."""
    return jax.process_index() == 0


def replicated(mesh: Mesh) -> NamedSharding:
    """The sharding of what every device holds whole."""
    return NamedSharding(mesh, PartitionSpec())


def by_object(mesh: Mesh) -> NamedSharding:
    """The sharding of arrays whose first axis are objects."""
    return NamedSharding(mesh, PartitionSpec(OBJECTS))


def own_objects(mesh: Mesh, batch_objects: int) -> range:
    """Places in the global batch of the objects on this process's devices; ValueError if they cannot be divided."""
    shards = mesh.shape[OBJECTS]
    if batch_objects % shards:
        raise ValueError(
            f"batch_objects {batch_objects} cannot be divided among {shards} devices; use a multiple, or show JAX "
            "fewer devices (CUDA_VISIBLE_DEVICES)"
        )
    places = by_object(mesh).addressable_devices_indices_map((batch_objects,)).values()
    starts, stops = zip(*(place[0].indices(batch_objects)[:2] for place in places if place), strict=True)
    return range(min(starts), max(stops))


def placed(own: Batch, mesh: Mesh | None, batch_objects: int) -> Batch:
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
        raise ValueError("the first process of this training stopped, and says why")


class Agreement:
    """Whether any process has asked for something: the same answer in each, one call late, so that none waits."""

    def __init__(self, mesh: Mesh | None) -> None:
        """Nobody has asked yet."""
        self._mesh = mesh
        self._said: jax.Array | None = None

    def __call__(self, asked: bool) -> bool:
        """Whether any process had asked at the call before; of a single process, whether it asks now."""
        if self._mesh is None or jax.process_count() == 1:
            return asked
        sharding = NamedSharding(self._mesh, PartitionSpec((OBJECTS, DEPTH)))
        own = np.full(jax.local_device_count(), asked)
        earlier, self._said = self._said, jnp.any(jax.make_array_from_process_local_data(sharding, own))
        return earlier is not None and bool(earlier)


def lost(error: jax.errors.JaxRuntimeError, run: object) -> Exception:
    """What to raise of an error of the runtime: of several processes, that another one is gone."""
    if jax.process_count() == 1:
        return error
    reason = str(error).partition("\n")[0][:160]
    return ValueError(
        f"{run}: another process of this training ended ({reason}); start all again, and they go on from the last "
        "checkpoint"
    )


def object_groups(count: int) -> int:
    """How many groups the mesh in use divides so many objects into; 1 without a mesh, or if it does not divide them."""
    groups = jax.sharding.get_abstract_mesh().shape.get(OBJECTS, 1)
    return 1 if count % groups else groups


def divide_depth(volume: jax.Array, coarsest: int) -> jax.Array:
    """Volumes (objects, d, d, d, features), divided along the first grid axis where the mesh in use says so.

    What is computed from them follows.  ValueError if the devices do not divide the `coarsest` grid: XLA gets gradients
    of strided convolutions wrong that do not come out even.
    """
    devices = jax.sharding.get_abstract_mesh().shape.get(DEPTH, 1)
    if coarsest % devices:
        raise ValueError(
            f"--depth-devices {devices}: expected a divisor of {coarsest}, the sides of the network's coarsest grid "
            "(volume_resolution / 2^num_stages)"
        )
    return _divided(volume) if devices > 1 else volume


def divide_rays(rays: Rays) -> Rays:
    """Rays (objects, rays, 3) divided among the devices that share their volume, if that comes out even."""
    devices = jax.sharding.get_abstract_mesh().shape.get(DEPTH, 1)
    return jax.tree.map(_divided, rays) if devices > 1 and rays.origins.shape[1] % devices == 0 else rays


def undivided(x: jax.Array) -> jax.Array:
    """An array (objects, ...) on every device that shares a volume, such as what rays brought."""
    if jax.sharding.get_abstract_mesh().shape.get(DEPTH, 1) == 1:
        return x
    return jax.lax.with_sharding_constraint(x, PartitionSpec(OBJECTS))


def _divided(x: jax.Array) -> jax.Array:
    return jax.lax.with_sharding_constraint(x, PartitionSpec(OBJECTS, DEPTH))
