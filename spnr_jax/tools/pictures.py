"""A file of points in, pictures out: stills around the object, a turntable, depth, opacity, a mesh, the density.

    NAME_000.png ...            images, sRGB, on white or with straight alpha
    NAME_000_depth.png          near bright, far dark, the range of this picture
    NAME_000_depth.npy          float32, distance along the ray in the file's units, NaN where nothing is hit
    NAME_000_depth_16bit.png    round(depth / scale), 0 where nothing is hit; NAME_cameras.json has the scale
    NAME_000_opacity.png
    NAME_turntable.gif          or .mp4
    NAME_mesh.glb               in the file's frame and units
    NAME_density.npz            density (x, y, z) per unit, lowest, spacing: place = lowest + spacing * index
    NAME_cameras.json           cameras in the nerfstudio convention in the file's frame, up axis, normalisation

Depth and opacity have the resolution of the volume rendering, which an upsampler doubles for the image.
"""

import io
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from spnr_jax.formats import clouds, images
from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.kernels.records import Camera, Light, Rendering
from spnr_jax.method.model import Model, Volume
from spnr_jax.model_config import RayNetworkConfig
from spnr_jax.tools import depth_maps
from spnr_jax.tools.chosen_light import before, check_takes_light, light_of_options
from spnr_jax.tools.render_command import Render
from spnr_jax.training.weights import load, suited_to

FIRST_AZIMUTH = 30.0  # degrees of the first still: a view that shows front and side
INVISIBLE = 1 / 255  # opacity below which a pixel has no colour of its own
# The surface lies where a voxel of the network stops this share of the light.  Silhouettes of the mesh and of the
# opacity then agree to an IoU of 0.92 (10 real objects); with 0.2 and 0.5 to 0.88 and 0.78.
MESH_OPACITY = 0.3
SOLID = "small"  # network of the package that has a density


def render_file(options: Render, note: Callable[[str], None]) -> Iterator[str]:
    """Writes what the options ask for; yields a line about each file, `note` gets the assumptions about the cloud."""
    _check_writable(options.out)
    named = load(options.run) if options.run else None  # a run that is none is said before the cloud is read
    if named:
        check_takes_light(named, options.asked_of_light, options.run)
    light = light_of_options(options.lighting) if options.asked_of_light else None
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
    model = named or load("surfels" if light else suited_to(len(placed.cloud.positions)))
    volume = model.encode(placed.cloud)
    yield f"encoded {len(placed.cloud.positions)} points of {options.cloud}"
    name = options.out / options.cloud.stem
    frames = []
    for i, azimuth in enumerate(FIRST_AZIMUTH + np.arange(options.views) * 360 / max(options.views, 1)):
        camera = model.camera(volume, float(azimuth), options.elevation, options.resolution)
        rendering = model.render(volume, camera, options.quality, light)
        rendering = before(options.lighting.background, rendering, camera, light)
        stem = f"{name}_{i:03d}"
        for suffix, data in still_files(rendering, camera, volume, options):
            images.write_whole(Path(stem + suffix), data)
        frames.append({"file_path": f"{Path(stem).name}.png", "camera": camera})
        yield f"wrote {stem}.png"
    if frames:
        document = cameras_document(frames, placed, volume)
        images.write_whole(Path(f"{name}_cameras.json"), (json.dumps(document, indent=1) + "\n").encode())
    if options.turntable != "none":
        film = turntable_frames(model, volume, options, light)
        path, reason = images.write_turntable(Path(f"{name}_turntable.{options.turntable}"), film, options.fps)
        yield f"wrote {path}" + (f" ({reason})" if reason else "")
    if options.mesh or options.density:
        yield from _write_solids(model, volume, placed, options, name)


def still_files(rendering: Rendering, camera: Camera, volume: Volume, options: Render) -> Iterator[tuple[str, bytes]]:
    """(what follows the view's name, content) of the files of one view."""
    acc = np.asarray(rendering.acc)
    if "image" in options.outputs:
        image = np.asarray(rendering.image)
        yield ".png", images.png(straight_alpha(image, acc) if options.transparent else image)
    if "depth" in options.outputs:
        yield "_depth.png", images.png(images.depth_image(rendering.depth, acc))
        depth = depth_maps.surface_depth(rendering, camera, volume)
        yield "_depth.npy", _saved(np.save, depth)
        steps = Image.fromarray(depth_maps.in_16bit(depth, depth_maps.step_16bit(volume)))
        yield "_depth_16bit.png", _saved(lambda file, picture: picture.save(file, "png"), steps)
    if "opacity" in options.outputs:
        yield "_opacity.png", images.png(np.repeat(acc[..., None], 3, axis=-1))


