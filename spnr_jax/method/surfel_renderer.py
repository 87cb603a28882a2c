"""Our method on one page: points -> surfels -> G-buffer -> shader network -> materials in light -> picture.

    encode   neighbors, layers, sides, visibility by direction (surfels/)     once per object; pure
    plan     static array sizes of a picture, counted on the host             once per view, or for many views
    render   discs splatted to a G-buffer, a CNN over it, light               once per view; pure

The G-buffer has the resolution at which points lie FINEST to COARSEST pixels apart; the network doubles it from there.
So the work depends on the number of points and of covered pixels.  Only a window around the object is drawn: its
position is traced, its size is part of the plan.  Sizes are rounded up to a few values, because each new size is
compiled once.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.devices.programs import CachedProgram
from spnr_jax.errors import UserError, check_kind
from spnr_jax.kernels import cameras, cloud_arrays
from spnr_jax.kernels.imaging import WHITE, average_pool, double_size
from spnr_jax.kernels.numerics import clamp, larger, largest, length, smallest
from spnr_jax.kernels.records import (
    AnyArray,
    Camera,
    GBuffer,
    Light,
    PointCloud,
    Rendering,
    Surfels,
    SurfelScene,
    register,
    unstack,
)
from spnr_jax.method.checks import check_camera, check_neighbors, check_scene, check_view
from spnr_jax.nn import shader
from spnr_jax.nn.shader import NUM_OUTPUTS, Shader, ShaderInputs, compose_picture
from spnr_jax.surfels import blending, lighting, splatting
from spnr_jax.surfels.geometry import estimate_surfels
from spnr_jax.surfels.neighbors import median
from spnr_jax.surfels.splatting import MOST_ENTRIES, Footprints

# With the spacing p of the points in pixels: the fewest doublings n for which p / 2^n < COARSEST; a G-buffer of twice
# the picture's resolution, averaged, if p < FINEST
COARSEST, FINEST = 3.5, 0.8
SMALL, FINEST_OF_SMALL = 128, 1.6  # pixels along a side up to which a picture is small, and its FINEST
MOST_DOUBLINGS = 4
NEAREST = 0.5  # distance, in units of the box, at which an eye inside the object sees its points
STEP, MARGIN = 32, 8  # pixels: a window's size is a multiple of STEP; MARGIN around the object
BEYOND = 16  # pixels around the picture in which discs are drawn as well: the network sees what its border cuts
GRID = 16  # a window's corner is a multiple: the network's pooling grid is the same from every camera
LEAST_ENTRIES, LEAST_SLOTS = 2**15, 2**11  # that a plan holds


class Plan(NamedTuple):
    """Static sizes of a picture: hashable, made by `plan` or by hand.

    doublings: how often the network doubles the G-buffer's resolution.  side: 1, or 2 for supersampling: a pixel
    averages side x side drawn ones.  width, height: the window, in pixels of the G-buffer; of an object that fills the
    picture, 2 BEYOND more than the picture has.  entries, slots: capacities for pairs of disc and pixel, and for
    covered pixels.
    """

    doublings: int
    side: int
    width: int
    height: int
    entries: int
    slots: int


class Sizes(NamedTuple):
    """What one view needs: the window in pixels, pairs of disc and pixel, and covered pixels."""

    width: Int[AnyArray, ""]
    height: Int[AnyArray, ""]
    entries: Int[AnyArray, ""]
    slots: Int[AnyArray, ""]


register(Plan)
register(Sizes)


# --- scenes -----------------------------------------------------------------------------------------------------------


def encode(params: Any, cloud: PointCloud, neighbors: Int[AnyArray, "points 20"]) -> SurfelScene:
    """The surfels of a cloud (unbatched, any units, y up); pure: jit, vmap over equally padded clouds, grad, float64.

    `neighbors` are `spnr_jax.neighbors(cloud)`.  Positions, normals and colors must be finite, also in
    padding.  Surfels do not use `params`; the argument is there for networks that encode.  The result has the same
    structure with and without normals.  Gradients also flow through the normalisation: a shift of all points moves the
    scene's centre.  The docstring of `surfels/geometry.py` lists what has no gradient.
    """
    del params
    check_neighbors(cloud, neighbors, "encode")
    # a cloud that a jitted function closes over is constant: XLA would take seconds to sort it while compiling
    cloud, neighbors = jax.lax.optimization_barrier((cloud, neighbors))
    inside, centre, scale = normalise_cloud(cloud)
    return make_scene(inside, neighbors, centre, scale)


def normalise_cloud(cloud: PointCloud) -> tuple[PointCloud, Float[Array, "3"], Float[Array, ""]]:
    """The cloud normalised to the box [-1, 1]^3, in at least float32, and the centre and scale of this transform."""

    def promote(values: AnyArray) -> Array:
        values = jnp.asarray(values)
        return values if values.dtype == jnp.bool_ else values.astype(jnp.promote_types(values.dtype, jnp.float32))

    cloud = jax.tree.map(promote, cloud)
    positions = jnp.asarray(cloud.positions)
    centre, scale = fit_box(positions, jnp.asarray(cloud.mask))
    inside = clamp((positions - centre[None]) * scale, -1, 1)
    return dataclasses.replace(cloud, positions=inside), centre, scale


def fit_box(
    positions: Float[AnyArray, "points 3"], mask: Bool[AnyArray, " points"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Centre and scale: (positions - centre) * scale has its bounding box around 0, with half diagonal 1.

    The scale of points without extent is 1.  Masked points do not count.
    """
    some = jnp.any(mask)
    low = smallest(jnp.where(mask[:, None], positions, jnp.inf))
    high = largest(jnp.where(mask[:, None], positions, -jnp.inf))
    low, high = jnp.where(some, low, 0), jnp.where(some, high, 0)
    diagonal = length(high - low)
    scale = jnp.where(diagonal > 0, 2 / jnp.where(diagonal > 0, diagonal, 1), 1)
    return low / 2 + high / 2, scale


