"""Our method on one page: points -> surfels -> G-buffer -> shader network -> light on materials -> picture.

    encode   neighbours, normals, sides, visibility by direction              once per object, NumPy and SciPy
    render   discs splatted to a G-buffer, a CNN over it, light               once per view

At what size, and in which window of the picture: `surfel_plan.py`.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from spnr_jax.config import SOLID, SurfelConfig
from spnr_jax.devices.side_by_side import two_at_a_time
from spnr_jax.kernels import cameras
from spnr_jax.kernels.compositing import WHITE
from spnr_jax.kernels.records import AnyArray, Camera, GBuffer, Key, Light, PointCloud, Rendering, Scene, Surfels
from spnr_jax.kernels.resizing import doubled, enlarged, mean_of_squares
from spnr_jax.method import solid
from spnr_jax.method.surfel_plan import Plan, in_window, planned, rounded, scaled, seen_through
from spnr_jax.nn.shader import NUM_OUTPUTS, Shader, picture
from spnr_jax.surfels import features, lighting, projection, splatting
from spnr_jax.surfels.estimate import estimate

LEAST_SLOTS = 2**11  # covered pixels that a table is made for
# of XLA, that take a third to two thirds off the compilation; entries, `_seen`, `_shade` and `_laid` run as long
QUICK = {"xla_cpu_use_fusion_emitters": False}
QUICKEST = QUICK | {"xla_backend_optimization_level": 1}


@struct.dataclass
class SurfelScene:
    """An encoded object: its surfels, and their median spacing, which decides at what size a picture is drawn.

    `solid` is what the network of rays makes of it, where there is one (`method/solid.py`).
    """

    surfels: Surfels
    spacing: float = struct.field(pytree_node=False)
    solid: Scene | None = None


def init(key: Key, config: SurfelConfig) -> dict:
    """Fresh variables of the shader network."""
    side = 2 ** len(config.widths)
    return dict(Shader(config.widths, config.top).init(key, jnp.zeros((1, side, side, features.NUM_FEATURES)), 1))


def encode(variables: dict | None, cloud: PointCloud, *, config: SurfelConfig) -> SurfelScene:
    """Surfels of a cloud (unbatched, in the box), and where it is solid; without variables surfels alone.

    Variables of the network of rays are `batch_stats`: what a state holds that is not trained.
    """
    mask = np.asarray(cloud.mask)
    names = ("positions", "base_color", "roughness", "metallic", "normals", "materials_known")
    columns: dict[str, Any] = {
        name: None if (x := getattr(cloud, name)) is None else np.asarray(x)[mask] for name in names
    }
    surfels = estimate(**columns)
    known = None
    if variables is not None and config.solid:
        known = solid.encode(variables["batch_stats"], cloud, config=SOLID)
    spacing = float(np.median(surfels.spacing[surfels.mask]))
    return SurfelScene(surfels=jax.device_put(surfels), spacing=spacing, solid=known)


def render(
    variables: dict | None,
    scene: SurfelScene,
    camera: Camera,
    light: Light,
    *,
    config: SurfelConfig,
    share: float = 1.0,
) -> Rendering:
    """One view (camera unbatched, in the box) of an encoded object; without variables discs and light alone.

    With a `share` below 1 of the pixels along a side the picture is drawn smaller, doubled as often, and enlarged.
    """
    small = _smaller(camera, share)
    plan, total = planned(scene.surfels, scene.spacing, small, share)
    drawn, _ = _drawn(variables, scene, small, light, plan, total, LEAST_SLOTS, config)
    return drawn if share == 1 else _enlarged(drawn, camera.height, camera.width)


def render_views(
    variables: dict | None,
    scene: SurfelScene,
    cameras: Camera,
    light: Light | Sequence[Light],
    *,
    config: SurfelConfig,
    share: float = 1.0,
) -> Rendering:
    """Views (one axis of cameras) in one light or each in its own."""
    views = [jax.tree.map(lambda x, i=i: x[i], cameras) for i in range(len(cameras.cam_to_world))]
    lights = [light] * len(views) if isinstance(light, Light) else light
    drawn = render_each(variables, scene, views, lights, config=config, share=share)
    return jax.tree.map(lambda *x: np.stack(x), *drawn)


def render_each(
    variables: dict | None,
    scene: SurfelScene,
    views: Sequence[Camera],
    lights: Sequence[Light],
    *,
    config: SurfelConfig,
    share: float = 1.0,
) -> Iterator[Rendering]:
    """Views one after the other; they share the sizes of the largest of them, so that few programs are compiled."""
    small = [_smaller(view, share) for view in views]
    plans = [planned(scene.surfels, scene.spacing, view, share) for view in small]
    largest: dict[tuple, np.ndarray] = {}
    for plan, total in plans:  # those of one resolution share their sizes
        sizes = np.array([plan.width, plan.height, total, LEAST_SLOTS])
        largest[plan[:2]] = np.maximum(largest.get(plan[:2], sizes), sizes)

    def one(asked: tuple[Camera, Camera, Light, tuple[Plan, int]]) -> Rendering:
        view, whole, light, (plan, total) = asked
        width, height, most, slots = map(int, largest[plan[:2]])
        shared = plan._replace(width=width, height=height)
        found, slots = _drawn(variables, scene, view, light, shared, most if total else 0, slots, config)
        largest[plan[:2]][3] = max(slots, largest[plan[:2]][3])
        return found if share == 1 else _enlarged(found, whole.height, whole.width)

    yield from two_at_a_time(one, zip(small, views, lights, plans, strict=True))


def _smaller(camera: Camera, share: float) -> Camera:
    if share == 1:
        return camera
    return cameras.resize(camera, *(max(round(share * n / 4) * 4, 4) for n in (camera.height, camera.width)))


def _drawn(
    variables: dict | None,
    scene: SurfelScene,
    camera: Camera,
    light: Light,
    plan: Plan,
    total: int,
    least_slots: int,
    config: SurfelConfig,
) -> tuple[Rendering, int]:
    """A planned view, and the size of its table of pixels."""
    if total == 0:
        return _nothing(camera), least_slots
    whole = scaled(camera, plan.doublings, plan.side)
    inside = seen_through(whole, plan)
    found, covered = projection.jitted_entries(
        scene.surfels, inside, total=rounded(total, 2**15, projection.MOST_ENTRIES)
    )
    pixels = inside.height * inside.width
    slots = rounded(min(max(int(covered), least_slots), pixels), LEAST_SLOTS, pixels)
    known = known_of(variables, scene, whole, config)
    within = None if known is None else jnp.asarray(in_window(known, plan))
    looked = jitted_look(found, scene.surfels, light, inside, within, slots=slots)
    return _placed(_shade(variables, *looked, config=config, doublings=plan.doublings), camera, plan), slots


def known_of(
    variables: dict | None, scene: SurfelScene, camera: Camera, config: SurfelConfig
) -> Float[Array, "height width 2"] | None:
    """Opacity and depth of a view as the network of rays sees it, where there is one."""
    if variables is None or scene.solid is None:
        return None
    return solid.seen(variables["batch_stats"], scene.solid, camera, config=SOLID)


def blended(found: projection.Entries, surfels: Surfels, light: Light, camera: Camera, *, slots: int) -> GBuffer:
    """The G-buffer of a picture's entries, with what of the light arrives at each surfel."""
    surfels = features.turned(surfels, camera)
    return splatting.blend(found, surfels, features.attributes(surfels, light, camera), camera, slots=slots)


