"""Many devices, many hosts: a mesh of their devices, and what lies where on it.

    objects   the axis of the mesh over which the objects of a batch are divided: each device renders its own
    depth     the axis over which the rays of an object are divided; in training also the first grid axis (z) of its
              volume, for volumes too big for one device

The program is the one of a single device: placed inputs and the mesh in use are all that differs, and XLA adds the
communication.  Parameters and optimisers are on every device whole.  Where a program packs rays by what they meet
(`occupancy.map_existing`), each device packs its own (`on_own_rays`): XLA would let all of them compute all.
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

OBJECTS, DEPTH = "objects", "depth"


def device_mesh(depth: int = 1) -> Mesh:
    """All devices of all processes, `depth` of them to each volume; ValueError if these do not divide their number."""
    count = jax.device_count()
    if depth < 1 or count % depth:
        raise UserError(f"--depth-devices {depth}: expected a divisor of the {count} devices")
    return jax.make_mesh((count // depth, depth), (OBJECTS, DEPTH), axis_types=(AxisType.Auto,) * 2)


def rendering_mesh() -> Mesh | None:
    """The devices of this process, all of them to each object; None if there is one alone."""
    devices = jax.local_devices()
    if len(devices) == 1:
        return None
    return jax.make_mesh((1, len(devices)), (OBJECTS, DEPTH), axis_types=(AxisType.Auto,) * 2, devices=devices)


def everywhere(tree: Any) -> Any:
    """The arrays on every device of this process whole; as they are if there is one alone."""
    mesh = rendering_mesh()
    return tree if mesh is None else jax.device_put(tree, replicated(mesh))


def by_all_devices(render: Callable[..., Any], *arguments: Any) -> Any:
    """What a jitted `render` makes of the arguments, its rays divided among this process's devices; on the first."""
    mesh = rendering_mesh()
    if mesh is None:
        return render(*arguments)
    with using(mesh):
        return jax.device_put(render(*everywhere(arguments)), mesh.devices.flat[0])


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
        raise UserError(
            f"batch_objects {batch_objects} cannot be divided among {shards} devices; use a multiple, or show JAX "
            "fewer devices (CUDA_VISIBLE_DEVICES)"
        )
    places = by_object(mesh).addressable_devices_indices_map((batch_objects,)).values()
    starts, stops = zip(*(place[0].indices(batch_objects)[:2] for place in places if place), strict=True)
    return range(min(starts), max(stops))


def placed(own: Any, mesh: Mesh | None, batch_objects: int) -> Any:
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
        sharding = NamedSharding(self._mesh, PartitionSpec((OBJECTS, DEPTH)))
        own = np.full(jax.local_device_count(), asked)
        earlier, self._said = self._said, jnp.any(jax.make_array_from_process_local_data(sharding, own))
        return earlier is not None and bool(earlier)


def lost(error: jax.errors.JaxRuntimeError, run: object) -> Exception:
    """What to raise of an error of the runtime: of several processes, that another one is gone."""
    if jax.process_count() == 1:
        return error
    return ValueError(
        f"{run}: another process of this training ended ({first_line(error)}); start all again, and they go on from "
        "the last checkpoint"
    )


def object_groups(count: int) -> int:
    """How many groups the mesh in use divides so many objects into; 1 without a mesh, or if it does not divide them."""
    groups = _devices(OBJECTS)
    return 1 if count % groups else groups


def on_own_rays(function: Callable[..., Any], whole: Any, scenes: Any, rays: Any) -> Any:
    """`function(whole, scenes, rays)`, in which each device of the mesh in use has its own objects and rays alone.

    Arrays of `scenes` have objects first, those of `rays` and of what is returned objects and rays; `whole` is what all
    share.  Rays are assigned to the devices round-robin, which balances the load: neighbours cost about the same.
    """
    (objects, count), devices = jax.tree.leaves(rays)[0].shape[:2], _devices(DEPTH)
    if _devices(OBJECTS) * devices == 1 or objects % _devices(OBJECTS):  # a network is initialised with one object
        return function(whole, scenes, rays)

    def dealt(x: jax.Array) -> jax.Array:
        x = jnp.pad(x, ((0, 0), (0, -count % devices), *[(0, 0)] * (x.ndim - 2)), mode="edge")
        return x.reshape(x.shape[0], -1, devices, *x.shape[2:])

    def collected(x: jax.Array) -> jax.Array:
        return x.reshape(x.shape[0], -1, *x.shape[3:])[:, :count]

    def own(whole: Any, scenes: Any, hand: Any) -> Any:
        return jax.tree.map(lambda x: x[:, :, None], function(whole, scenes, jax.tree.map(lambda x: x[:, :, 0], hand)))

    of_objects, of_rays = PartitionSpec(OBJECTS), PartitionSpec(OBJECTS, None, DEPTH)
    # unchecked: a scan that starts from a constant is refused, although all results differ by device
    divided = jax.shard_map(own, in_specs=(PartitionSpec(), of_objects, of_rays), out_specs=of_rays, check_vma=False)
    return jax.tree.map(collected, divided(whole, scenes, jax.tree.map(dealt, rays)))


def divide_depth(volume: jax.Array, coarsest: int) -> jax.Array:
    """Volumes (objects, d, d, d, features), divided along the first grid axis where the mesh in use says so.

    What is computed from them follows.  ValueError if the devices do not divide the `coarsest` grid: XLA gets gradients
    of strided convolutions wrong that do not come out even.
    """
    devices = _devices(DEPTH)
    if coarsest % devices:
        raise UserError(
            f"--depth-devices {devices}: expected a divisor of {coarsest}, the sides of the network's coarsest grid "
            "(volume_resolution / 2^num_stages)"
        )
    return _divided(volume) if devices > 1 else volume


def divide_pixels(x: Any) -> Any:
    """Rays (objects, rays, ...) or images (objects, rows, ...) divided among the devices that share an object.

    They stay whole if that does not come out even.
    """
    devices, (first, *_) = _devices(DEPTH), jax.tree.leaves(x)
    return jax.tree.map(_divided, x) if devices > 1 and first.shape[1] % devices == 0 else x


def undivided(x: jax.Array) -> jax.Array:
    """An array (objects, ...) on every device that shares a volume, such as what rays brought."""
    if _devices(DEPTH) == 1:
        return x
    return jax.lax.with_sharding_constraint(x, PartitionSpec(OBJECTS))


def _devices(axis: str) -> int:
    """Devices along an axis of the mesh in use; 1 without one, and where each has its own already."""
    mesh = jax.sharding.get_abstract_mesh()
    return mesh.shape[axis] if axis in mesh.auto_axes else 1


def _divided(x: jax.Array) -> jax.Array:
    return jax.lax.with_sharding_constraint(x, PartitionSpec(OBJECTS, DEPTH))
