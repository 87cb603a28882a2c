"""What one browser sees, apart from the browser: its state, what is drawn of it and when, pictures and films to keep.

Every browser has its own session: it edits its own copy of the cloud, and moves its own camera.  All sessions share the
network.
"""

import dataclasses
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats import images
from spnr_jax.method.model import Model, Quality
from spnr_jax.viewer import camera_path, picture
from spnr_jax.viewer.camera_path import Keyframe
from spnr_jax.viewer.lights import Lights, made
from spnr_jax.viewer.picture import LAYERS, Drawn, Layer
from spnr_jax.viewer.scene import Scene, encoded, select_rectangle
from spnr_jax.viewer.viewpoint import FARTHEST, View, in_pane, numbers, pane_camera, pane_size

MOVING: Quality = "draft"
MOVING_SIZE = 256  # pixels of the network's square while it moves, at most
MOVING_LONGEST, LONGEST = 960, 1600  # pixels of the canvas's longer side, while it moves and at rest
FRAMES_PER_SECOND = 16
MOST_FRAMES = 960
LONGEST_PAUSE = 10.0  # seconds between keyframes
FILMS = ("mp4", "gif")
QUALITIES: tuple[Quality, ...] = get_args(Quality)


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """All that decides a picture; `view` is None until the browser said where it looks from."""

    scene: Scene
    view: View | None = None
    panes: tuple[Layer, ...] = ("points", "picture")
    quality: Quality = "best"
    size: int
    """Pixels along a side of the network's square at rest; while the camera moves it is what the network learnt."""
    lights: Lights = Lights()
    keyframes: tuple[Keyframe, ...] = ()
    splats: bool = False
    """Whether the browser draws its splats, which is in the middle of the canvas."""

    @property
    def shown(self) -> tuple[Layer, ...]:
        """The panes of the canvas, one left free for the splats: the middle one, or all."""
        if not self.splats:
            return self.panes
        return (self.panes[0], "splats", self.panes[1]) if len(self.panes) == 2 else ("splats",)


def sizes(model: Model) -> tuple[int, ...]:
    """Sizes that can be chosen: 256 or the smaller size that the network was trained for, twice and four times that."""
    return tuple(factor * min(model.config.image_resolution, MOVING_SIZE) for factor in (1, 2, 4))


def chosen(model: Model, layers: Sequence[Any], quality: Any, size: Any) -> dict[str, Any]:
    """Fields of the state for what the controls say, "none" being no pane; ValueError for what they do not offer."""
    panes, sides = tuple(layer for layer in layers if layer != "none"), {str(n): n for n in sizes(model)}
    if not panes or any(pane not in LAYERS for pane in panes):
        raise UserError(f"a pane shows one of {', '.join(LAYERS)}")
    if quality not in QUALITIES or str(size) not in sides:
        raise UserError(f"a picture at rest has one of {', '.join(QUALITIES)}, and {', '.join(sides)} pixels")
    return {"panes": panes, "quality": quality, "size": sides[str(size)]}


def draw(model: Model, state: State, moving: bool) -> tuple[State, Drawn | None]:
    """(the state with its cloud encoded and its light made, the canvas): nothing before the browser said its view.

    Moving: `draft`, at the network's own size.  At rest: the chosen quality and size.
    """
    if state.view is None:
        return state, None
    view, state = state.view, prepared(model, state)
    quality, size = (MOVING, sizes(model)[0]) if moving else (state.quality, state.size)
    longest = MOVING_LONGEST if moving else LONGEST
    return state, picture.draw(model, state.scene, view, state.shown, quality, size, longest, **shone(state))


def prepared(model: Model, state: State) -> State:
    """The state with a volume of the cloud and the light of the controls as they are now."""
    return dataclasses.replace(state, scene=encoded(model, state.scene), lights=made(state.lights))


def shone(state: State) -> dict[str, Any]:
    """What `picture.draw` takes of the light of a prepared state."""
    return {"light": state.lights.light, "background": state.lights.options.background}


def outline(model: Model, state: State) -> np.ndarray | None:
    """The canvas without the network, which may have to be compiled first: points at once."""
    if state.view is None:
        return None
    return picture.draw(model, state.scene, state.view, state.shown, None, state.size, MOVING_LONGEST).image