def seen(
    buffer: GBuffer, light: Light, camera: Camera, known: Float[Array, "height width 2"] | None = None
) -> tuple[
    Float[Array, "height width 34"], Float[Array, "height width 18"], Float[Array, "9 3"], Float[Array, "height width"]
]:
    """What the network sees of a G-buffer, the light maps, the light's harmonics in camera axes, the depth."""
    told, maps = features.features(buffer, light, camera, known)
    return told, maps, lighting.projected(light, jnp.asarray(camera.cam_to_world)[:, :3]), buffer.depth


# two programs: of pictures with other numbers of covered pixels in the same window the second is not compiled again
_blended = jax.jit(blended, static_argnames="slots")
_seen = jax.jit(seen, compiler_options=QUICK)


def jitted_look(
    found: projection.Entries,
    surfels: Surfels,
    light: Light,
    camera: Camera,
    known: Float[Array, "height width 2"] | None = None,
    *,
    slots: int,
) -> tuple[Array, Array, Array, Array]:
    """`seen` of what is `blended`, compiled."""
    return _seen(_blended(found, surfels, light, camera, slots=slots), light, camera, known)


@partial(jax.jit, static_argnames=("config", "doublings"), compiler_options=QUICKEST)
def _shade(
    variables: dict | None,
    seen: Float[Array, "height width 34"],
    maps: Float[Array, "height width 18"],
    ambient: Float[Array, "9 3"],
    depth: Float[Array, "height width"],
    *,
    config: SurfelConfig,
    doublings: int,
) -> Float[Array, "h w 5"]:
    """Colour, opacity and depth along the camera's axis, of the window, doubled."""
    if variables is None:
        outputs = jnp.zeros((1, *(n << doublings for n in seen.shape[:2]), NUM_OUTPUTS))
    else:
        outputs = jnp.asarray(
            Shader(config.widths, config.top).apply({"params": variables["params"]}, seen[None], doublings)
        )
    color, alpha = picture(outputs, maps[None], ambient[None], doublings)
    depth = depth[None, ..., None]
    for _ in range(doublings):
        depth = doubled(depth)
    return jnp.concatenate([color, alpha[..., None], depth], axis=-1)[0]


