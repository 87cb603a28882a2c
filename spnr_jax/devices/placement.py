"""Many devices: a mesh of all of them, over which the objects of a batch are divided.

The program is the one of a single device: placed inputs and the mesh in use are all that differs, and XLA adds the
communication.  Parameters and optimisers are on every device whole.  Where a program packs rays by what they meet
(`occupancy.map_existing`), each device packs those of its own objects (`split_objects`): XLA would let all of them
compute all.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from spnr_jax.errors import UserError

OBJECTS = "objects"


def device_mesh() -> Mesh | None:
    """All devices in one axis; None if there is one alone."""
    count = jax.device_count()
    return jax.make_mesh((count,), (OBJECTS,), axis_types=(AxisType.Auto,)) if count > 1 else None


def using(mesh: Mesh | None) -> AbstractContextManager:
    """The context in which jitted functions are called that compute on the mesh; nothing without one."""
    return nullcontext() if mesh is None else jax.set_mesh(mesh)


def sharding_of_all(mesh: Mesh) -> NamedSharding:
    """The sharding of what every device holds whole."""
    return NamedSharding(mesh, PartitionSpec())


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
    """What every device holds whole, as arrays of one device."""
    return jax.tree.map(lambda x: x.addressable_data(0), tree)


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
