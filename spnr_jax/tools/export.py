"""A trained network as bytes that need JAX alone: `encode` and `render` as serialised StableHLO, weights included.

    encode, render = (load_exported(content) for content in (export_encode(model), export_render(model)))
    picture = render(encode(cloud), camera, light)  # without the light of a ray-marching network

Inputs and outputs are dicts of arrays, so no class of this package is needed where they are used; there
`jax.export.deserialize(content).call` does what `load_exported` does.  All sizes are fixed, those of one bucket:

    cloud       positions (points, 3) in any unit, y up; base_color (points, 3) linear; roughness, metallic (points,);
                mask (points,) bool, False for padding.  At least one point is real, and all real ones are finite
    volume      what the network makes of a cloud, to be passed on: scene, and the box around it, centre (3,), scale ()
    camera      cam_to_world (3, 4) in the cloud's frame and unit, OpenGL axes; intrinsics (3, 3) in pixels
    picture     image (h, w, 3) sRGB on white; image_lr, depth, acc at the size of the volume rendering

What differs for the default network, over surfels, stands in `surfel_export.py`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax import export

from spnr_jax.config import Quality
from spnr_jax.errors import UserError
from spnr_jax.formats.npz import pack_arrays
from spnr_jax.kernels.records import LARGEST_REACH
from spnr_jax.method.model import Model
from spnr_jax.method.surfel_renderer import Plan
from spnr_jax.methods import method_of
from spnr_jax.surfels import lighting

Arrays = dict[str, Any]


def export_encode(model: Model, *, num_points: int = 1024, platforms: Sequence[str] | None = None) -> bytes:
    """The serialised function `cloud -> volume` for clouds of `num_points` points, padding included.

    `platforms` are those that may run it, out of cpu, cuda, rocm, tpu; None is the one that JAX uses here.
    """
    if num_points < 1:
        raise UserError(f"num_points must be at least 1, got {num_points}")
    encode, shapes = method_of(model.config).export_encode(model, num_points=num_points)
    return _serialise(encode, platforms, *shapes)


def export_render(
    model: Model,
    *,
    resolution: int | None = None,
    quality: Quality = "best",
    reach: int = LARGEST_REACH,
    num_points: int = 1024,
    plan: Plan | None = None,
    platforms: Sequence[str] | None = None,
) -> bytes:
    """The serialised function `(volume, camera) -> picture` for square pictures, by default of the network's size.

    Of the default network `(volume, camera, light) -> picture`, for scenes of `num_points` points and with a plan's
    sizes: by default those of a ball of so many points, with room to spare.  The others:

    `reach` is how far from points it looks, in voxels: `Model.encode` finds `volume.reach` from how densely the points
    lie, here it is fixed; less is quicker, and too little leaves holes.  `platforms` as for `export_encode`.
    """
    size = model.config.image_resolution if resolution is None else resolution
    if size < 16 or size % 4:
        raise UserError(f"resolution must be a multiple of 4 of at least 16, got {size}")
    if not 1 <= reach <= LARGEST_REACH:
        raise UserError(f"reach must be 1 to {LARGEST_REACH} voxels, got {reach}")
    make = method_of(model.config).export_render
    render, shapes = make(model, num_points=num_points, size=size, quality=quality, reach=reach, plan=plan)
    return _serialise(render, platforms, *shapes)


def room_light() -> bytes:
    """The package's room as the light that the `render` of the default network takes: an .npz of its tables."""
    return pack_arrays({"tables": np.asarray(lighting.room_light().tables)}, compressed=True)


def load_exported(content: bytes) -> Callable[..., Arrays]:
    """The function in the bytes of `export_encode` or `export_render`; it compiles at its first call."""
    return jax.jit(_deserialise(content).call)


def stablehlo(content: bytes) -> bytes:
    """The StableHLO module in exported bytes, as a portable artefact for other compilers than JAX's."""
    return _deserialise(content).mlir_module_serialized


def signature(content: bytes) -> dict[str, Any]:
    """Shapes and types of what an exported function takes (a list, for its arguments) and gives, and its platforms."""
    exported = _deserialise(content)
    (arguments, _), outputs = (
        jax.tree.map(_describe, jax.tree.unflatten(tree, shapes))
        for tree, shapes in ((exported.in_tree, exported.in_avals), (exported.out_tree, exported.out_avals))
    )
    return {"inputs": list(arguments), "outputs": outputs, "platforms": list(exported.platforms)}


def _describe(array: jax.core.ShapedArray) -> dict[str, Any]:
    return {"shape": list(array.shape), "dtype": str(array.dtype)}


def _serialise(function: Callable[..., Arrays], platforms: Sequence[str] | None, *shapes: Arrays) -> bytes:
    return bytes(export.export(jax.jit(function), platforms=platforms)(*shapes).serialize())


def _deserialise(content: bytes) -> export.Exported:
    try:
        return export.deserialize(bytearray(content))
    except Exception as error:  # noqa: BLE001 - flatbuffers and JAX raise many kinds for bytes that are something else
        raise UserError(f"not a function that JAX exported ({type(error).__name__}); export it again") from None
