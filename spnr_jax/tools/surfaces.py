"""The surface that a network's pictures from all around show: depth, Gaussian splats, a mesh with materials.

A rendering's depth is the mean distance of all the light of a ray, and what passes by counts with the far side of the
box.  At silhouettes this lies behind the object.  Here what passes is taken out again, and pixels that let most of the
light pass have no depth.

Splats (surfels/gaussians.py) are placed on this surface and coloured from the pictures.

For the mesh a grid lies over the box of an object, along the axes of its file.  A place's solidity is what the pictures
show (as Curless and Levoy 1996).  A picture votes for a place being outside by how far it lies before the picture's
depth, between -1 and 1 in units of BAND steps of the grid, and by 1 where the picture is empty there.  The depth is the
least around a pixel, else outlines would be cut off by the pixels that they cross.  The AGREE-th largest of the votes
counts: the mean, as for depth cameras, would let the far side of a thin wall fill what lies before it.  What no picture
sees is solid, so the surface is closed.  Marching cubes finds where the solidity crosses one half.

glTF has colours for each vertex but roughness and metallic only as textures or for whole primitives: each vertex points
into one small texture that holds every pair of the two, a ramp, so the surface stays one mesh whose faces share their
vertices, with one material.  Coordinates are those of the file that the points came from, whatever its upward axis.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from PIL import Image
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError
from spnr_jax.formats import images
from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Gaussians, Light, PointCloud, Rendering, SurfelScene, Volume
from spnr_jax.method.model import DISTANCE, Model
from spnr_jax.method.surfel_method import encode_in_box
from spnr_jax.surfels import gaussians
from spnr_jax.surfels.gaussians import View, nearest_around

HIT = 0.5  # opacity from which a pixel has a depth
VIEWS, RESOLUTION = 32, 512  # pictures, and their pixels along each side
GOLDEN_ANGLE = 180 * (3 - np.sqrt(5))  # degrees between the azimuths of one direction and the next
GRID = 192  # places along each side of the box
AGREE = 4  # pictures; with 3 solid objects are a little sharper, and thin parts are missing
BAND = 3.5  # steps of the grid before and behind the surface


def surface_depth(rendering: Rendering, camera: Camera, volume: Volume) -> np.ndarray:
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


def draw_around(
    model: Model, volume: Volume, light: Light | None = None, count: int = VIEWS, resolution: int = RESOLUTION
) -> list[View]:
    """The network's pictures from even directions, from the top down along a spiral; the cameras are in the box."""
    heights = 1 - (2 * np.arange(count) + 1) / count
    angles = zip(np.arange(count) * GOLDEN_ANGLE % 360, np.degrees(np.arcsin(heights)), strict=True)
    places = [model.camera(volume, float(azimuth), float(height), resolution) for azimuth, height in angles]
    found, centre, scale = [], np.asarray(volume.centre), np.asarray(volume.scale)
    for camera, drawn in zip(places, model.render_each(volume, places, lights=[light] * count), strict=True):
        image, opacity = np.asarray(drawn.image), np.asarray(drawn.acc)
        depth = surface_depth(drawn, camera, volume) * scale
        times = len(image) // len(opacity)  # of a network that enlarges its pictures
        opacity, depth = (x.repeat(times, axis=0).repeat(times, axis=1) for x in (opacity, depth))
        pose = np.array(camera.cam_to_world)
        pose[:, 3] = (pose[:, 3] - centre) * scale
        inside = dataclasses.replace(camera, cam_to_world=pose, intrinsics=np.asarray(camera.intrinsics))
        found.append(View(inside, image, opacity, depth))
    return found


# --- splats -----------------------------------------------------------------------------------------------------------


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
    resolution: int,
) -> Gaussians:
    """`splats` of a cloud that is encoded already."""
    pictures = draw_around(model, volume, light, views, resolution)
    report(f"the network drew {views} pictures of {resolution} x {resolution}")
    centre, scale = np.asarray(volume.centre), np.asarray(volume.scale)
    scene = volume.scene
    if not isinstance(scene, SurfelScene):
        inside = np.clip((np.asarray(cloud.positions) - centre) * scale, -1, 1).astype(np.float32)
        scene = encode_in_box(dataclasses.replace(cloud, positions=inside))
    focal = float(np.asarray(pictures[0].camera.intrinsics)[0, 0])
    seen = gaussians.collect_surface(pictures, scene.surfels)
    grey, side = gaussians.place(seen, most=most, pixel=DISTANCE / focal)
    made = jax.tree.map(np.asarray, gaussians.color(grey, pictures, side=side, degree=degree))
    return made.replace(position=made.position / scale + centre, scale=made.scale / scale)


