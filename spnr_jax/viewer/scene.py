"""The object that one browser shows: its cloud, which points are selected, and the volume that the network sees.

Everything is a pure function from scene to scene.  An edit leaves the volume behind (`stale`) until `encoded` makes it
anew, so that a stream of edits, as from a slider, is encoded once for each picture.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from spnr_jax.errors import UserError
from spnr_jax.formats.images import to_uint8
from spnr_jax.kernels.colors import linear_to_srgb, srgb_to_linear
from spnr_jax.kernels.records import Camera, PointCloud, Volume
from spnr_jax.method.model import Model
from spnr_jax.viewer.viewpoint import numbers, project

Material = Literal["base_color", "roughness", "metallic"]
RADIUS_PER_SPACING = 0.7
LONE_RADIUS = 0.05  # boxes, of a point without another


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A cloud, as read and as edited; `selected` (points,) is what an edit changes, none selected means all."""

    name: str
    original: PointCloud
    cloud: PointCloud
    selected: np.ndarray
    shown: np.ndarray
    """The points' base colour as sRGB (points, 3) uint8."""
    volume: Volume
    radius: float
    """Of the disc that stands for a point: a share of the median distance to the nearest other."""
    stale: bool = False


def open_scene(model: Model, cloud: PointCloud, name: str) -> Scene:
    """The scene of a cloud that was just read; ValueError if it cannot be encoded."""
    volume = model.encode(cloud)
    radius = disc_radius(np.asarray(cloud.positions), float(volume.scale))
    nothing = np.zeros(len(cloud.positions), bool)
    return Scene(
        name=name, original=cloud, cloud=cloud, selected=nothing, shown=_shown(cloud), volume=volume, radius=radius
    )


def disc_radius(positions: np.ndarray, scale: float) -> float:
    """Radius in the cloud's units with which discs just close a surface of the points; `scale` is into the box."""
    distinct = np.unique(positions, axis=0)
    if len(distinct) < 2:
        return LONE_RADIUS / scale
    distances, _ = cKDTree(distinct).query(distinct, 2)
    return RADIUS_PER_SPACING * float(np.median(distances[:, 1]))


def encoded(model: Model, scene: Scene) -> Scene:
    """The scene with a volume of the cloud as it is now."""
    return dataclasses.replace(scene, volume=model.encode(scene.cloud), stale=False) if scene.stale else scene


def affected(scene: Scene) -> np.ndarray:
    """Mask (points,) of what an edit changes: the selected points, or all."""
    return scene.selected if scene.selected.any() else np.ones_like(scene.selected)


def edited(scene: Scene, material: Material, value: Any) -> Scene:
    """The scene with a material of the affected points set; base colour is sRGB in [0, 1], the rest in [0, 1]."""
    new = material_value(material, value)
    if material == "base_color":
        new = np.asarray(srgb_to_linear(jnp.asarray(new)))
    values = np.array(getattr(scene.cloud, material))
    values[affected(scene)] = new
    return _with_cloud(scene, dataclasses.replace(scene.cloud, **{material: values}))


def material_value(material: Material, value: Any) -> np.ndarray:
    """A control's value, () or of a colour (3,), in [0, 1]; ValueError for one that is no finite number."""
    new = numbers(value, 3) if material == "base_color" else numbers(value)
    if new is None:
        raise UserError(f"{material} has to be {'3 numbers' if material == 'base_color' else 'a number'} from 0 to 1")
    return np.asarray(np.clip(new, 0, 1), np.float32)


def restored(scene: Scene) -> Scene:
    """The scene with the materials of the file."""
    return _with_cloud(scene, scene.original)


def _with_cloud(scene: Scene, cloud: PointCloud) -> Scene:
    return dataclasses.replace(scene, cloud=cloud, shown=_shown(cloud), stale=True)


def _shown(cloud: PointCloud) -> np.ndarray:
    return to_uint8(linear_to_srgb(jnp.asarray(cloud.base_color)))


def mean_materials(scene: Scene) -> tuple[tuple[int, int, int], float, float]:
    """(base colour in sRGB 0..255, roughness, metallic), means over the affected points: what the controls show."""
    points = affected(scene)
    red, green, blue = (round(float(channel)) for channel in scene.shown[points].mean(axis=0))
    roughness, metallic = (float(np.mean(values[points])) for values in (scene.cloud.roughness, scene.cloud.metallic))
    return (red, green, blue), round(roughness, 2), round(metallic, 2)


def select_rectangle(
    scene: Scene, camera: Camera, low: tuple[float, float], high: tuple[float, float], add: bool
) -> Scene:
    """The scene with the points selected that the camera sees between two corners, near and far ones alike.

    Corners (x, y) are shares of the image's width and height from its upper left; `add` keeps what was selected.
    """
    pixels, _ = project(camera, np.asarray(scene.cloud.positions))
    share = pixels / (camera.width, camera.height)
    inside = np.all((share >= np.minimum(low, high)) & (share <= np.maximum(low, high)), axis=-1)
    return dataclasses.replace(scene, selected=np.logical_or(inside, scene.selected & add))


def select_all(scene: Scene) -> Scene:
    """The scene with no selection: edits change all points."""
    return dataclasses.replace(scene, selected=np.zeros_like(scene.selected))