def snapshot(model: Model, state: State) -> bytes:
    """The canvas at rest as a PNG file; without the splats, which are the browser's."""
    if state.view is None:
        raise UserError("nothing was drawn yet")
    view, state = state.view, prepared(model, state)
    drawn = picture.draw(model, state.scene, view, state.panes, state.quality, state.size, LONGEST, **shone(state))
    return images.png(drawn.image)


def keyframe(view: View, target: np.ndarray) -> Keyframe:
    """The view as a keyframe; `target` (3,) is the point of the box that it turns around."""
    distance = float(np.linalg.norm(np.asarray(target, np.float64) - view.position))
    return Keyframe(position=view.position, rotation=view.rotation, distance=distance)


def path_poses(state: State, seconds: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses of the recorded path, `seconds` between keyframes; ValueError for a path too short or too long."""
    if not 0 < seconds <= LONGEST_PAUSE:
        raise UserError(f"between keyframes are 0 to {LONGEST_PAUSE:g} seconds, got {seconds:g}")
    frames = round(seconds * FRAMES_PER_SECOND * max(len(state.keyframes) - 1, 1)) + 1
    if frames > MOST_FRAMES:
        raise UserError(f"the path has {frames} frames; at most {MOST_FRAMES}: use fewer keyframes or less time")
    return camera_path.poses(state.keyframes, frames)


def film(
    model: Model,
    state: State,
    seconds: float,
    kind: Any,
    layer: Layer,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[str, bytes, str]:
    """(file name, content, reason) of the recorded path, one square pane; the reason says why not as `kind`, or ''.

    `kind` is one of FILMS, ValueError else.
    """
    if state.view is None:
        raise UserError("nothing was drawn yet")
    if kind not in FILMS or layer not in LAYERS:  # the kind becomes part of a file's name
        raise UserError(f"a film is one of {', '.join(FILMS)}, of one of {', '.join(LAYERS)}")
    begin, route, state = state.view, path_poses(state, seconds), prepared(model, state)
    frames = []
    for i, (position, rotation) in enumerate(route):
        view = dataclasses.replace(begin, position=position, rotation=rotation, width=state.size, height=state.size)
        square = (state.quality, state.size, state.size, False)
        frames.append(picture.draw(model, state.scene, view, (layer,), *square, **shone(state)).image)
        progress((i + 1) / len(route))
    with tempfile.TemporaryDirectory(prefix="spnr-view-") as folder:
        path, reason = images.write_turntable(Path(folder) / f"path.{kind}", frames, FRAMES_PER_SECOND)
        return path.name, path.read_bytes(), reason


def record(target: Any) -> Callable[[State], State]:
    """The change that adds the view as a keyframe; `target` (3,) is the point of the box that it turns around.

    A target that is no point near the box, and keyframes beyond MOST_FRAMES, change nothing.
    """
    point = numbers(target, 3)

    def change(state: State) -> State:
        if state.view is None or point is None or not (np.abs(point) < FARTHEST).all():
            return state
        if len(state.keyframes) >= MOST_FRAMES:
            return state
        return dataclasses.replace(state, keyframes=(*state.keyframes, keyframe(state.view, point)))

    return change


def without_keyframes(state: State) -> State:
    """The state with no recorded path."""
    return dataclasses.replace(state, keyframes=())


def select(state: State, low: Any, high: Any, add: bool) -> State:
    """The state with the points selected that lie between two corners of the canvas, (x, y) in shares of its size.

    Corners that are not two finite numbers select nothing.
    """
    low, high = numbers(low, 2), numbers(high, 2)
    if state.view is None or low is None or high is None:
        return state
    low, high = np.clip(low, -1, 2), np.clip(high, -1, 2)  # a little outside is as good as far outside
    count = len(state.shown)
    width, height = pane_size(state.view, count, LONGEST)
    camera = pane_camera(state.view, state.scene.volume, width, height)
    middle = (low[0] + high[0]) / 2
    corners = [in_pane(x, y, middle, count) for x, y in (low, high)]
    return dataclasses.replace(state, scene=select_rectangle(state.scene, camera, corners[0], corners[1], add))


def pace(measured: Mapping[tuple[Quality, int], float]) -> str:
    """Markdown: the newest milliseconds of each quality measured here, with the pixels drawn."""
    rows = [f"| {quality} | {ms:.0f} ({size}²) |" for (quality, size), ms in sorted(measured.items())]
    return "\n".join(["| quality | ms here |", "|---|---:|", *rows])