def _placed(drawn: Float[AnyArray, "h w 5"], camera: Camera, plan: Plan) -> Rendering:
    """The window in its place in the picture."""
    scale = 2**plan.doublings
    corner = np.array([plan.top * scale, plan.left * scale], np.int32)
    image, depth, acc = _laid(drawn, corner, camera, side=plan.side)
    return Rendering(image=image, image_lr=image, depth=depth, acc=acc)


# one program: its 50 operations alone would each be compiled, 2 s
@partial(jax.jit, static_argnames="side", compiler_options=QUICKEST)
def _laid(
    drawn: Float[AnyArray, "h w 5"], corner: Int[AnyArray, "2"], camera: Camera, *, side: int
) -> tuple[Float[Array, "height width 3"], Float[Array, "height width"], Float[Array, "height width"]]:
    """Image, depth along the rays and opacity of a picture that is empty but for a window, which may reach beyond."""
    height, width = (n * side for n in (camera.height, camera.width))
    alpha = drawn[..., 3:4]
    layers = jnp.concatenate([drawn[..., :3] * alpha, alpha, drawn[..., 4:] * alpha], axis=-1)
    empty = jnp.zeros((height + drawn.shape[0], width + drawn.shape[1], 5))
    sums = jax.lax.dynamic_update_slice(empty, layers, (*corner, jnp.zeros((), jnp.int32)))[:height, :width]
    if side > 1:
        sums = mean_of_squares(sums, side)
    acc = sums[..., 3]
    rays = cameras.camera_rays(camera)
    _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
    along = -jnp.einsum("hwi,i->hw", rays.directions, camera.cam_to_world[:, 2], precision="highest")
    depth = sums[..., 4] / jnp.maximum(along, 1e-6) + (1 - acc) * far
    return sums[..., :3] + (1 - acc[..., None]) * WHITE, depth, acc


_enlarged = jax.jit(enlarged, static_argnums=(1, 2), compiler_options=QUICK)


def _nothing(camera: Camera) -> Rendering:
    """A view in which nothing of the object is seen."""
    return _placed(np.zeros((1, 1, 5), np.float32), camera, Plan(0, 1, 0, 0, 1, 1))
