"""Exports: a cloud's object as splats or as a page for any browser, and the network itself.

Splats have y up (.spz) or y down (.ply), the units of the cloud's file and, unless float32 is too coarse there, its
origin.

The default network is bytes that need JAX alone: `encode` and `render` as serialised StableHLO, weights included.

    encode, render = (load_exported(content) for content in (export_encode(model), export_render(model)))
    picture = render(encode(cloud), camera, light)

They are `spnr_jax.encode` and `spnr_jax.render` over dicts of arrays, so no class of this package is needed where they
are used; there `jax.export.deserialize(content).call` does what `load_exported` does.

    cloud       positions (points, 3) in any unit, y up; base_color (points, 3) linear; roughness, metallic (points,);
                mask (points,) bool, False for padding.  At least one point is real, and all real ones are finite
    volume      the scene of `spnr_jax.encode`, to be passed on: surfels, spacing, centre, scale
    camera      cam_to_world (3, 4) in the cloud's frame and unit, OpenGL axes; intrinsics (3, 3) in pixels
    light       tables (7, 32, 64, 3): those of `Light`, linear in the light, so sums and multiples are lights
    picture     image (h, w, 3) sRGB on white; depth, acc (h, w); overflow (): above 0 the plan was too small

Sizes are fixed when it is exported: the number of points, padding included, and the plan of the picture.  The neighbors
are found in the exported function, by all distances, a block of points at a time.
"""

import base64
import html
import io
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.serialization import to_state_dict
from jax import export
from jaxtyping import Array, Bool, Float, Int
from PIL import Image

from spnr_jax.config import SurfelConfig
from spnr_jax.errors import UserError, require
from spnr_jax.formats import images
from spnr_jax.formats.array_files import pack_arrays
from spnr_jax.formats.gaussian_files import check_suffix, fits_spz, spz_of, write_splats
from spnr_jax.kernels.cloud_arrays import make_cloud
from spnr_jax.kernels.records import AnyArray, Camera, Gaussians, Light, PointCloud, Surfels, SurfelScene
from spnr_jax.method import surfel_method, surfel_renderer
from spnr_jax.method.model import FIELD_OF_VIEW, Model
from spnr_jax.method.surfel_renderer import Plan
from spnr_jax.surfels import lighting
from spnr_jax.surfels.constants import NEIGHBORS
from spnr_jax.surfels.sides import spiral
from spnr_jax.tools import surfaces
from spnr_jax.tools.commands import Export, Render, Share, require_drawable
from spnr_jax.tools.pictures import PreparedObject, prepare_cloud
from spnr_jax.training import weights

# --- objects ----------------------------------------------------------------------------------------------------------


MOST_BYTES = 6_000_000  # of a page
POSTER_QUALITY = 88  # of its JPEG

Say = Callable[[str], None]


def export_object(options: Export, note: Say) -> str:
    """Writes a cloud's splats; a line about it.  `note` gets the assumptions about the cloud."""
    render_options = make_render_options(options, options.run, options.network)
    assert options.splats is not None
    check_suffix(options.splats)
    if options.splats.resolve() == render_options.cloud.resolve():
        raise UserError(f"{options.splats}: the cloud itself; choose another file for its splats")
    gaussians = _splats(prepare_cloud(render_options, note), options, note)
    size = write_splats(options.splats, gaussians, describe_source(render_options))
    return f"wrote {options.splats} ({len(gaussians.opacity):,} splats, {size / 1e6:.1f} MB)"


def make_render_options(options: Export | Share, cloud: Path, run: Path | None) -> Render:
    """The same options for a cloud in the form of `spnr render`."""
    return Render(
        cloud=cloud,
        run=run,
        num_points=options.num_points or Render.num_points,
        up=options.up,
        clean=options.clean,
        lighting=options.lighting,
    )


def describe_source(options: Render) -> str:
    """The line that names cloud, network and light, without folders."""
    lights = (options.lighting.light, "sun" if options.lighting.sun else None)
    light = " + ".join(Path(name).name for name in lights if name) or "room"
    return f"{options.cloud.name}, drawn by spnr_jax ({Path(options.run or weights.PACKAGED).name}), light: {light}"


def share(options: Share, note: Say) -> str:
    """Writes the page of a cloud; a line about it.  `note` gets the assumptions about the cloud."""
    images.check_place(options.out)
    render_options = make_render_options(options, options.cloud, options.run)
    ready = prepare_cloud(render_options, note)
    gaussians = _splats(ready, options, note)
    if not fits_spz(gaussians):
        note("a .spz cannot hold these splats: those of the page are in another unit")
    camera = ready.model.camera(ready.volume, options.azimuth, options.elevation, surfaces.RESOLUTION)
    poster = np.asarray(ready.model.render(ready.volume, camera, light=ready.light).image)
    caption = " · ".join(filter(None, [describe_source(render_options), options.credit]))
    view = (options.azimuth, options.elevation)
    content = page(gaussians, poster, camera, view, options.title or options.cloud.stem, caption)
    images.write_whole(options.out, content)
    return f"wrote {options.out} ({len(gaussians.opacity):,} splats, {len(content) / 1e6:.1f} MB)"