# --- a mesh -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Values (x, y, z) float32; [i, j, k] lies at origin + lowest + spacing * (i, j, k) in the file's x y z.

    Places are split into an origin (3,) and a rest, so that float32 can hold what is added to it.
    """

    values: np.ndarray
    lowest: np.ndarray
    spacing: float
    origin: np.ndarray


def solidity(views: Sequence[View], volume: Volume, placed: PlacedCloud, resolution: int = GRID) -> Grid:
    """0 outside, 1 inside, 1/2 on the surface, with `resolution` places along each side of the box."""
    seen_from = jax.tree.map(lambda *x: jnp.stack(x), *(view.camera for view in views))
    depth = jnp.stack([nearest_around(view.depth).astype(np.float32) for view in views])
    band = jnp.float32(BAND * 2 / (resolution - 1))
    steps = np.linspace(-1, 1, resolution, dtype=np.float32)
    plane = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    rotation, scale = placed.rotation.astype(np.float32), float(volume.scale)
    values = np.empty((resolution,) * 3, np.float32)
    for i, x in enumerate(steps):  # a plane at a time
        places = np.concatenate([np.full_like(plane[:, :1], x), plane], axis=-1) @ rotation.T
        values[i] = np.asarray(_solid(seen_from, depth, band, places)).reshape(resolution, resolution)
    return Grid(
        values=values,
        lowest=placed.rotation.T @ np.asarray(volume.centre, np.float64) - 1 / scale,
        spacing=2 / (resolution - 1) / scale,
        origin=placed.origin,
    )


@jax.jit
def _solid(
    seen_from: Camera, depth: Float[Array, "views h w"], band: Float[Array, ""], places: Float[Array, "places 3"]
) -> Float[Array, " places"]:
    """Of places in the box, as cameras (views) with depth see them, infinite where they see nothing."""
    height, width = depth.shape[1:]

    def outvoted(largest: Float[Array, "agree places"], view: tuple) -> tuple[Array, None]:
        pose, k, there = view
        towards = places - pose[None, :, 3]
        local = jnp.matmul(towards, pose[:, :3], precision="highest")
        column = jnp.floor(k[0, 2] - k[0, 0] * local[:, 0] / local[:, 2]).astype(jnp.int32)
        row = jnp.floor(k[1, 2] + k[1, 1] * local[:, 1] / local[:, 2]).astype(jnp.int32)
        shown = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        seen = jnp.where(shown, there.ravel()[jnp.where(shown, row * width + column, 0)], jnp.inf)
        vote = jnp.clip((seen - jnp.linalg.norm(towards, axis=-1)) / band, -1, 1)
        next_larger = jnp.concatenate([largest[1:], jnp.ones_like(largest[:1])])
        return jnp.maximum(largest, jnp.minimum(vote[None], next_larger)), None

    most = jnp.full((AGREE, len(places)), -1, jnp.float32)
    most, _ = jax.lax.scan(outvoted, most, (seen_from.cam_to_world, seen_from.intrinsics, depth))
    return (1 - most[0]) / 2


SURFACE = 0.5  # solidity
NEAREST = 4  # points whose materials a vertex takes the mean of
RAMP = 52  # texels along each side of the ramp: steps of 5 in 8 bits, so what lies between them is exact


class Solid(NamedTuple):
    """A .glb file, its number of faces, and whether its surface is closed."""

    content: bytes
    faces: int
    watertight: bool


def mesh_of_volume(model: Model, volume: Volume, placed: PlacedCloud, resolution: int = GRID) -> Solid:
    """The mesh of a cloud that is encoded, from a grid of so many places along each side of the box."""
    views = draw_around(model, volume)
    return mesh_of(solidity(views, volume, placed, resolution), placed)


def mesh_of(grid: Grid, placed: PlacedCloud) -> Solid:
    """The surface of a grid of solidity, 0 outside to 1 inside; ValueError if there is none."""
    import trimesh  # here, so that rendering alone stays quick
    from skimage.measure import marching_cubes
    from trimesh.visual.material import PBRMaterial

    if not grid.values.max() > SURFACE:
        raise UserError("no surface to write as a mesh: the network's pictures show nothing solid")
    closed = np.pad(grid.values, 1)  # the surface is closed also where it meets the box
    spacing = (grid.spacing,) * 3
    vertices, faces, _, _ = marching_cubes(closed, SURFACE, spacing=spacing, gradient_direction="ascent")
    vertices = vertices - grid.spacing + grid.lowest
    points = placed.cloud.positions @ placed.rotation.astype(np.float32)  # in the file's frame, from its origin
    _, nearest = cKDTree(points).query(vertices, min(NEAREST, len(points)))
    nearest = nearest.reshape(len(vertices), -1)
    cloud = placed.cloud
    color, *shine = (m[nearest].mean(axis=1) for m in (cloud.base_color, cloud.roughness, cloud.metallic))
    material = PBRMaterial(metallicRoughnessTexture=ramp(), metallicFactor=1.0, roughnessFactor=1.0)
    uv = (np.stack([shine[0], 1 - shine[1]], axis=-1) * (RAMP - 1) + 0.5) / RAMP  # trimesh's v grows upwards
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    visual.vertex_attributes["color"] = images.to_uint8(np.pad(color, [(0, 0), (0, 1)], constant_values=1))
    mesh = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
    scene = trimesh.Scene()
    scene.add_geometry(mesh, transform=trimesh.transformations.translation_matrix(grid.origin))
    content = scene.export(file_type="glb", include_normals=True)
    return Solid(content, len(faces), mesh.is_watertight and mesh.is_winding_consistent)


def ramp() -> Image.Image:
    """The texture: roughness grows to the right in green, metallic downwards in blue, as glTF reads them."""
    metallic, roughness = np.meshgrid(*[np.linspace(0, 1, RAMP)] * 2, indexing="ij")
    return Image.fromarray(images.to_uint8(np.stack([0 * roughness, roughness, metallic], axis=-1)))