def straight_alpha(image: np.ndarray, acc: np.ndarray) -> np.ndarray:
    """RGBA (h, w, 4) in [0, 1] that gives the image when it is laid on white; the opacity (h', w') is interpolated."""
    alpha = np.asarray(Image.fromarray(acc.astype(np.float32)).resize(image.shape[1::-1], Image.Resampling.BILINEAR))
    alpha = np.clip(alpha, 0, 1)[..., None]
    color = (np.clip(image, 0, 1) - (1 - alpha)) / np.maximum(alpha, INVISIBLE)
    return np.concatenate([np.clip(np.where(alpha < INVISIBLE, 1, color), 0, 1), alpha], axis=-1)


def turntable_frames(model: Model, volume: Volume, options: Render, light: Light | None) -> list[np.ndarray]:
    """Images of one turn around the object, or of its light."""
    turns = np.arange(options.frames) * 360.0 / options.frames
    azimuths = np.full(options.frames, FIRST_AZIMUTH) if options.turn == "light" else turns
    lights = [light.turned(turn) if light and options.turn == "light" else light for turn in turns]
    views = [model.camera(volume, float(a), options.elevation, options.resolution) for a in azimuths]
    pictures = zip(model.render_each(volume, views, options.quality, lights), views, lights, strict=True)
    return [np.asarray(before(options.lighting.background, *of).image) for of in pictures]


def cameras_document(frames: list[dict], placed: PlacedCloud, volume: Volume) -> dict:
    """The views in the nerfstudio convention, and what was done to the points: box = scale * (rotation p - centre)."""
    camera: Camera = frames[0]["camera"]
    intrinsics, scale = np.asarray(camera.intrinsics, np.float64), float(volume.scale)
    return {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": intrinsics[0, 0],
        "fl_y": intrinsics[1, 1],
        "cx": intrinsics[0, 2],
        "cy": intrinsics[1, 2],
        "frames": [
            {"file_path": frame["file_path"], "transform_matrix": _pose_in_file(frame["camera"], placed).tolist()}
            for frame in frames
        ],
        "up": placed.up,
        "normalization": {
            "rotation": placed.rotation.tolist(),
            "centre": (np.asarray(volume.centre, np.float64) + placed.rotation @ placed.origin).tolist(),
            "scale": scale,
        },
        "depth": {"kind": "distance along the ray", "scale_16bit": depth_maps.step_16bit(volume), "nothing_16bit": 0},
    }


def _pose_in_file(camera: Camera, placed: PlacedCloud) -> np.ndarray:
    """Camera-to-world matrix (4, 4) in the frame of the file."""
    pose = np.eye(4)
    pose[:3] = placed.rotation.T @ np.asarray(camera.cam_to_world, np.float64)
    pose[:3, 3] += placed.origin
    return pose


def _write_solids(model: Model, volume: Volume, placed: PlacedCloud, options: Render, name: Path) -> Iterator[str]:
    """Writes the density grid, and its surface as a mesh."""
    from spnr_jax.tools import density_grid, mesh_export  # here: pictures alone do without

    if not isinstance(model.config, RayNetworkConfig):
        yield f"the network that renders has no density: that of the package's {SOLID} is taken"
        model = load(SOLID)
        volume = model.encode(placed.cloud)
    grid = density_grid.sample_density(model, volume, placed, options.grid_resolution)
    if options.density:
        arrays = {"density": grid.density, "lowest": grid.lowest + grid.origin, "spacing": grid.spacing}
        images.write_whole(
            Path(f"{name}_density.npz"), _saved(lambda file, _: np.savez_compressed(file, **arrays), None)
        )
        yield f"wrote {name}_density.npz"
    if options.mesh:
        content, num_faces = mesh_export.mesh_of(grid, placed, -np.log1p(-MESH_OPACITY) / grid.voxel)
        images.write_whole(Path(f"{name}_mesh.glb"), content)
        yield f"wrote {name}_mesh.glb ({num_faces} faces)"


def _saved(write: Callable, content) -> bytes:
    """What `write(file, content)` writes."""
    stream = io.BytesIO()
    write(stream, content)
    return stream.getvalue()


def _check_writable(out: Path) -> None:
    """OSError if the folder can neither be written to nor be made."""
    existing = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise NotADirectoryError(20, "Not a directory", str(existing))
    if not os.access(existing, os.W_OK):
        raise PermissionError(13, "Permission denied", str(existing))
