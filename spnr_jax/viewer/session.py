"""What one browser sees, apart from the browser: its state, what is drawn of it and when, pictures and films to keep.

Every browser has its own session: it edits its own copy of the cloud, and moves its own camera.  All sessions share the
network.
"""

import dataclasses
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from spnr_jax import images
from spnr_jax.model import Model, Quality
from spnr_jax.viewer import path as camera_path
from spnr_jax.viewer import picture
from spnr_jax.viewer.path import Keyframe
from spnr_jax.viewer.picture import Drawn, Layer
from spnr_jax.viewer.scene import Scene, encoded, select_rectangle
from spnr_jax.viewer.views import View, in_pane, pane_camera, pane_size

MOVING: Quality = "draft"
MOVING_LONGEST, LONGEST = 960, 1600  # pixels of the canvas's longer side, while it moves and at rest
FRAMES_PER_SECOND = 16
MOST_FRAMES = 960


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """All that decides a picture; `view` is None until the browser said where it looks from."""

    scene: Scene
    view: View | None = None
    panes: tuple[Layer, ...] = ("points", "picture")
    quality: Quality = "best"
    size: int
    """Pixels along a side of the network's square at rest; while the camera moves it is what the network learnt."""
    keyframes: tuple[Keyframe, ...] = ()


def sizes(model: Model) -> tuple[int, ...]:
    """Sizes that can be chosen: what the network was trained for, twice and four times that."""
    return tuple(factor * model.config.image_resolution for factor in (1, 2, 4))


def draw(model: Model, state: State, moving: bool) -> tuple[State, Drawn | None]:
    """(the state with its cloud encoded, the canvas): nothing before the browser said where it looks from.

    Moving: `draft`, at the network's own size.  At rest: the chosen quality and size.
    """
    if state.view is None:
        return state, None
    view, state = state.view, dataclasses.replace(state, scene=encoded(model, state.scene))
    quality, size = (MOVING, sizes(model)[0]) if moving else (state.quality, state.size)
    longest = MOVING_LONGEST if moving else LONGEST
    return state, picture.draw(model, state.scene, view, state.panes, quality, size, longest)


def outline(model: Model, state: State) -> np.ndarray | None:
    """The canvas without the network, which may have to be compiled first: points at once."""
    if state.view is None:
        return None
    return picture.draw(model, state.scene, state.view, state.panes, None, state.size, MOVING_LONGEST).image


def snapshot(model: Model, state: State) -> bytes:
    """The canvas at rest as a PNG file."""
    if state.view is None:
        raise ValueError("nothing was drawn yet")
    scene = encoded(model, state.scene)
    return images.png(picture.draw(model, scene, state.view, state.panes, state.quality, state.size, LONGEST).image)


def keyframe(view: View, target: np.ndarray) -> Keyframe:
    """The view as a keyframe; `target` (3,) is the point of the box that it turns around."""
    distance = float(np.linalg.norm(np.asarray(target, np.float64) - view.position))
    return Keyframe(position=view.position, rotation=view.rotation, distance=distance)


def path_poses(state: State, seconds: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses of the recorded path, `seconds` between keyframes; ValueError for a path too short or too long."""
    frames = round(seconds * FRAMES_PER_SECOND * max(len(state.keyframes) - 1, 1)) + 1
    if frames > MOST_FRAMES:
        raise ValueError(f"the path has {frames} frames; at most {MOST_FRAMES}: use fewer keyframes or less time")
    return camera_path.poses(state.keyframes, frames)


def film(
    model: Model,
    state: State,
    seconds: float,
    kind: Literal["mp4", "gif"],
    layer: Layer,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[str, bytes, str]:
    """(file name, content, reason) of the recorded path, one square pane; the reason says why not as `kind`, or ''."""
    if state.view is None:
        raise ValueError("nothing was drawn yet")
    scene, route = encoded(model, state.scene), path_poses(state, seconds)
    frames = []
    for i, (position, rotation) in enumerate(route):
        view = dataclasses.replace(
            state.view, position=position, rotation=rotation, width=state.size, height=state.size
        )
        frames.append(picture.draw(model, scene, view, (layer,), state.quality, state.size, state.size, False).image)
        progress((i + 1) / len(route))
    with tempfile.TemporaryDirectory(prefix="spnr-view-") as folder:
        path, reason = images.write_turntable(Path(folder) / f"path.{kind}", frames, FRAMES_PER_SECOND)
        return path.name, path.read_bytes(), reason


def record(target: np.ndarray) -> Callable[[State], State]:
    """The change that adds the view as a keyframe; `target` (3,) is the point of the box that it turns around."""

    def change(state: State) -> State:
        if state.view is None:
            return state
        return dataclasses.replace(state, keyframes=(*state.keyframes, keyframe(state.view, target)))

    return change


def without_keyframes(state: State) -> State:
    """The state with no recorded path."""
    return dataclasses.replace(state, keyframes=())


def select(state: State, low: tuple[float, float], high: tuple[float, float], add: bool) -> State:
    """The state with the points selected that lie between two corners of the canvas, (x, y) in shares of its size."""
    if state.view is None:
        return state
    count = len(state.panes)
    width, height = pane_size(state.view, count, LONGEST)
    camera = pane_camera(state.view, state.scene.volume, width, height)
    middle = (low[0] + high[0]) / 2
    corners = [in_pane(x, y, middle, count) for x, y in (low, high)]
    return dataclasses.replace(state, scene=select_rectangle(state.scene, camera, corners[0], corners[1], add))
