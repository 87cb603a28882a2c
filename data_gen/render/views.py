"""What the network is shown: pictures of an asset, and which of its points each picture sees.

Conventions: cam_to_world is (4, 4), OpenGL axes (x right, y up, looking along -z), as in NeRF's transforms.json. Images
are square, row 0 on top; pixel (column i, row j) covers [i, i + 1) x [j, j + 1), so its centre is at + 0.5.
Linear radiance comes out of Mitsuba premultiplied by the coverage (alpha): the light itself is hidden from the camera.
An object's scene is loaded once and every view is rendered from it. Mitsuba reads the very arrays of the Material that
the point sampler reads, so the picture and the points cannot disagree about a colour. Every face is seen from both
sides, whatever its file says, and keeps its one normal. Roughness and metallic may also be one value for each vertex of
their part, (vertices,), as a reconstructed surface has them; base colours of vertices are the part's `colors`.

Which points a picture sees is the paper's rule: all points on a face that any primary ray of the camera hits; a point
on such a face counts even where another part hides it.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_gen.render.variant import mitsuba_module
from spnr_jax.formats.assets import Asset, Part
from spnr_jax.formats.data_sets import on_white
from spnr_jax.kernels.imaging import linear_to_srgb

POLE_COSINE = 0.999  # nearer to the y axis than this, z takes the part of "up"


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """How the cameras stand and how finely they see; the unit sphere just fits at 40 degrees and distance 3."""

    resolution: int = 64
    views: int = 10
    fov: float = 40.0  # degrees, of the image's width
    distance: float = 3.0  # from the origin, in units of the normalised object
    spp: int = 64  # samples per pixel
    max_depth: int = 6  # path segments: light - object - object - camera is 3
    visibility_grid: int = 4  # rays per pixel side that look for visible faces

    @property
    def focal_length(self) -> float:
        """The focal length in pixels."""
        return 0.5 * self.resolution / np.tan(np.radians(self.fov) / 2)


@dataclass(frozen=True)
class Scene:
    """A loaded Mitsuba scene and the global number of each shape's first face, by the number that Mitsuba reports."""

    handle: Any
    first_face: dict[int, int]


