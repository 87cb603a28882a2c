"""The surface in a network's pictures: its depth, and Gaussian splats on it.

Rendering.depth is sum_i w_i t_i + (1 - acc) t_far, with the far side of the box: behind the object at silhouettes.
`surface_depth` solves for sum_i w_i t_i / acc; pixels with acc < HIT have none.

Splats (surfels/gaussians.py) are placed on this surface and coloured from pictures all around.
"""

import dataclasses
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Encoded, Gaussians, Light, PointCloud, Rendering, SurfelScene
from spnr_jax.method.model import DISTANCE, Model
from spnr_jax.method.surfel_method import encode_in_box
from spnr_jax.surfels import gaussians
from spnr_jax.surfels.gaussians import View
from spnr_jax.surfels.sides import spiral

HIT = 0.5  # opacity from which a pixel has a depth
VIEWS, RESOLUTION = 32, 512  # pictures, and their pixels along each side


def surface_depth(rendering: Rendering, camera: Camera, volume: Encoded) -> np.ndarray:
    """Distance (h, w) float32 along the ray to what is hit, in the cloud's units; NaN where nothing is."""
    depth, acc = np.asarray(rendering.depth, np.float64), np.asarray(rendering.acc, np.float64)
    far = np.asarray(_far(camera, volume.centre, volume.scale, size=depth.shape), np.float64)
    hit = (depth - (1 - acc) * far) / np.maximum(acc, HIT)
    return np.where(acc >= HIT, hit, np.nan).astype(np.float32)


@partial(jax.jit, static_argnames="size")
def _far(
    camera: Camera, centre: Float[Array, "3"], scale: Float[Array, ""], *, size: tuple[int, int]
) -> Float[Array, "h w"]:
    """Distance at which each ray leaves the box."""
    rays = cameras.camera_rays(cameras.resize(camera, *size))
    return cameras.intersect_box((rays.origins - centre[None, None]) * scale, rays.directions)[1] / scale


def draw_around(model: Model, volume: Encoded, light: Light | None, count: int, resolution: int) -> list[View]:
    """The network's pictures from even directions, from the top down along a spiral; the cameras are in the box."""
    x, y, z = spiral(count).T
    angles = zip(np.degrees(np.arctan2(z, x)), np.degrees(np.arcsin(y)), strict=True)
    viewpoints = [model.camera(volume, float(azimuth), float(height), resolution) for azimuth, height in angles]
    found, centre, scale = [], np.asarray(volume.centre), np.asarray(volume.scale)
    for camera, drawn in zip(viewpoints, model.render_each(volume, viewpoints, lights=[light] * count), strict=True):
        image, opacity = np.asarray(drawn.image), np.asarray(drawn.acc)
        depth = surface_depth(drawn, camera, volume) * scale
        times = len(image) // len(opacity)  # of a network that enlarges its pictures
        opacity, depth = (x.repeat(times, axis=0).repeat(times, axis=1) for x in (opacity, depth))
        pose = np.array(camera.cam_to_world)
        pose[:, 3] = (pose[:, 3] - centre) * scale
        inside = dataclasses.replace(camera, cam_to_world=pose, intrinsics=np.asarray(camera.intrinsics))
        found.append(View(inside, image, opacity, depth))
    return found


def splats(
    model: Model,
    cloud: PointCloud,
    *,
    light: Light | None = None,
    degree: int = 1,
    most: int = 150_000,
    views: int = VIEWS,
    resolution: int = RESOLUTION,
    volume: Encoded | None = None,
) -> Gaussians:
    """Gaussian splats of a cloud as the network draws it, in the cloud's units, y up: what splat viewers show.

    The network draws `views` pictures of `resolution` pixels in the light; splats, at most `most`, lie on the surface
    that these show, with colours as spherical harmonics of a `degree` 0 to 3.  ValueError if the pictures show no
    surface.  `volume` is that of the cloud, where it was encoded before.  `spnr_jax.write_splats` writes splats.
    """
    volume = model.encode(cloud) if volume is None else volume
    pictures = draw_around(model, volume, light, views, resolution)
    centre, scale = np.asarray(volume.centre), np.asarray(volume.scale)
    if isinstance(volume, SurfelScene):
        scene = volume
    else:
        inside = np.clip((np.asarray(cloud.positions) - centre) * scale, -1, 1).astype(np.float32)
        scene = encode_in_box(dataclasses.replace(cloud, positions=inside))
    focal = float(np.asarray(pictures[0].camera.intrinsics)[0, 0])
    surface = gaussians.collect_surface(pictures, scene.surfels)
    grey, side = gaussians.place_splats(surface, most=most, pixel=DISTANCE / focal)
    splatted = jax.tree.map(np.asarray, gaussians.color_splats(grey, pictures, side=side, degree=degree))
    return splatted.replace(position=splatted.position / scale + centre, scale=splatted.scale / scale)
