"""The surface of an object as a .glb file, with the materials of the nearest points: made of a network's pictures.

A grid lies over the box of an object, along the axes of its file.  A place's solidity is what the pictures show (as
Curless and Levoy 1996).  A picture votes for a place being outside by how far it lies before the picture's depth,
between -1 and 1 in units of BAND steps of the grid, and by 1 where the picture is empty there.  The depth is the least
around a pixel, else outlines would be cut off by the pixels that they cross.  The AGREE-th largest of the votes counts:
the mean, as for depth cameras, would let the far side of a thin wall fill what lies before it.  What no picture sees is
solid, so the surface is closed.

Marching cubes finds where the solidity crosses one half.  glTF has colours for each vertex but roughness and metallic
only as textures or for whole primitives: each vertex points into one small texture that holds every pair of the two, a
ramp, so the surface stays one mesh whose faces share their vertices, with one material.
Coordinates are those of the file that the points came from, whatever its upward axis.
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError
from spnr_jax.formats import images
from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.kernels.records import Camera, Volume
from spnr_jax.method.model import Model
from spnr_jax.surfels.gaussians import View, nearest_around
from spnr_jax.tools import splat_making

GRID = 192  # places along each side of the box
AGREE = 4  # pictures; with 3 solid objects are a little sharper, and thin parts are missing
BAND = 3.5  # steps of the grid before and behind the surface


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
    cameras = jax.tree.map(lambda *x: jnp.stack(x), *(view.camera for view in views))
    depth = jnp.stack([nearest_around(view.depth).astype(np.float32) for view in views])
    band = jnp.float32(BAND * 2 / (resolution - 1))
    steps = np.linspace(-1, 1, resolution, dtype=np.float32)
    plane = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    rotation, scale = placed.rotation.astype(np.float32), float(volume.scale)
    values = np.empty((resolution,) * 3, np.float32)
    for i, x in enumerate(steps):  # a plane at a time
        places = np.concatenate([np.full_like(plane[:, :1], x), plane], axis=-1) @ rotation.T
        values[i] = np.asarray(_solid(cameras, depth, band, places)).reshape(resolution, resolution)
    return Grid(
        values=values,
        lowest=placed.rotation.T @ np.asarray(volume.centre, np.float64) - 1 / scale,
        spacing=2 / (resolution - 1) / scale,
        origin=placed.origin,
    )


@jax.jit
def _solid(
    cameras: Camera, depth: Float[Array, "views h w"], band: Float[Array, ""], places: Float[Array, "places 3"]
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
    most, _ = jax.lax.scan(outvoted, most, (cameras.cam_to_world, cameras.intrinsics, depth))
    return (1 - most[0]) / 2


SURFACE = 0.5  # solidity
NEAREST = 4  # points whose materials a vertex takes the mean of
RAMP = 52  # texels along each side of the ramp: steps of 5 in 8 bits, so what lies between them is exact
ARRAY_BUFFER, INDEX_BUFFER, FLOAT, UNSIGNED = 34962, 34963, 5126, 5125  # numbers of the glTF specification
LINEAR, CLAMPED = 9729, 33071


class Solid(NamedTuple):
    """A .glb file, its number of faces, and whether its surface is closed: each edge lies between two faces."""

    content: bytes
    faces: int
    watertight: bool


def mesh_of_volume(model: Model, volume: Volume, placed: PlacedCloud, resolution: int = GRID) -> Solid:
    """The mesh of a cloud that is encoded, from a grid of so many places along each side of the box."""
    views = splat_making.draw_views(model, volume, splat_making.fitting_cameras(model, volume))
    return mesh_of(solidity(views, volume, placed, resolution), placed)


def describe(solid: Solid) -> str:
    """What a mesh is, behind the name of its file."""
    return f"{solid.faces:,} faces, {'watertight' if solid.watertight else 'not watertight'}"


def mesh_of(grid: Grid, placed: PlacedCloud) -> Solid:
    """The surface of a grid of solidity, 0 outside to 1 inside; ValueError if there is none."""
    from skimage.measure import marching_cubes  # here, so that rendering alone stays quick

    from spnr_jax.formats.surface_points import vertex_normals

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
    color, roughness, metallic = (m[nearest].mean(axis=1) for m in (cloud.base_color, cloud.roughness, cloud.metallic))
    columns = {
        "POSITION": vertices,
        "NORMAL": vertex_normals(vertices, faces),
        "COLOR_0": color,
        "TEXCOORD_0": (np.stack([roughness, metallic], axis=-1) * (RAMP - 1) + 0.5) / RAMP,
    }
    arrays = {name: np.asarray(values, np.float32) for name, values in columns.items()}
    return Solid(glb(arrays, faces.astype(np.uint32).ravel(), grid.origin), len(faces), is_closed(faces))


def is_closed(faces: Int[np.ndarray, "faces 3"]) -> bool:
    """Whether each edge lies between two faces that agree which side is outside."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    there, back = (np.sort(edges[:, i] << 32 | edges[:, 1 - i]) for i in (0, 1))
    return bool((there[1:] != there[:-1]).all() and (there == back).all())


def ramp() -> Float[np.ndarray, "metallic roughness 3"]:
    """The texture: roughness grows to the right in green, metallic downwards in blue, as glTF reads them."""
    metallic, roughness = np.meshgrid(*[np.linspace(0, 1, RAMP, dtype=np.float32)] * 2, indexing="ij")
    return np.stack([np.zeros_like(roughness), roughness, metallic], axis=-1)


def glb(arrays: dict[str, np.ndarray], indices: np.ndarray, translation: np.ndarray) -> bytes:
    """A binary glTF 2.0 file of one mesh of float32 columns and uint32 indices; vertex colours are linear, as in glTF.

    Its only buffer holds the columns, the indices and the picture of the ramp, in this order.
    """
    stored = [*arrays.values(), indices]
    pieces = [array.tobytes() for array in stored] + [images.png(ramp())]
    views, content = [], b""
    for number, piece in enumerate(pieces):
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": len(piece)})
        if number < len(stored):
            views[-1]["target"] = ARRAY_BUFFER if number < len(arrays) else INDEX_BUFFER
        content += piece + bytes(-len(piece) % 4)
    accessors: list[dict] = [
        {"bufferView": number, "componentType": FLOAT, "count": len(array), "type": f"VEC{array.shape[1]}"}
        for number, array in enumerate(arrays.values())
    ]
    position = arrays["POSITION"]
    accessors[0] |= {"min": position.min(axis=0).tolist(), "max": position.max(axis=0).tolist()}
    accessors += [{"bufferView": len(arrays), "componentType": UNSIGNED, "count": len(indices), "type": "SCALAR"}]
    numbers = {name: number for number, name in enumerate(arrays)}
    shine = {"metallicRoughnessTexture": {"index": 0}, "metallicFactor": 1, "roughnessFactor": 1}
    document = {
        "asset": {"version": "2.0", "generator": "spnr_jax"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | ({"translation": translation.tolist()} if translation.any() else {})],
        "meshes": [{"primitives": [{"attributes": numbers, "indices": len(arrays), "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": shine}],
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"bufferView": len(views) - 1, "mimeType": "image/png"}],
        "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMPED, "wrapT": CLAMPED}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
