"""Gaussian splats of a cloud: the network draws it from all around, and splats are placed and coloured from that.

fitting cameras    even directions on the sphere, the same distance as `Model.camera`
splats             surfels/gaussians.py, in the box, then in the cloud's units
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from spnr_jax.kernels.records import Camera, Gaussians, Light, PointCloud, SurfelScene, Volume
from spnr_jax.method.model import DISTANCE, Model
from spnr_jax.method.surfel_method import encode_in_box
from spnr_jax.surfels import gaussians
from spnr_jax.surfels.gaussians import View
from spnr_jax.tools.commands import Lighting, Render
from spnr_jax.tools.depth_maps import surface_depth

VIEWS, RESOLUTION = 32, 512  # pictures, and their pixels along each side
GOLDEN_ANGLE = 180 * (3 - np.sqrt(5))  # degrees between the azimuths of one direction and the next


def splats(
    model: Model,
    cloud: PointCloud,
    *,
    light: Light | None = None,
    degree: int = 1,
    most: int = 150_000,
    views: int = VIEWS,
    resolution: int = RESOLUTION,
    report: Callable[[str], None] = lambda line: None,
) -> Gaussians:
    """Gaussian splats of a cloud as the network draws it, in the cloud's units, y up: what splat viewers show.

    The network draws `views` pictures of `resolution` pixels in the light; splats, at most `most`, lie on the surface
    that these show, with colours as spherical harmonics of a `degree` 0 to 3.  ValueError if the pictures show no
    surface.  `spnr_jax.write_splats` writes them.
    """
    volume = model.encode(cloud)
    return splats_of(model, volume, cloud, light, report, degree=degree, most=most, views=views, resolution=resolution)


def splats_of(
    model: Model,
    volume: Volume,
    cloud: PointCloud,
    light: Light | None,
    report: Callable[[str], None],
    *,
    degree: int,
    most: int,
    views: int,
    resolution: int = RESOLUTION,
) -> Gaussians:
    """`splats` of a cloud that is encoded already."""
    pictures = draw_views(model, volume, fitting_cameras(model, volume, views, resolution), light)
    report(f"the network drew {views} pictures of {resolution} x {resolution}")
    return in_units(splats_in_box(pictures, volume, cloud, degree, most), volume)


def splats_in_box(pictures: list[View], volume: Volume, cloud: PointCloud, degree: int, most: int) -> Gaussians:
    """Splats in the box from pictures that the network has drawn."""
    scene = volume.scene if isinstance(volume.scene, SurfelScene) else _encode_in_box(cloud, volume)
    focal = float(np.asarray(pictures[0].camera.intrinsics)[0, 0])
    seen = gaussians.collect_surface(pictures, scene.surfels)
    grey, side = gaussians.place(seen, most=most, pixel=DISTANCE / focal)
    return gaussians.color(grey, pictures, side=side, degree=degree)


def fitting_cameras(model: Model, volume: Volume, count: int = VIEWS, resolution: int = RESOLUTION) -> list[Camera]:
    """Cameras in even directions around an object, from the top down along a spiral."""
    heights = 1 - (2 * np.arange(count) + 1) / count
    azimuths = np.arange(count) * GOLDEN_ANGLE % 360
    return [
        model.camera(volume, float(azimuth), float(np.degrees(np.arcsin(height))), resolution)
        for azimuth, height in zip(azimuths, heights, strict=True)
    ]


def draw_views(model: Model, volume: Volume, cameras: list[Camera], light: Light | None = None) -> list[View]:
    """The network's pictures from cameras, with these in the box."""
    found = []
    for camera, drawn in zip(cameras, model.render_each(volume, cameras, lights=[light] * len(cameras)), strict=True):
        image, opacity = np.asarray(drawn.image), np.asarray(drawn.acc)
        depth = surface_depth(drawn, camera, volume) * np.asarray(volume.scale)
        times = len(image) // len(opacity)  # of a network that enlarges its pictures
        opacity, depth = (x.repeat(times, axis=0).repeat(times, axis=1) for x in (opacity, depth))
        found.append(View(in_box(camera, volume), image, opacity, depth))
    return found


def in_box(camera: Camera, volume: Volume) -> Camera:
    """A camera of the cloud's units in the box."""
    pose = np.array(camera.cam_to_world)
    pose[:, 3] = (pose[:, 3] - np.asarray(volume.centre)) * np.asarray(volume.scale)
    return dataclasses.replace(camera, cam_to_world=pose, intrinsics=np.asarray(camera.intrinsics))


def in_units(gaussians: Gaussians, volume: Volume) -> Gaussians:
    """The splats of the box in the cloud's units."""
    scale, arrays = np.asarray(volume.scale), jax.tree.map(np.asarray, gaussians)
    position = arrays.position / scale + np.asarray(volume.centre)
    return arrays.replace(position=position, scale=arrays.scale / scale)


def note_of(asked: Render, network: str = "") -> str:
    """The line that names cloud, network and light; the network is that of the options, or another."""
    drawn_by = Path(network or str(asked.run)).name
    return f"{asked.cloud.name}, drawn by spnr_jax ({drawn_by}), light: {light_name(asked.lighting)}"


def light_name(lighting: Lighting) -> str:
    """The light in words, without folders."""
    parts = [Path(lighting.light).name] if lighting.light else ([] if lighting.sun else ["room"])
    parts += [f"sun {lighting.sun[0]:g} {lighting.sun[1]:g}"] if lighting.sun else []
    options = {"yaw": lighting.light_yaw, "exposure": lighting.exposure}
    return " + ".join(parts) + "".join(f", {name} {value:g}" for name, value in options.items() if value)


def _encode_in_box(cloud: PointCloud, volume: Volume) -> SurfelScene:
    inside = np.clip((np.asarray(cloud.positions) - np.asarray(volume.centre)) * np.asarray(volume.scale), -1, 1)
    placed = dataclasses.replace(cloud, positions=inside.astype(np.float32))
    return encode_in_box(placed)