def _splats(ready: PreparedObject, options: Export | Share, note: Say) -> Gaussians:
    how = options.making
    gaussians = surfaces.splats(
        ready.model,
        ready.placed.cloud,
        light=ready.light,
        degree=how.harmonics,
        most=how.most_splats,
        views=how.fitting_views,
        volume=ready.volume,
    )
    if (origin := ready.placed.origin).any():
        note(f"splats lie around the origin; it is at {' '.join(f'{x:.15g}' for x in origin)} in the file")
    return gaussians


def page(
    gaussians: Gaussians, poster: np.ndarray, camera: Camera, view: tuple[float, float], title: str, note: str
) -> bytes:
    """The page: splats, a picture from `camera`, which stands at `view`, azimuth and elevation in degrees.

    Splats that are too small or too large for a .spz file are scaled.
    """
    pose = np.asarray(camera.cam_to_world, np.float64)
    target = np.asarray(gaussians.position, np.float64).mean(axis=0)
    distance = float((pose[:, 3] - target) @ pose[:, 2])
    target = pose[:, 3] - distance * pose[:, 2]  # on the line of sight
    unit = 1.0 if fits_spz(gaussians) else distance
    gaussians = replace(gaussians, position=gaussians.position / unit, scale=gaussians.scale / unit)
    start = {"azimuth": view[0], "elevation": view[1], "distance": distance / unit, "target": (target / unit).tolist()}
    jpeg = io.BytesIO()
    Image.fromarray(images.to_uint8(poster)).save(jpeg, "jpeg", quality=POSTER_QUALITY)
    parts = {
        "TITLE": html.escape(title),
        "NOTE": html.escape(note),
        "NAME": html.escape(re.sub(r'[\x00-\x1f/\\:*?"<>|]+', "_", title).strip(" .") or "splats"),
        "POSTER": "data:image/jpeg;base64," + base64.b64encode(jpeg.getvalue()).decode(),
        "CAMERA": json.dumps(start | {"view": float(np.rad2deg(FIELD_OF_VIEW))}),
        "DATA": base64.b64encode(spz_of(gaussians)).decode(),
    }
    text = resources.files("spnr_jax.tools").joinpath("share_page.html").read_text("utf-8")
    first, *others = text.split("@")  # text between two @ is a name: the parts may hold any characters
    content = (first + "".join(parts.get(piece, piece) for piece in others)).encode(errors="replace")
    if len(content) > MOST_BYTES:
        raise UserError(
            f"the page would be {len(content) / 1e6:.1f} MB, at most {MOST_BYTES / 1e6:.0f}; "
            "ask for fewer splats (--most-splats) or plainer ones (--harmonics 0)"
        )
    return content


# --- the network ------------------------------------------------------------------------------------------------------


RADIUS = 0.8  # of the ball in the box for whose pictures the sizes are planned: it has as much surface as a cube
BLOCK = 256  # points whose distances to all are in memory at once

Arrays = dict[str, Any]


def export_network(options: Export) -> str:
    """Writes the files of `spnr export RUN`; returns a line about them."""
    if options.run.is_file() and options.run.suffix != ".npz":
        cloud = f"of a cloud `spnr export {options.run} --splats OUT.ply`"
        raise UserError(f"{options.run}: a file; expected a run folder, or {cloud}")
    trained, where, out = weights.read_trained(options.run), options.platforms, options.out
    model = Model(config=trained.config.model, params=trained.variables)
    images.check_place(out / "weights.npz")
    points, size = options.num_points or 1024, options.resolution
    functions = {
        "encode": export_encode(model, num_points=points, platforms=where),
        "render": export_render(model, resolution=size, num_points=points, platforms=where),
    }
    weights.write_weights(out / "weights.npz", trained)
    weights.write_companions(out, trained)
    room = {"tables": np.asarray(lighting.room_light().tables)}
    images.write_whole(out / "light.npz", pack_arrays(room, compressed=True))
    for name, content in functions.items():
        images.write_whole(out / f"{name}.jax", content)
        images.write_whole(out / f"{name}.stablehlo", _deserialise(content).mlir_module_serialized)
    signatures = {name: signature(content) for name, content in functions.items()}
    images.write_whole(out / "export.json", (json.dumps(signatures, indent=1) + "\n").encode())
    return f"wrote the weights, encode and render to {out} (export.json says what they take and give)"


def export_encode(model: Model, *, num_points: int = 1024, platforms: Sequence[str] | None = None) -> bytes:
    """The serialised function `cloud -> volume` for clouds of `num_points` points, padding included.

    `platforms` are those that may run it, out of cpu, cuda, rocm, tpu; None is the one that JAX uses here.
    """
    _check_exportable(model)
    require(num_points >= 1, f"num_points must be at least 1, got {num_points}")
    return _serialise(partial(encode_arrays, model.params), platforms, cloud_shapes(num_points))


