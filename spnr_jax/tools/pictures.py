"""A file of points in, pictures out: stills around the object, a turntable, depth, opacity.

    NAME_000.png ...            images, sRGB, on white or with straight alpha
    NAME_000_depth.png          near bright, far dark, the range of this picture
    NAME_000_depth.npy          float32, distance along the ray in the file's units, NaN where nothing is hit
    NAME_000_opacity.png
    NAME_turntable.gif          or .mp4
    NAME_cameras.json           cameras in the nerfstudio convention in the file's frame, up axis, normalisation

Depth and opacity have the resolution of the volume rendering, which an upsampler doubles for the image.
"""

import dataclasses
import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from operator import add
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from PIL import Image

from spnr_jax.devices.runtime import run_ahead
from spnr_jax.errors import UserError
from spnr_jax.formats import clouds, images
from spnr_jax.formats.camera_files import SIZE, cameras_of, describe_cameras, read_document
from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.formats.images import read_light
from spnr_jax.kernels.cameras import camera_rays
from spnr_jax.kernels.imaging import linear_to_srgb
from spnr_jax.kernels.records import Camera, Encoded, Light, Rendering
from spnr_jax.method.model import Model
from spnr_jax.methods import method_of
from spnr_jax.surfels.lighting import look_up_background, room_light
from spnr_jax.surfels.skies import sun
from spnr_jax.tools.commands import Lighting, Render
from spnr_jax.tools.surfaces import surface_depth
from spnr_jax.training.weights import load

SUN = (1.6, 1.5, 1.35)  # irradiance on what faces the sun of --sun, slightly warm


def light_of_options(options: Lighting, read: Callable[[str], Light] = read_light) -> Light:
    """The light of the options; `read` returns the light of a map by name."""
    parts = [read(options.light or "room").turned(options.light_yaw)] if options.light or not options.sun else []
    parts += [sun(*options.sun, color=SUN)] if options.sun else []
    return 2.0**options.exposure * reduce(add, parts)


def check_takes_light(model: Model, names: Sequence[str], run: Path | None) -> None:
    """ValueError, naming the options, if light options are given and the network takes no light."""
    if names and not method_of(model.config).takes_light:
        raise UserError(
            f"{', '.join(names)}: the network of --run {run} knows the light of its training alone; "
            f"leave {'it' if len(names) == 1 else 'them'} out, or --run"
        )


def put_background(wanted: str, rendering: Rendering, camera: Camera, light: Light | None) -> Rendering:
    """The picture in front of its background: white, or the map of the light (None: the room)."""
    if wanted == "white":
        return rendering
    behind = np.asarray(_draw_background(light or room_light(), camera))
    image = np.asarray(rendering.image) + (1 - np.asarray(rendering.acc))[..., None] * (behind - 1)
    return dataclasses.replace(rendering, image=image)


@jax.jit
def _draw_background(light: Light, camera: Camera) -> Float[Array, "height width 3"]:
    """The environment map as seen by a camera, sRGB."""
    towards = list(jnp.moveaxis(camera_rays(camera).directions, -1, 0))
    return linear_to_srgb(jnp.minimum(jnp.stack(look_up_background(light, towards), axis=-1), 1))


FIRST_AZIMUTH = 30.0  # degrees of the first still: a view that shows front and side
INVISIBLE = 1 / 255  # opacity below which a pixel has no colour of its own


@dataclass(frozen=True, kw_only=True)
class PreparedObject:
    """An encoded cloud, the model and light that render it, and cameras of a file, if there are any."""

    placed: PlacedCloud
    model: Model
    volume: Encoded
    light: Light | None
    cameras: Sequence[Camera] = ()


def render_file(options: Render, note: Callable[[str], None]) -> Iterator[str]:
    """Writes the files of the options; yields a line about each; `note` gets the assumptions about the cloud."""
    images.check_place(options.out / options.cloud.stem)
    ready = prepare_cloud(options, note)
    yield f"encoded {len(ready.placed.cloud.positions)} points of {options.cloud}"
    yield from run_ahead(draw_all(ready, options, options.out / options.cloud.stem))


def prepare_cloud(options: Render, note: Callable[[str], None]) -> PreparedObject:
    """The cloud of the options read and encoded; `note` gets the assumptions about it.

    ValueError, before the cloud is read, for a run that is none or a network that cannot draw what is asked for.
    """
    model = load(options.run)
    check_takes_light(model, options.light_options_given, options.run)
    views = options.cameras and read_document(options.cameras, lambda line: note(f"{options.cameras}: {line}"))
    light = light_of_options(options.lighting) if options.light_options_given else None
    placed = clouds.place_cloud(
        options.cloud,
        num_points=options.num_points,
        up=options.up,
        seed=options.seed,
        clean=options.clean,
        cut=options.cut,
        transparent_parts=options.transparent_parts,
        report=note,
    )
    cameras = cameras_of(views, placed.rotation, placed.origin, options.resolution or SIZE) if views else ()
    volume = model.encode(placed.cloud, options.densify)
    return PreparedObject(placed=placed, model=model, volume=volume, light=light, cameras=cameras)


