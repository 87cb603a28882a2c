"""The default network as functions of fixed sizes: `spnr_jax.encode` and `spnr_jax.render` over dicts of arrays.

    volume      the scene of `spnr_jax.encode`: surfels, spacing, centre, scale
    light       tables (7, 32, 64, 3): those of `Light`, linear in the light, so sums and multiples are lights
    picture     image (h, w, 3) sRGB on white; depth, acc (h, w); overflow (): above 0 the plan was too small

Sizes are fixed when it is exported: the number of points, padding included, and the plan of the picture.  The neighbors
are found in the exported function, by all distances, a block of points at a time.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.serialization import to_state_dict
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.config import Quality
from spnr_jax.errors import UserError
from spnr_jax.kernels.cloud_arrays import plain_cloud
from spnr_jax.kernels.records import AnyArray, Camera, Light, PointCloud, Surfels, SurfelScene
from spnr_jax.method import surfel_method, surfel_renderer
from spnr_jax.method.model import Model
from spnr_jax.method.surfel_renderer import Plan
from spnr_jax.surfels import geometry, lighting
from spnr_jax.surfels.layers import NEIGHBORS
from spnr_jax.surfels.sides import spiral

RADIUS = 0.8  # of the ball in the box whose pictures the sizes are those of: as much surface as a cube has
BLOCK = 256  # points whose distances to all are in memory at once

Arrays = dict[str, Any]


def export_encode(model: Model, *, num_points: int) -> tuple[Callable[..., Arrays], tuple[Arrays, ...]]:
    """The function `cloud -> volume`, and what it takes."""
    return partial(encode, model.params), (cloud_shapes(num_points),)


def export_render(
    model: Model, *, num_points: int, size: int, quality: Quality, reach: int, plan: Plan | None
) -> tuple[Callable[..., Arrays], tuple[Arrays, ...]]:
    """The function `(volume, camera, light) -> picture`, and what it takes."""
    del reach
    if quality == "balanced":
        raise UserError("balanced draws fewer pixels and enlarges them; export a smaller resolution")
    sizes = plan or make_plan(model, num_points, size)
    draw = partial(render, None if quality == "draft" else model.params, size=size, plan=sizes)
    volume = jax.eval_shape(partial(encode, model.params), cloud_shapes(num_points))
    return draw, (volume, camera_shapes(), light_shapes())


def encode(params: dict, cloud: Arrays) -> Arrays:
    """The scene of a cloud as a dict of arrays; pure."""
    points = PointCloud(**cloud)
    near = nearest(points.positions, points.mask)
    return dict(to_state_dict(geometry.encode(params, points, near)))


def render(params: dict | None, volume: Arrays, camera: Arrays, light: Arrays, *, size: int, plan: Plan) -> Arrays:
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
    scene = surfel_method.encode_in_box(ball)
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


def camera_shapes() -> Arrays:
    """What `render` takes as its camera."""
    sizes = {"cam_to_world": (3, 4), "intrinsics": (3, 3)}
    return {name: jax.ShapeDtypeStruct(shape, np.float32) for name, shape in sizes.items()}