def make_scene(
    cloud: PointCloud,
    neighbors: Int[AnyArray, "points 20"],
    centre: Array,
    scale: Array,
) -> SurfelScene:
    """The scene of a cloud that is already in the box; centre and scale are those of its transform."""
    surfels = estimate_surfels(cloud, jnp.asarray(neighbors))
    spacing = median(jnp.asarray(surfels.spacing), jnp.asarray(surfels.mask))
    return SurfelScene(surfels=surfels, spacing=spacing, centre=centre, scale=scale)


# --- sizes ------------------------------------------------------------------------------------------------------------


def plan(scene: SurfelScene, camera: Camera) -> Plan:
    """Sizes that suffice for every view of a camera or a batch of cameras, and one scene or a stack of scenes.

    Runs on the host, because array sizes cannot be traced.  For a stack of scenes with axes (*scenes),
    cameras have the axes (*scenes, *views), or none: one camera for all.  ValueError if a picture needs more entries
    than can be sorted.
    """
    check_scene(scene, "plan")
    cloud_arrays.refuse_tracers(scene, "plan")
    check_camera(camera, "plan")
    batch, objects = np.shape(camera.cam_to_world)[:-2], np.shape(scene.spacing)
    if batch and batch[: len(objects)] != objects:
        raise UserError(f"scenes of axes {objects} need cameras of the same leading axes, or of none; got {batch}")
    batch = batch or objects
    with jax.ensure_compile_time_eval():  # arrays that a traced function closes over have values, too
        camera = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape[-2:])).reshape(-1, *x.shape[-2:]), camera)
        each = int(np.prod(batch[len(objects) :], dtype=int))
        scenes = unstack(jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(objects) :]), scene))
        pairs = [(scenes[i // each], view) for i, view in enumerate(unstack(camera))]
        doublings, side = min((choose_resolution(*pair) for pair in pairs), key=lambda of: (of[0], -of[1]))  # finest
        counted = [count_sizes(*pair, doublings=doublings, side=side) for pair in pairs]
        return make_plan(doublings, side, jax.device_get(counted))


def choose_resolution(scene: SurfelScene, camera: Camera, render_scale: float = 1.0) -> tuple[int, int]:
    """`doublings` and `side` of a plan, by the scene's spacing in pixels at its centre, not nearer than NEAREST.

    `render_scale` is the share of the pixels along a side of a picture that the camera draws; the picture as a whole
    determines the resolution.
    """
    eye = np.asarray(camera.cam_to_world, np.float64)[:, 3]
    distance = float(np.linalg.norm((eye - np.asarray(scene.centre)) * np.asarray(scene.scale)))
    pixels = float(scene.spacing) * float(np.asarray(camera.intrinsics)[0, 0]) / render_scale / max(distance, NEAREST)
    doublings = int(np.clip(np.floor(np.log2(max(pixels / COARSEST, 1e-9))) + 1, 0, MOST_DOUBLINGS))
    finest = FINEST_OF_SMALL if max(camera.height, camera.width) / render_scale <= SMALL else FINEST
    return doublings, 2 if pixels < finest else 1


@CachedProgram
def count_sizes(scene: SurfelScene, camera: Camera, *, doublings: int, side: int) -> Sizes:
    """What a view needs; the covered pixels are bounded by the rectangles around the discs."""
    wide = widen_camera(scene, camera, doublings, side)
    foot = splatting.project_discs(scene.surfels, wide)
    _, width, height = place_window(foot)
    slots = splatting.bound_covered_pixels(foot, wide)
    return Sizes(width, height, splatting.count_entries(foot.covered), slots)


def make_plan(doublings: int, side: int, counted: Iterable[Sizes]) -> Plan:
    """The plan that holds each of several views of one resolution.

    Numbers of entries and slots are rounded up to powers of the root of two, so that few programs are compiled.
    """
    width, height, entries, slots = (max(map(int, sizes)) for sizes in zip(*counted, strict=True))
    entries, slots = _round_count(entries, LEAST_ENTRIES), min(_round_count(slots, LEAST_SLOTS), width * height)
    return Plan(doublings, side, width, height, entries, slots)


def _round_count(count: int, least: int) -> int:
    if count > (most := MOST_ENTRIES):
        raise UserError(f"the picture needs {count} entries of discs, at most {most} are drawn; ask for a smaller one")
    return min(int(2 ** (np.ceil(2 * np.log2(max(count, least))) / 2)), most)


def widen_camera(scene: SurfelScene, camera: Camera, doublings: int, side: int) -> Camera:
    """The camera in the box at the G-buffer's resolution, BEYOND pixels wider on each side.

    The doubled picture may exceed the image: it is cropped.
    """
    height, width = (-(-n * side // 2**doublings) for n in (camera.height, camera.width))
    scale = jnp.array([[side / 2**doublings], [side / 2**doublings], [1.0]], jnp.float32)
    inside = cameras.move_into_box(camera, scene.centre, scene.scale)
    whole = dataclasses.replace(inside, intrinsics=camera.intrinsics * scale, height=height, width=width)
    return crop_camera(whole, jnp.full(2, -BEYOND), width + 2 * BEYOND, height + 2 * BEYOND)


def place_window(foot: Footprints) -> tuple[Int[Array, "2"], Int[Array, ""], Int[Array, ""]]:
    """Corner (column, row), width and height of the window around the discs; it may reach beyond the wide picture."""
    drawn, rows = foot.covered > 0, foot.covered // foot.width
    sides = []
    for first, size in ((foot.left, foot.width), (foot.top, rows)):
        low, high = jnp.min(jnp.where(drawn, first, 2**20)), jnp.max(jnp.where(drawn, first + size, 0))
        begin = jnp.where(jnp.any(drawn), jnp.maximum(low - MARGIN, 0) // GRID * GRID, 0)
        sides.append((begin, jnp.maximum(round_up(high + MARGIN - begin), STEP)))
    (left, width), (top, height) = sides
    return jnp.stack([left, top]), width, height


def bound_window(pixels: int, doublings: int, side: int) -> int:
    """Pixels along a side of the window of an object that fills a picture of `pixels` pixels, or exceeds it."""
    return round_up(-(-pixels * side // 2**doublings) + 2 * BEYOND + MARGIN)


def round_up(pixels: Any) -> Any:
    """The least multiple of STEP that is not below `pixels`."""
    return -(-pixels // STEP) * STEP


def crop_camera(camera: Camera, corner: Int[Array, "2"], width: int, height: int) -> Camera:
    """The camera whose picture is the window."""
    moved = jnp.asarray(camera.intrinsics).at[:2, 2].add(-corner.astype(camera.intrinsics.dtype))
    return dataclasses.replace(camera, intrinsics=moved, height=height, width=width)


# --- pictures ---------------------------------------------------------------------------------------------------------


def render(
    params: dict | None, scene: SurfelScene, camera: Camera, light: Light | None = None, *, plan: Plan
) -> Rendering:
    """The object as seen by a camera; pure; depth in the cloud's units; light None is the room.

    One object, one view, one light: use `jax.vmap` for batches, with a static plan.  params=None draws discs and light
    without the CNN.  `overflow` counts the entries and pixels that did not fit into the plan.

    Gradients hold all integers constant: position of the window, pixels that a disc covers, depth order in a pixel, and
    the cut after 24 entries.  Where one of these changes, where a normal turns away from the camera, and at the kinks
    of clipped values, the picture is only piecewise smooth.
    """
    check_view(params, scene, camera, light)
    _check_plan(plan)
    light = lighting.room_light() if light is None else light
    window_buffer = rasterize_window(scene, camera, light, plan=plan)
    return shade_window(params, scene, camera, light, window_buffer, plan=plan)


def _check_plan(plan: Plan) -> None:
    """ValueError in one line for what is no plan."""
    if any(isinstance(size, jax.core.Tracer) for size in jax.tree.leaves(plan)):
        raise UserError("render: plan is traced, but gives array sizes: jax.jit(render, static_argnames='plan')")
    check_kind(plan, Plan, "render: expected plan=spnr_jax.plan(scene, camera)")
    whole = all(isinstance(size, int | np.integer) for size in plan)
    if not whole or min(plan) < 0 or min(plan[1:]) < 1 or plan.entries > MOST_ENTRIES:
        found = "a size that is no whole number from 1 on"
        raise UserError(f"render: {plan} has {found}, or more than {MOST_ENTRIES} entries; use spnr_jax.plan")


class WindowBuffer(NamedTuple):
    """The G-buffer of a picture's window, the window's corner (column, row), and the overflow."""

    buffer: GBuffer
    corner: Int[Array, "2"]
    overflow: Int[Array, ""]


register(WindowBuffer)


def rasterize_window(scene: SurfelScene, camera: Camera, light: Light, *, plan: Plan) -> WindowBuffer:
    """The first half of `render`: discs, with the light that they receive, blended to a G-buffer."""
    wide = widen_camera(scene, camera, plan.doublings, plan.side)
    foot = splatting.project_discs(scene.surfels, wide)
    corner, width, height = place_window(foot)
    foot = splatting.move_to_window(foot, corner, plan.width, plan.height)
    window = crop_camera(wide, corner, plan.width, plan.height)
    buffer, overflow = rasterize(scene.surfels, foot, window, light, capacity=plan.entries, slots=plan.slots)
    lacking = jnp.maximum(width - plan.width, 0) + jnp.maximum(height - plan.height, 0)
    return WindowBuffer(buffer, corner, jnp.minimum(overflow, splatting.MOST_COUNTED) + lacking)


def shade_window(
    params: dict | None,
    scene: SurfelScene,
    camera: Camera,
    light: Light,
    window_buffer: WindowBuffer,
    *,
    plan: Plan,
) -> Rendering:
    """The second half: the network over the G-buffer."""
    wide = widen_camera(scene, camera, plan.doublings, plan.side)
    window = crop_camera(wide, window_buffer.corner, plan.width, plan.height)
    buffer = window_buffer.buffer
    shader_inputs = shader.compute_inputs(buffer, light, window)
    layers = shade(params, shader_inputs, buffer.depth, doublings=plan.doublings)
    inside = cameras.move_into_box(camera, scene.centre, scene.scale)
    scale = 2**plan.doublings
    image, depth, acc = paste_window(layers, window_buffer.corner * scale, inside, plan.side, BEYOND * scale)
    return Rendering(image=image, depth=depth / scene.scale, acc=acc, overflow=window_buffer.overflow)


def rasterize(
    surfels: Surfels, foot: Footprints, camera: Camera, light: Light, *, capacity: int, slots: int
) -> tuple[GBuffer, Int[Array, ""]]:
    """The G-buffer of a view, with the light that surfels receive; and how many entries and pixels did not fit."""
    entries, overflow = splatting.make_entries(foot, camera, capacity=capacity)
    surfels = shader.face_camera(surfels, camera)
    attributes = shader.compute_attributes(surfels, light, camera)
    buffer = blending.blend(entries, foot, surfels, attributes, camera, slots=slots)
    return buffer, overflow + jnp.maximum(blending.count_covered_pixels(entries) - slots, 0)


def shade(
    params: dict | None, shader_inputs: ShaderInputs, depth: Float[Array, "height width"], *, doublings: int
) -> Float[Array, "h w 5"]:
    """Colour times opacity, opacity, and depth along the camera's axis times opacity, at the doubled resolution."""
    if params is None:
        outputs = jnp.zeros((1, *(n << doublings for n in depth.shape), NUM_OUTPUTS))
    else:
        outputs = jnp.asarray(make_shader(params).apply(params, shader_inputs.inputs[None], doublings))
    color, alpha = compose_picture(outputs, shader_inputs.maps[None], shader_inputs.light_harmonics[None], doublings)
    known = jnp.stack([depth, (depth > 0).astype(depth.dtype)], axis=-1)[None]
    for _ in range(doublings):
        known = double_size(known)
    mean = known[..., :1] / larger(known[..., 1:], 1e-6)  # over the pixels that have a depth
    return (jnp.concatenate([color, jnp.ones_like(mean), mean], axis=-1) * alpha[..., None])[0]


def make_shader(params: dict) -> Shader:
    """The shader network for these weights; its sizes are read from them."""
    weights = params["params"]
    levels = sum(name.startswith("down") for name in weights)
    widths = tuple(weights[f"in{level}"]["kernel"].shape[-1] for level in range(levels))
    return Shader(widths, weights["top"]["kernel"].shape[-1])


def paste_window(
    layers: Float[AnyArray, "h w 5"], corner: Int[AnyArray, "2"], camera: Camera, side: int, beyond: int
) -> tuple[Float[Array, "height width 3"], Float[Array, "height width"], Float[Array, "height width"]]:
    """Image, depth along rays and opacity of the whole picture: empty outside the window.

    The window's corner is counted from `beyond` pixels outside the picture, which it may exceed.
    """
    height, width = (n * side for n in (camera.height, camera.width))
    rows, columns = (n + 2 * beyond + size for n, size in zip((height, width), layers.shape, strict=False))
    start = (corner[1], corner[0], jnp.zeros((), corner.dtype))
    pasted = jax.lax.dynamic_update_slice(jnp.zeros((rows, columns, 5), layers.dtype), layers, start)
    sums = average_pool(pasted[beyond : beyond + height, beyond : beyond + width], side)
    acc = sums[..., 3]
    rays = cameras.camera_rays(camera)
    _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
    along = -jnp.einsum("hwi,i->hw", rays.directions, camera.cam_to_world[:, 2], precision="highest")
    depth = sums[..., 4] / larger(along, 1e-6) + (1 - acc) * far
    return sums[..., :3] + (1 - acc[..., None]) * WHITE, depth, acc
