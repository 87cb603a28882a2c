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
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.serialization import from_state_dict, to_state_dict
from jax import export
from jaxtyping import Array, Bool, Float

from spnr_jax.errors import UserError
from spnr_jax.formats.npz import packed
from spnr_jax.kernels.records import LARGEST_REACH, Camera, PointCloud, Volume
from spnr_jax.method import inference
from spnr_jax.method.model import Model, Quality
from spnr_jax.method.surfel_renderer import Plan
from spnr_jax.surfels import lighting
from spnr_jax.tools import surfel_export

Arrays = dict[str, Any]


def export_encode(model: Model, *, num_points: int = 1024, platforms: Sequence[str] | None = None) -> bytes:
    """The serialised function `cloud -> volume` for clouds of `num_points` points, padding included.

    `platforms` are those that may run it, out of cpu, cuda, rocm, tpu; None is the one that JAX uses here.
    """
    if num_points < 1:
        raise UserError(f"num_points must be at least 1, got {num_points}")
    if model.config.method == "surfels":
        return _serialised(
            partial(surfel_export.encode, model.params), platforms, surfel_export.cloud_shapes(num_points)
        )

    def encode(cloud: Arrays) -> Arrays:
        scene, centre, scale = _encode(model, cloud)
        return {"scene": to_state_dict(scene), "centre": centre, "scale": scale}

    return _serialised(encode, platforms, surfel_export.cloud_shapes(num_points))


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
    camera = {"cam_to_world": _floats(3, 4), "intrinsics": _floats(3, 3)}
    if model.config.method == "surfels":
        if quality == "balanced":
            raise UserError("balanced draws fewer pixels and enlarges them; export a smaller resolution")
        sizes = plan or surfel_export.make_plan(model, num_points, size)
        draw = partial(surfel_export.render, None if quality == "draft" else model.params, size=size, plan=sizes)
        made = jax.eval_shape(partial(surfel_export.encode, model.params), surfel_export.cloud_shapes(num_points))
        return _serialised(draw, platforms, made, camera, surfel_export.light_shapes())
    scene, centre, scale = jax.eval_shape(partial(_encode, model), surfel_export.cloud_shapes(num_points=2))

    def render(volume: Arrays, camera: Arrays) -> Arrays:
        encoded = Volume(**volume | {"scene": from_state_dict(scene, volume["scene"])}, reach=reach)
        drawn = model.render(encoded, Camera(**camera, height=size, width=size), quality)
        return {name: values for name, values in to_state_dict(drawn).items() if values is not None}

    volume = {"scene": to_state_dict(scene), "centre": centre, "scale": scale}
    return _serialised(render, platforms, volume, camera)


def room_light() -> bytes:
    """The package's room as the light that the `render` of the default network takes: an .npz of its tables."""
    return packed({"tables": np.asarray(lighting.room_light().tables)}, compressed=True)


def load_exported(content: bytes) -> Callable[..., Arrays]:
    """The function in the bytes of `export_encode` or `export_render`; it compiles at its first call."""
    return jax.jit(_deserialised(content).call)


def stablehlo(content: bytes) -> bytes:
    """The StableHLO module in exported bytes, as a portable artefact for other compilers than JAX's."""
    return _deserialised(content).mlir_module_serialized


def signature(content: bytes) -> dict[str, Any]:
    """Shapes and types of what an exported function takes (a list, for its arguments) and gives, and its platforms."""
    exported = _deserialised(content)
    (arguments, _), outputs = (
        jax.tree.map(_described, jax.tree.unflatten(tree, shapes))
        for tree, shapes in ((exported.in_tree, exported.in_avals), (exported.out_tree, exported.out_avals))
    )
    return {"inputs": list(arguments), "outputs": outputs, "platforms": list(exported.platforms)}


def box_around(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Centre and scale of `cloud_arrays.normalization` for the points that are not masked.

    In float32, so the scale may differ in its last bits from that of `Model.encode`, which is computed in float64.
    """
    low = jnp.min(jnp.where(mask[:, None], positions, jnp.inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], positions, -jnp.inf), axis=0)
    diagonal = jnp.sqrt(jnp.sum((high - low) ** 2))
    return (low + high) / 2, jnp.where(diagonal > 0, 2 / jnp.where(diagonal > 0, diagonal, 1), 1)


def _encode(model: Model, cloud: Arrays) -> tuple[Any, Array, Array]:
    """Scene, centre and scale that `Model.encode` keeps of a padded cloud, as a pure function."""
    centre, scale = box_around(cloud["positions"], cloud["mask"])
    inside = jnp.clip((cloud["positions"] - centre[None]) * scale, -1, 1)
    one_object = jax.tree.map(lambda x: x[None], PointCloud(**cloud | {"positions": inside}))
    scene = inference.encode(model.variables, one_object, config=model.config)
    return jax.tree.map(lambda x: x[0], scene), centre, scale


def _floats(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, np.float32)


def _described(array: jax.core.ShapedArray) -> dict[str, Any]:
    return {"shape": list(array.shape), "dtype": str(array.dtype)}


def _serialised(function: Callable[..., Arrays], platforms: Sequence[str] | None, *shapes: Arrays) -> bytes:
    return bytes(export.export(jax.jit(function), platforms=platforms)(*shapes).serialize())


def _deserialised(content: bytes) -> export.Exported:
    try:
        return export.deserialize(bytearray(content))
    except Exception as error:  # noqa: BLE001 - flatbuffers and JAX raise many kinds for bytes that are something else
        raise UserError(f"not a function that JAX exported ({type(error).__name__}); export it again") from None
