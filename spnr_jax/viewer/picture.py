"""The canvas of a browser: panes beside each other, each a layer of the same view, as one picture.

points     discs of the points' base colour, selected ones ringed; drawn without the network
picture    what the network renders
depth      distance in colours, near bright
opacity    white where the object is opaque
splats     nothing: the browser draws them there
"""

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from PIL import Image, ImageDraw

from spnr_jax.formats import images
from spnr_jax.kernels.records import Camera, Light, Rendering
from spnr_jax.method.model import Model, Quality
from spnr_jax.tools.chosen_light import before
from spnr_jax.viewer import viewpoint
from spnr_jax.viewer.scene import Scene
from spnr_jax.viewer.viewpoint import View

Layer = Literal["points", "picture", "depth", "opacity", "splats"]
LAYERS: tuple[Layer, ...] = ("points", "picture", "depth", "opacity")  # that can be chosen
WITHOUT_NETWORK: tuple[Layer, ...] = ("points", "splats")
SELECTED = np.array([255, 140, 0], np.uint8)
LINE = (160, 160, 160)
TEXT = (110, 110, 110)
LARGEST_DISC = 14  # pixels of radius; nearer points grow no further
RING = 2.0  # pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """The canvas, (height, width, 3) uint8, and what the network did for it; no milliseconds if it was not asked."""

    image: np.ndarray
    quality: Quality | None
    size: int
    milliseconds: float | None


def draw(
    model: Model,
    scene: Scene,
    view: View,
    panes: tuple[Layer, ...],
    quality: Quality | None,
    size: int,
    longest: int,
    labels: bool = True,
    *,
    light: Light | None = None,
    background: str = "white",
) -> Drawn:
    """The canvas with its panes; the network draws squares of `size`, None as quality leaves its panes empty.

    `longest` bounds the pixels of the canvas's longer side; labels name the panes' layers; `background` is what stands
    behind the picture, white or the light's map.
    """
    width, height = viewpoint.pane_size(view, len(panes), longest)
    rendering, milliseconds = None, None
    if quality is not None and any(layer not in WITHOUT_NETWORK for layer in panes):
        begin = time.perf_counter()
        camera = viewpoint.square_camera(view, scene.volume, width, height, size)
        rendering = before(background, model.render(scene.volume, camera, quality, light), camera, light)
        squares = {layer: _square(rendering, layer) for layer in panes if layer not in WITHOUT_NETWORK}
        milliseconds = 1000 * (time.perf_counter() - begin)
    drawn = []
    for layer in panes:
        if layer == "points":
            picture = _points_of(scene, view, width, height)
        elif rendering is None or layer == "splats":
            picture = np.full((height, width, 3), 255, np.uint8)
        else:
            picture = viewpoint.cut(squares[layer], width, height)
        waiting = layer not in WITHOUT_NETWORK and rendering is None
        label = f"{layer}: the network is being prepared" if waiting else layer
        drawn.append(_labelled(picture, label) if labels else picture)
    return Drawn(image=_beside_each_other(drawn), quality=quality, size=size, milliseconds=milliseconds)


def _square(rendering: Rendering, layer: Layer) -> np.ndarray:
    """A layer of a rendering, (size, size, 3) uint8."""
    if layer == "picture":
        return images.to_uint8(rendering.image)
    if layer == "depth":
        return images.depth_image(rendering.depth, rendering.acc)
    return np.repeat(images.to_uint8(rendering.acc)[..., None], 3, axis=-1)


@lru_cache(maxsize=4)  # the light moves and the points stand: most of a step of the light would go here
def _points_of(scene: Scene, view: View, width: int, height: int) -> np.ndarray:
    return draw_points(scene, viewpoint.pane_camera(view, scene.volume, width, height))


def draw_points(scene: Scene, camera: Camera) -> np.ndarray:
    """The points as discs on white, near ones over far ones, selected ones ringed: (height, width, 3) uint8."""
    pixels, depth = viewpoint.project(camera, np.asarray(scene.cloud.positions))
    order = np.argsort(-depth)
    order = order[depth[order] > 0]
    rings = scene.selected.any()
    order = np.repeat(order, 1 + rings)  # every point twice, its ring first
    ring = scene.selected[order] & (np.arange(len(order)) % 2 == 0)
    radius = np.clip(scene.radius * camera.intrinsics[0, 0] / depth[order], 1.0, LARGEST_DISC) + RING * ring
    color = np.where(ring[:, None], SELECTED, scene.shown[order])
    return _discs(pixels[order], radius, color, camera.height, camera.width)


def _discs(centres: np.ndarray, radii: np.ndarray, colors: np.ndarray, height: int, width: int) -> np.ndarray:
    """Discs at pixel coordinates (n, 2) of (column, row), later ones over earlier ones, on white."""
    canvas = np.full((height, width, 3), 255, np.uint8)
    reach = int(np.ceil(radii.max(initial=1.0)))
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    centres = np.clip(centres, -1e6, 1e6)  # far outside stays outside, and fits into an integer
    column = np.floor(centres[:, :1]).astype(np.int64) + columns
    row = np.floor(centres[:, 1:]).astype(np.int64) + rows
    covered = (column + 0.5 - centres[:, :1]) ** 2 + (row + 0.5 - centres[:, 1:]) ** 2 <= radii[:, None] ** 2
    covered &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    point = np.broadcast_to(np.arange(len(centres))[:, None], covered.shape)[covered]
    canvas[row[covered], column[covered]] = colors[point]  # of several values for a pixel the last stays
    return canvas


def _labelled(picture: np.ndarray, label: str) -> np.ndarray:
    """The picture with a line of text in its lower left corner."""
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((8, picture.shape[0] - 20), label, fill=TEXT, font_size=13)
    return np.asarray(image)


def _beside_each_other(panes: list[np.ndarray]) -> np.ndarray:
    """The panes in a row, a thin line between them."""
    canvas = np.concatenate(panes, axis=1)
    for border in np.cumsum([pane.shape[1] for pane in panes])[:-1]:
        canvas[:, border] = LINE
    return canvas