def draw_all(ready: PreparedObject, options: Render, name: Path) -> Iterator[Callable[[], str]]:
    """Renders the views of the options; yields functions that write a file, in any thread, and return a line about it.

    Stills and film are rendered together: views with the same sizes share programs.
    """
    stills = list(ready.cameras) or [_camera(ready, FIRST_AZIMUTH + turn, options) for turn in _turns(options.views)]
    cameras, lights = list(stills), [ready.light] * len(stills)
    turns = _turns(0 if options.turntable == "none" else options.frames)
    if options.turn == "light" and ready.light is not None:
        cameras += [_camera(ready, FIRST_AZIMUTH, options)] * len(turns)
        lights += [ready.light.turned(turn) for turn in turns]
    else:
        cameras += [_camera(ready, turn, options) for turn in turns]
        lights += [ready.light] * len(turns)
    drawn = zip(cameras, lights, ready.model.render_each(ready.volume, cameras, options.quality, lights), strict=True)
    views = (put_background(options.background, rendering, camera, light) for camera, light, rendering in drawn)
    for i, (camera, rendering) in enumerate(zip(stills, views, strict=False)):  # the rest are the film's
        yield partial(_write_still, f"{name}_{i:03d}", rendering, camera, ready.volume, options)
    file = Path(f"{name}_cameras.json")
    if stills and not (options.cameras and options.cameras.resolve() == file.resolve()):  # it stays as it is
        document = cameras_document(stills, name.name, ready.placed, ready.volume)
        images.write_whole(file, f"{json.dumps(document, indent=1)}\n".encode())
    if options.turntable != "none":
        film = [np.asarray(rendering.image) for rendering in views]
        yield partial(_write_film, Path(f"{name}_turntable.{options.turntable}"), film, options)


def _turns(count: int) -> list[float]:
    """Even angles in degrees, from 0."""
    return [360 * i / count for i in range(count)]


def _camera(ready: PreparedObject, azimuth: float, options: Render) -> Camera:
    return ready.model.camera(ready.volume, azimuth, options.elevation, options.resolution)


def _write_still(stem: str, rendering: Rendering, camera: Camera, volume: Encoded, options: Render) -> str:
    """Writes the files of one view; a line that names the first."""
    acc, files = np.asarray(rendering.acc), {}
    if "image" in options.outputs:
        image = np.asarray(rendering.image)
        files[".png"] = images.png(straight_alpha(image, acc) if options.transparent else image)
    if "depth" in options.outputs:
        files["_depth.png"] = images.png(images.depth_image(rendering.depth, acc))
        stream = io.BytesIO()
        np.save(stream, surface_depth(rendering, camera, volume))
        files["_depth.npy"] = stream.getvalue()
    if "opacity" in options.outputs:
        files["_opacity.png"] = images.png(np.repeat(acc[..., None], 3, axis=-1))
    for suffix, content in files.items():
        images.write_whole(Path(stem + suffix), content)
    return f"wrote {stem}{next(iter(files))}"


def _write_film(path: Path, film: list[np.ndarray], options: Render) -> str:
    path, reason = images.write_turntable(path, film, options.fps)
    return f"wrote {path}" + (f" ({reason})" if reason else "")


def straight_alpha(image: np.ndarray, acc: np.ndarray) -> np.ndarray:
    """RGBA (h, w, 4) in [0, 1] that equals the image on white; the opacity (h', w') is interpolated."""
    alpha = np.asarray(Image.fromarray(acc.astype(np.float32)).resize(image.shape[1::-1], Image.Resampling.BILINEAR))
    alpha = np.clip(alpha, 0, 1)[..., None]
    color = (np.clip(image, 0, 1) - (1 - alpha)) / np.maximum(alpha, INVISIBLE)
    return np.concatenate([np.clip(np.where(alpha < INVISIBLE, 1, color), 0, 1), alpha], axis=-1)


def cameras_document(cameras: list[Camera], name: str, placed: PlacedCloud, volume: Encoded) -> dict:
    """The views in the nerfstudio convention, and the transform of the points: box = scale * (rotation p - centre)."""
    names = [f"{name}_{i:03d}.png" for i in range(len(cameras))]
    return describe_cameras(cameras, names, placed.rotation, placed.origin) | {
        "up": placed.up,
        "normalization": {
            "rotation": placed.rotation.tolist(),
            "centre": (np.asarray(volume.centre, np.float64) + placed.rotation @ placed.origin).tolist(),
            "scale": float(volume.scale),
        },
    }