def look_at(eye: np.ndarray) -> np.ndarray:
    """Cam_to_world (4, 4) of a camera at `eye` that looks at the origin, y up (z up at the poles)."""
    backward = eye / np.linalg.norm(eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(backward[1]) > POLE_COSINE else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    cam_to_world = np.eye(4)
    cam_to_world[:3] = np.stack([right, np.cross(backward, right), backward, eye], axis=1)
    return cam_to_world


def random_viewpoints(num_views: int, distance: float, rng: np.random.Generator) -> np.ndarray:
    """Cam_to_world (views, 4, 4) of cameras spread uniformly at random over the sphere."""
    eyes = rng.standard_normal((num_views, 3))
    return np.stack([look_at(distance * eye / np.linalg.norm(eye)) for eye in eyes])


def project(cam_to_world: np.ndarray, positions: np.ndarray, config: ViewConfig) -> np.ndarray:
    """The image coordinates (points, 2) of positions (points, 3) before the camera: x right, y down, pixels."""
    local = (positions - cam_to_world[:3, 3]) @ cam_to_world[:3, :3]
    plane = local[:, :2] / -local[:, 2:] * [1, -1]
    return config.focal_length * plane + config.resolution / 2


def build_scene(asset: Asset, envmap: np.ndarray) -> Scene:
    """The asset under the light of the map (height, width, 3), one Mitsuba shape for each part with faces."""
    return lit_scene(mitsuba_shapes(asset), envmap)


def mitsuba_shapes(asset: Asset) -> dict[str, tuple]:
    """A Mitsuba mesh for each part with faces, and the number of the asset's faces before it, by name."""
    shapes, faces_before = {}, 0
    for number, part in enumerate(asset.parts):
        if len(part.faces):
            name = f"part_{number:05d}"
            shapes[name] = mitsuba_mesh(part, name), faces_before
        faces_before += len(part.faces)
    return shapes


def lit_scene(shapes: dict[str, tuple], envmap: np.ndarray) -> Scene:
    """The shapes under the light of the map (height, width, 3)."""
    mi = mitsuba_module()
    light = {"type": "envmap", "bitmap": mi.Bitmap(np.asarray(envmap, np.float32))}
    handle = mi.load_dict({"type": "scene", "light": light} | {name: mesh for name, (mesh, _) in shapes.items()})
    first_faces = [first for _, first in shapes.values()]
    return Scene(handle, dict(zip(shape_numbers(handle), first_faces, strict=True)))


def shape_numbers(handle) -> list[int]:
    """What Mitsuba's `shape_index` is for each shape of a loaded scene, in the order of the scene.

    Scalar code counts the scene's shapes from 1; compiled variants report a number of the whole process, which goes on
    counting from one scene to the next and gives numbers of freed shapes out again.
    """
    mi = mitsuba_module()
    if mi.variant().startswith("scalar"):
        return list(range(1, len(handle.shapes()) + 1))
    drjit = importlib.import_module("drjit")
    return [int(number) for number in np.array(drjit.reinterpret_array(mi.UInt32, handle.shapes_dr()))]


def mitsuba_mesh(part: Part, name: str):
    """The part as a Mitsuba mesh with its material; without normals of its own it is shaded flat."""
    mi = mitsuba_module()
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "inner": principled(part)})
    channels = part.material.base_color, part.material.roughness, part.material.metallic
    textured = max(map(np.ndim, channels)) > 1
    mesh = mi.Mesh(
        name,
        vertex_count=len(part.positions),
        face_count=len(part.faces),
        has_vertex_normals=part.normals is not None,
        has_vertex_texcoords=textured,
        props=properties,
    )
    if part.colors is not None:
        tinted = np.asarray(part.colors) * part.material.base_color
        mesh.add_attribute("vertex_color", 3, np.ascontiguousarray(tinted, np.float32).ravel())
    for name in ("roughness", "metallic"):
        if np.ndim(channel := getattr(part.material, name)) == 1:
            mesh.add_attribute(f"vertex_{name}", 1, np.ascontiguousarray(channel, np.float32))
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = np.asarray(part.positions, np.float32).ravel()
    buffers["faces"] = np.asarray(part.faces, np.uint32).ravel()
    if part.normals is not None:
        buffers["vertex_normals"] = np.asarray(part.normals, np.float32).ravel()
    if textured:
        buffers["vertex_texcoords"] = np.asarray(part.texcoords, np.float32).ravel()
    buffers.update()
    return mesh


def principled(part: Part) -> dict:
    """The part's material as a description of Mitsuba's principled BSDF."""
    material = part.material
    if part.colors is not None:
        base_color: dict = {"type": "mesh_attribute", "name": "vertex_color"}
    elif np.ndim(material.base_color) == 3:
        base_color = bitmap_texture(material.base_color, material.wrap)
    else:
        base_color = {"type": "rgb", "value": [float(channel) for channel in material.base_color]}
    inner: dict = {"type": "principled", "base_color": base_color}
    for name in ("roughness", "metallic"):
        channel = getattr(material, name)
        if np.ndim(channel) == 1:
            inner[name] = {"type": "mesh_attribute", "name": f"vertex_{name}"}
        else:
            inner[name] = bitmap_texture(channel[..., None], material.wrap) if np.ndim(channel) == 2 else float(channel)
    return inner