def export_render(
    model: Model,
    *,
    resolution: int | None = None,
    num_points: int = 1024,
    plan: Plan | None = None,
    platforms: Sequence[str] | None = None,
) -> bytes:
    """The serialised function `(volume, camera, light) -> picture` for square pictures, by default of the network's
    size, for scenes of `num_points` points.

    Sizes come from a plan, by default that of a ball with `num_points` points, with a margin.  `platforms` as for
    `export_encode`.
    """
    _check_exportable(model)
    size = model.config.image_resolution if resolution is None else resolution
    require_drawable(size, "resolution")
    draw = partial(render_arrays, model.params, size=size, plan=plan or make_plan(model, num_points, size))
    volume = jax.eval_shape(partial(encode_arrays, model.params), cloud_shapes(num_points))
    camera = {"cam_to_world": _floats(3, 4), "intrinsics": _floats(3, 3)}
    light = {"tables": _floats(7, lighting.HEIGHT, lighting.WIDTH, 3)}
    return _serialise(draw, platforms, volume, camera, light)


def load_exported(content: bytes) -> Callable[..., Arrays]:
    """The function in the bytes of `export_encode` or `export_render`; it compiles at its first call."""
    return jax.jit(_deserialise(content).call)


def signature(content: bytes) -> dict[str, Any]:
    """Shapes and types of the arguments (a list) and outputs of an exported function, and its platforms."""
    exported = _deserialise(content)
    (arguments, _), outputs = (
        jax.tree.map(lambda x: {"shape": list(x.shape), "dtype": str(x.dtype)}, jax.tree.unflatten(tree, shapes))
        for tree, shapes in ((exported.in_tree, exported.in_avals), (exported.out_tree, exported.out_avals))
    )
    return {"inputs": list(arguments), "outputs": outputs, "platforms": list(exported.platforms)}


def _check_exportable(model: Model) -> None:
    name = model.config.method
    require(isinstance(model.config, SurfelConfig), f"a network of method {name} cannot be exported; only surfels can")


def _serialise(function: Callable[..., Arrays], platforms: Sequence[str] | None, *shapes: Arrays) -> bytes:
    return bytes(export.export(jax.jit(function), platforms=platforms)(*shapes).serialize())


def _deserialise(content: bytes) -> export.Exported:
    try:
        return export.deserialize(bytearray(content))
    except Exception as error:  # noqa: BLE001 - flatbuffers and JAX raise many kinds for bytes that are something else
        raise UserError(f"not a function that JAX exported ({type(error).__name__}); export it again") from None


def encode_arrays(params: dict, cloud: Arrays) -> Arrays:
    """The scene of a cloud as a dict of arrays; pure."""
    points = PointCloud(**cloud)
    near = nearest(points.positions, points.mask)
    return dict(to_state_dict(surfel_renderer.encode(params, points, near)))


def render_arrays(params: dict, volume: Arrays, camera: Arrays, light: Arrays, *, size: int, plan: Plan) -> Arrays:
    """The picture of a scene as a dict of arrays; pure."""
    scene = SurfelScene(**volume | {"surfels": Surfels(**volume["surfels"])})
    view = Camera(**camera, height=size, width=size)
    drawn = surfel_renderer.render(params, scene, view, Light(**light), plan=plan)
    return {name: getattr(drawn, name) for name in ("image", "depth", "acc", "overflow")}


def nearest(positions: Float[AnyArray, "points 3"], mask: Bool[AnyArray, " points"]) -> Int[Array, "points 20"]:
    """`spnr_jax.neighbors` of points without normals, in JAX: by all distances."""
    positions, mask = jnp.asarray(positions), jnp.asarray(mask)
    count = min(NEIGHBORS, len(mask))

    def of_one(number: Int[Array, ""]) -> Int[Array, " count"]:
        apart = jnp.sum((positions - positions[number][None]) ** 2, axis=-1)
        apart = jnp.where(mask, apart, jnp.inf).at[number].set(-1.0)
        least, found = jax.lax.top_k(-apart, count)
        return jnp.where(jnp.isfinite(least) & mask[number], found, -1).astype(jnp.int32)

    found = jax.lax.map(of_one, jnp.arange(len(mask)), batch_size=min(BLOCK, len(mask)))
    return jnp.pad(found, ((0, 0), (0, NEIGHBORS - count)), constant_values=-1)


def make_plan(model: Model, num_points: int, size: int) -> Plan:
    """Sizes, with a margin, for pictures of any object of `num_points` points by `Model.camera`."""
    ball = make_cloud(RADIUS * spiral(num_points), roughness=0.5)
    scene = surfel_method.encode_in_box(ball)
    plan = surfel_renderer.plan(scene, model.camera(scene, resolution=size))
    window = surfel_renderer.bound_window(size, plan.doublings, plan.side)
    return plan._replace(width=window, height=window, entries=2 * plan.entries, slots=window**2)


def cloud_shapes(num_points: int) -> Arrays:
    """Shapes of the arguments of `encode_arrays`."""
    vectors, scalars, mask = _floats(num_points, 3), _floats(num_points), jax.ShapeDtypeStruct((num_points,), np.bool_)
    return {"positions": vectors, "base_color": vectors, "roughness": scalars, "metallic": scalars, "mask": mask}


def _floats(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, np.float32)
