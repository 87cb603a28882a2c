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

Of the default network (`encode_surfels`, `render_surfels`):

    volume      the scene of `spnr_jax.encode`: surfels, spacing, centre, scale
    light       tables (7, 32, 64, 3): those of `Light`, linear in the light, so sums and multiples are lights
    picture     image (h, w, 3) sRGB on white; depth, acc (h, w); overflow (): above 0 the plan was too small

The neighbors are found in the exported function, by all distances, a block of points at a time.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.serialization import from_state_dict, to_state_dict
from jax import export
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.errors import UserError
from spnr_jax.formats.npz import packed
from spnr_jax.kernels.cloud_arrays import plain_cloud
from spnr_jax.kernels.records import LARGEST_REACH, AnyArray, Camera, Light, PointCloud, Surfels, SurfelScene, Volume
from spnr_jax.method import inference, surfel_renderer
from spnr_jax.method.model import Model, Quality
from spnr_jax.method.surfel_renderer import Plan
from spnr_jax.surfels import lighting, surfel_scenes
from spnr_jax.surfels.rules import NEIGHBORS
from spnr_jax.surfels.visibility import spiral

RADIUS = 0.8  # of the ball in the box whose pictures the sizes are those of: as much surface as a cube has
BLOCK = 256  # points whose distances to all are in memory at once

Arrays = dict[str, Any]


def encode_surfels(params: dict, cloud: Arrays) -> Arrays:
    """The scene of a cloud as a dict of arrays; pure."""
    points = PointCloud(**cloud)
    near = nearest(points.positions, points.mask)
    return dict(to_state_dict(surfel_scenes.encode(params, points, near)))


def render_surfels(
    params: dict | None, volume: Arrays, camera: Arrays, light: Arrays, *, size: int, plan: Plan
) -> Arrays:
    """The picture of a scene as a dict of arrays; pure."""
    scene = SurfelScene(**volume | {"surfels": Surfels(**volume["surfels"])})
    seen = Camera(**camera, height=size, width=size)
    drawn = surfel_renderer.render(params, scene, seen, Light(**light), plan=plan)
    return {name: getattr(drawn, name) for name in ("image", "depth", "acc", "overflow")}


def nearest(positions: Float[AnyArray, "points 3"], mask: Bool[AnyArray, " points"]) -> Int[Array, "points 20"]:
    """`spnr_jax.neighbors` in JAX: the nearest points of each, itself first, -1 for none, by all distances."""
    positions, mask = jnp.asarray(positions), jnp.asarray(mask)
    numbers = jnp.arange(len(mask))
    count = min(NEIGHBORS, len(mask))

    def of_one(number: Int[Array, ""]) -> Int[Array, " count"]:
        apart = jnp.sum((positions - positions[number][None]) ** 2, axis=-1)
        apart = jnp.where(mask, apart, jnp.inf).at[number].set(-1.0)
        least, found = jax.lax.top_k(-apart, count)
        return jnp.where(jnp.isfinite(least) & mask[number], found, -1).astype(jnp.int32)

    found = jax.lax.map(of_one, numbers, batch_size=min(BLOCK, len(mask)))
    return jnp.pad(found, ((0, 0), (0, NEIGHBORS - count)), constant_values=-1)


def make_plan(model: Model, num_points: int, size: int) -> Plan:
    """Sizes for pictures of any object of so many points from where `Model.camera` stands: with room to spare."""
    ball = plain_cloud(np.asarray(RADIUS * spiral(num_points), np.float32))
    scene = surfel_scenes.encode_in_box(ball)
    made = surfel_renderer.plan(scene, model.camera(scene, resolution=size))
    side = surfel_renderer.round_up(-(-size * made.side // 2**made.doublings) + surfel_renderer.MARGIN)
    return made._replace(width=side, height=side, entries=2 * made.entries, slots=side * side)


def cloud_shapes(num_points: int) -> Arrays:
    """What `encode` takes."""
    vectors, scalars = (jax.ShapeDtypeStruct((num_points, *axes), np.float32) for axes in ((3,), ()))
    mask = jax.ShapeDtypeStruct((num_points,), np.bool_)
    return {"positions": vectors, "base_color": vectors, "roughness": scalars, "metallic": scalars, "mask": mask}


def light_shapes() -> Arrays:
    """What `render` takes as its light."""
    return {"tables": jax.ShapeDtypeStruct((7, lighting.HEIGHT, lighting.WIDTH, 3), np.float32)}


def export_encode(model: Model, *, num_points: int = 1024, platforms: Sequence[str] | None = None) -> bytes:
    """The serialised function `cloud -> volume` for clouds of `num_points` points, padding included.

    `platforms` are those that may run it, out of cpu, cuda, rocm, tpu; None is the one that JAX uses here.
    """
    if num_points < 1:
        raise UserError(f"num_points must be at least 1, got {num_points}")
    if model.config.method == "surfels":
        return _serialised(partial(encode_surfels, model.params), platforms, cloud_shapes(num_points))

    def encode(cloud: Arrays) -> Arrays:
        scene, centre, scale = _encode(model, cloud)
        return {"scene": to_state_dict(scene), "centre": centre, "scale": scale}

    return _serialised(encode, platforms, cloud_shapes(num_points))


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
        sizes = plan or make_plan(model, num_points, size)
        draw = partial(render_surfels, None if quality == "draft" else model.params, size=size, plan=sizes)
        made = jax.eval_shape(partial(encode_surfels, model.params), cloud_shapes(num_points))
        return _serialised(draw, platforms, made, camera, light_shapes())
    scene, centre, scale = jax.eval_shape(partial(_encode, model), cloud_shapes(num_points=2))

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
