"""The surfel method for `Model`, evaluation and the viewer: `surfel_renderer`, compiled.

Several views share array sizes.  A picture is drawn by two programs: the first is compiled anew for each number of
entries and pixels; the second, which XLA compiles slowly, only for each window size.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from spnr_jax.config import SurfelConfig
from spnr_jax.devices.programs import CachedProgram
from spnr_jax.devices.runtime import QUICK, QUICKEST, two_at_a_time
from spnr_jax.kernels import cameras, cloud_arrays
from spnr_jax.kernels.cloud_arrays import SMALLEST_BUCKET
from spnr_jax.kernels.imaging import enlarge
from spnr_jax.kernels.records import Camera, Key, Light, PointCloud, Rendering, SurfelScene
from spnr_jax.method import densifier, surfel_renderer
from spnr_jax.method.checks import check_camera, check_scene
from spnr_jax.method.surfel_renderer import Sizes, make_scene
from spnr_jax.nn import shader
from spnr_jax.nn.shader import Shader
from spnr_jax.surfels import symmetry
from spnr_jax.surfels.lighting import room_light
from spnr_jax.surfels.neighbors import neighbors, order_in_space

BALANCED = 0.75  # of the pixels along a side are drawn, then enlarged: docs/lab/performance.md


class PlannedView(NamedTuple):
    """A view with its light: the camera that is drawn (smaller for `balanced`), its resolution and sizes."""

    camera: Camera
    light: Light
    resolution: tuple[int, int]  # doublings and side of its plan
    sizes: Sizes


def init(key: Key, config: SurfelConfig) -> dict:
    """Fresh variables of the shader network."""
    side = 2 ** len(config.widths)
    return dict(Shader(config.widths, config.top).init(key, jnp.zeros((1, side, side, shader.NUM_FEATURES)), 1))


def encode_object(
    variables: dict, cloud: PointCloud, centre: np.ndarray, scale: np.floating, *, config: SurfelConfig
) -> SurfelScene:
    """Scene of a cloud in the box (unbatched); sparse clouds get learned points."""
    scene = encode_in_box(densify_sparse(variables, cloud))
    return dataclasses.replace(scene, centre=jnp.asarray(centre), scale=jnp.asarray(scale))


def encode_in_box(cloud: PointCloud, least: int = SMALLEST_BUCKET) -> SurfelScene:
    """Scene of a cloud in the box (unbatched), with centre 0 and scale 1; on the host, compiled once per padded size.

    The surfels are those of the unmasked points, sorted so that close points are close in memory, and padded, to
    `least` or more.
    """
    real = cloud_arrays.strip(cloud)
    real = jax.tree.map(lambda x: np.asarray(x, np.float32), real).replace(mask=real.mask)
    order, near = order_in_space(real.positions, real.normals)
    size = cloud_arrays.bucket(len(order), least)
    near = np.pad(near, [(0, size - len(order)), (0, 0)], constant_values=-1)
    return _encode(cloud_arrays.pad(jax.tree.map(lambda x: x[order], real), size), near)


def densify_sparse(variables: dict, cloud: PointCloud, least: int = SMALLEST_BUCKET) -> PointCloud:
    """A sparse cloud in the box (unbatched) with reflected and learned points, if the variables include a densifier.

    Compiled once per padded size, which is `least` or more.
    """
    count = int(np.sum(cloud.mask))
    if "densifier" not in variables or count > densifier.MOST_POINTS or cloud.learned is not None:
        return cloud
    real = symmetry.complete(cloud_arrays.strip(cloud))
    padded = cloud_arrays.pad(real, cloud_arrays.bucket(len(real.mask), least))
    return cloud_arrays.strip(_densify(variables["densifier"], padded, neighbors(padded)))


def render_each(
    variables: dict,
    scene: SurfelScene,
    views: Sequence[Camera],
    lights: Sequence[Light | None],
    *,
    config: SurfelConfig,
    quality: str,
) -> Iterator[Rendering]:
    """Views one after the other; all use the sizes of the largest one, so that few programs are compiled."""
    check_scene(scene, "render")
    weights, render_scale = (None if quality == "draft" else variables), (BALANCED if quality == "balanced" else 1.0)
    planned = [plan_view(scene, view, light, render_scale) for view, light in zip(views, lights, strict=True)]
    plans = {
        of: surfel_renderer.make_plan(*of, (view.sizes for view in planned if view.resolution == of))
        for of in {view.resolution for view in planned}
    }

    def draw(view: PlannedView, whole: Camera) -> Rendering:
        if view.sizes.entries:
            plan = plans[view.resolution]
            window_buffer = _rasterize(scene, view.camera, view.light, plan=plan)
            drawn = _shade(weights, scene, view.camera, view.light, window_buffer, plan=plan)
        else:
            drawn = _leave_empty(scene, view.camera)
        return drawn if render_scale == 1 else _enlarge(drawn, whole.height, whole.width)

    yield from two_at_a_time(lambda both: draw(*both), zip(planned, views, strict=True))


def plan_view(scene: SurfelScene, camera: Camera, light: Light | None, render_scale: float) -> PlannedView:
    """A view prepared for drawing, with this share of its pixels along a side, and the sizes that it needs."""
    check_camera(camera, "render")
    if render_scale != 1:
        camera = cameras.resize(
            camera, *(max(round(render_scale * n / 4) * 4, 4) for n in (camera.height, camera.width))
        )
    doublings, side = surfel_renderer.choose_resolution(scene, camera, render_scale)
    sizes = jax.device_get(surfel_renderer.count_sizes(scene, camera, doublings=doublings, side=side))
    return PlannedView(camera, light or room_light(), (doublings, side), sizes)


@partial(CachedProgram, options=QUICKEST)
def _encode(cloud: PointCloud, neighbors: Int[Array, "points 20"]) -> SurfelScene:
    return make_scene(cloud, neighbors, jnp.zeros(3), jnp.ones(()))


_densify = CachedProgram(densifier.densify_in_box, options=QUICKEST)
_rasterize = CachedProgram(surfel_renderer.rasterize_window)
_shade = CachedProgram(surfel_renderer.shade_window, options=QUICKEST)
_enlarge = jax.jit(enlarge, static_argnums=(1, 2), compiler_options=QUICK)


@jax.jit
def _leave_empty(scene: SurfelScene, camera: Camera) -> Rendering:
    """An empty view: the object is not visible.  Compiling the network for an empty window would take long."""
    inside = cameras.move_into_box(camera, scene.centre, scene.scale)
    nothing = jnp.zeros((1, 1, 5)), jnp.zeros(2, jnp.int32)
    image, depth, acc = surfel_renderer.paste_window(*nothing, inside, 1, 0)
    overflow = jnp.zeros((), jnp.int32)
    return Rendering(image=image, depth=depth / scene.scale, acc=acc, overflow=overflow)