def bitmap_texture(texels: np.ndarray, wrap: str) -> dict:
    """The texels (height, width, channels) as a Mitsuba texture, taken as they are (linear), bilinear."""
    mi = mitsuba_module()
    bitmap = mi.Bitmap(np.ascontiguousarray(texels, dtype=np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": wrap}


def make_sensor(cam_to_world: np.ndarray, config: ViewConfig, resolution: int):
    """A Mitsuba camera with square pixels; a box filter, so that each pixel is the mean of its own rays."""
    mi = mitsuba_module()
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": config.fov,
            "fov_axis": "x",
            "near_clip": 0.01,
            "far_clip": 100.0,
            "to_world": mi.ScalarTransform4f(cam_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])),
            "film": {**film, "pixel_format": "rgba", "component_format": "float32"},
            "sampler": {"type": "multijitter", "sample_count": config.spp},
        }
    )


def render_view(scene: Scene, cam_to_world: np.ndarray, config: ViewConfig, seed: int) -> np.ndarray:
    """The picture (height, width, 4): linear radiance premultiplied by alpha, and alpha, float32."""
    mi = mitsuba_module()
    integrator = mi.load_dict({"type": "path", "max_depth": config.max_depth, "hide_emitters": True})
    sensor = make_sensor(cam_to_world, config, config.resolution)
    image = mi.render(scene.handle, sensor=sensor, integrator=integrator, spp=config.spp, seed=seed)
    return np.array(image, dtype=np.float32)


def visible_faces(scene: Scene, cam_to_world: np.ndarray, config: ViewConfig, seed: int) -> np.ndarray:
    """The sorted global numbers of the faces that the camera's primary rays hit, one ray per cell of a grid."""
    mi = mitsuba_module()
    integrator = mi.load_dict({"type": "aov", "aovs": "face:prim_index,shape:shape_index"})
    sensor = make_sensor(cam_to_world, config, config.resolution * config.visibility_grid)
    cells = np.array(mi.render(scene.handle, sensor=sensor, integrator=integrator, spp=1, seed=seed))
    face, shape = cells.reshape(-1, cells.shape[-1]).astype(np.int64)[:, :2].T  # shape 0 is a miss
    return np.unique(np.concatenate([first + face[shape == number] for number, first in scene.first_face.items()]))


def straight_srgb(radiance: np.ndarray) -> np.ndarray:
    """(height, width, 4) uint8 sRGB with straight alpha from premultiplied linear radiance with alpha."""
    alpha = np.clip(radiance[..., 3:], 0, 1)
    color = np.where(alpha > 0, radiance[..., :3] / np.where(alpha > 0, alpha, 1), 0)
    return np.round(255 * np.concatenate([linear_to_srgb(np.clip(color, 0, 1)), alpha], axis=-1)).astype(np.uint8)


def condition_image(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(height, width, 4) uint8: the picture's colour on white, alpha 255, at the pixels (points, 2); else 0."""
    condition = np.zeros_like(image)
    columns, rows = np.floor(pixels).astype(np.int64).T
    inside = (columns >= 0) & (columns < image.shape[1]) & (rows >= 0) & (rows < image.shape[0])
    columns, rows = columns[inside], rows[inside]
    condition[rows, columns, :3] = np.round(255 * on_white(image[rows, columns]))
    condition[rows, columns, 3] = 255
    return condition


def render_views(
    asset: Asset, surface, cam_to_world: np.ndarray, envmaps: Sequence[np.ndarray], config: ViewConfig, seed: int
):
    """(images, conditions), each (views, height, width, 4) uint8, of an asset and its `SurfacePoints`.

    There is one environment map for each view, or one for all.
    """
    shapes = mitsuba_shapes(asset)
    scenes = (lit_scene(shapes, envmap) for envmap in envmaps)
    scene = next(scenes)
    images, conditions = [], []
    for view, pose in enumerate(cam_to_world):
        view_seed = (seed + view) % 2**32
        image = straight_srgb(render_view(scene, pose, config, view_seed))
        seen = np.isin(surface.face, visible_faces(scene, pose, config, view_seed))
        images.append(image)
        conditions.append(condition_image(image, project(pose, surface.positions[seen].astype(np.float64), config)))
        scene = next(scenes, scene)
    return np.stack(images), np.stack(conditions)
