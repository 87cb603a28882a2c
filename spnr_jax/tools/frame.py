"""The state of one browser (object, light, camera), and the frame that the network renders for it.

The browser lives in the network's box.  `field_of_view` is vertical, in radians; `reach` is the tangent of half the
field of view of a square.  The network renders squares, one program per size: in the middle of the canvas, around the
whole object or, if smaller or if there is a background, around the canvas.  `read_*` validate messages of a browser.
"""

import dataclasses
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from spnr_jax.config import Quality
from spnr_jax.errors import UserError
from spnr_jax.formats import images
from spnr_jax.formats.images import NAMES, read_light
from spnr_jax.kernels.records import Camera, Encoded, Light, PointCloud
from spnr_jax.method.model import Model
from spnr_jax.tools.commands import Background, Lighting, changed_options
from spnr_jax.tools.pictures import light_of_options, put_background

SMALLEST = 256  # pixels along a side of the network's square while things move, at most
MOVING_LONGEST, LONGEST = 960, 1600  # pixels of the canvas's longer side, while it moves and at rest
OBJECT_RADIUS = 1.2  # of a ball in the box that contains the drawn object; its points lie within 1
FARTHEST_EYE = 1e3  # boxes; beyond, float32 rays miss (docs/lab/stability.md)
LARGEST_CANVAS = 2**16  # along a side of a browser's canvas
NARROWEST, WIDEST = 1e-3, np.deg2rad(150)
OPENCV = np.diag([1.0, -1.0, -1.0])  # the browser's cameras look along +z with y down, ours along -z with y up
SUN_ALONE = "sun alone"  # the choice of no map, where there is a sun
LONGEST_NAME = 60  # characters of a file's name
LIGHT_OF_PACKAGE = cache(read_light)
Read = TypeVar("Read")


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A camera in the box: rotation columns are right, up and backward; the canvas is in pixels."""

    position: np.ndarray
    rotation: np.ndarray
    field_of_view: float
    width: int
    height: int


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """Everything that determines a frame; `light()` follows from `lighting` and `maps` and is made at first use."""

    name: str
    cloud: PointCloud
    volume: Encoded
    view: View | None = None
    quality: str = "best"
    lighting: Lighting = Lighting()
    background: Background = "white"
    maps: Mapping[str, Light] = field(default_factory=dict)
    light: Callable[[], Light | None] = lambda: None

    @property
    def lights(self) -> tuple[str, ...]:
        """Names that can be chosen."""
        return (*NAMES, *self.maps, *([SUN_ALONE] if self.lighting.sun else []))

    @property
    def light_name(self) -> str:
        """The name of the light."""
        return self.lighting.light or (SUN_ALONE if self.lighting.sun else NAMES[0])


def open_state(
    model: Model, cloud: PointCloud, name: str, lighting: Lighting, background: Background = "white"
) -> State:
    """The initial state for a cloud; ValueError if it cannot be encoded, or if the light is no map."""
    state = State(name=name, cloud=cloud, volume=model.encode(cloud), lighting=lighting, background=background)
    if lighting.light is None or lighting.light in NAMES:
        return relight(state, lighting) if changed_options(lighting) else state
    return add_map(state, display_name(Path(lighting.light).name), read_light(lighting.light))


def qualities(model: Model) -> dict[str, tuple[Quality, int]]:
    """Choices for a picture at rest, by name: quality, and pixels along a side of the network's square."""
    size = 2 * min(model.config.image_resolution, SMALLEST)
    named: dict[str, tuple[Quality, int]] = {name: (name, size) for name in ("draft", "balanced", "best")}
    return named | {"best, twice the pixels": ("best", 2 * size)}


def add_map(state: State, name: str, light: Light) -> State:
    """The state with one more map, which becomes the light; a map of the same name is replaced."""
    with_map = dataclasses.replace(state, maps={**state.maps, name: light})
    return relight(with_map, dataclasses.replace(state.lighting, light=name))


def read_lighting(state: State, choice: Any, yaw: Any, exposure: Any) -> Lighting:
    """The lighting of the controls, with the state's sun; ValueError for invalid values."""
    values = read_numbers([yaw, exposure], 2)
    if values is None or choice not in state.lights:
        raise UserError("a light has a name of the list, and a turn and an exposure that are numbers")
    turn, stops = (float(value) for value in values)
    light = None if choice == SUN_ALONE else choice
    return dataclasses.replace(state.lighting, light=light, light_yaw=turn if light else 0.0, exposure=stops)


def relight(state: State, lighting: Lighting) -> State:
    """The state in the light of the options."""

    def make() -> Light:
        return light_of_options(lighting, lambda name: state.maps.get(name) or LIGHT_OF_PACKAGE(name))

    return dataclasses.replace(state, lighting=lighting, light=cache(make))


def draw(model: Model, state: State, moving: bool) -> np.ndarray | None:
    """The canvas, uint8: a `draft` while it moves; None until the browser has sent its camera."""
    if (view := state.view) is None:
        return None
    named = qualities(model)
    quality: Quality
    quality, size = ("draft", named["draft"][1] // 2) if moving else named[state.quality]
    behind = state.background
    reach = square_reach(view, whole=behind != "white")
    camera, light = square_camera(view, state.volume, reach, size), state.light()
    rendering = model.render(state.volume, camera, quality, light)
    square = images.to_uint8(put_background(behind, rendering, camera, light).image)
    return place_square(square, view, reach, MOVING_LONGEST if moving else LONGEST)


def read_view(wxyz: Any, position: Any, field_of_view: Any, width: Any, height: Any) -> View | None:
    """The view of a browser's message; None if it is invalid (NaN, no pixels, too far)."""
    turn, place = read_numbers(wxyz, 4), read_numbers(position, 3)
    canvas = read_numbers([field_of_view, width, height], 3)
    if turn is None or place is None or canvas is None:
        return None
    near = np.linalg.norm(turn) > 1e-6 and (np.abs(place) < FARTHEST_EYE).all()
    pixels = (canvas[1:] >= 2).all() and (canvas[1:] <= LARGEST_CANVAS).all()
    if not (near and pixels and NARROWEST <= canvas[0] <= WIDEST):
        return None
    rotation = Rotation.from_quat(turn, scalar_first=True).as_matrix() @ OPENCV
    columns, rows = (int(count) for count in canvas[1:])
    return View(position=place, rotation=rotation, field_of_view=float(canvas[0]), width=columns, height=rows)


def square_reach(view: View, whole: bool) -> float:
    """The reach of the square that contains the object or, if smaller or if `whole`, covers the canvas."""
    covering, distance = _covering(view), np.linalg.norm(view.position)
    if whole or distance <= OBJECT_RADIUS:
        return covering
    aside = np.arccos(np.clip(view.position @ view.rotation[:, 2] / distance, -1, 1))  # of the object's middle
    furthest = aside + np.arcsin(OBJECT_RADIUS / distance)
    return covering if furthest >= np.pi / 2 else min(covering, float(np.tan(furthest)))


def square_camera(view: View, volume: Encoded, reach: float, size: int) -> Camera:
    """Camera of `size` x `size` pixels in the middle of a view, in the cloud's units."""
    focal = 0.5 * size / reach
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], np.float32)
    position = view.position / float(volume.scale) + np.asarray(volume.centre, np.float64)
    pose = np.concatenate([view.rotation, position[:, None]], axis=1).astype(np.float32)
    return Camera(cam_to_world=pose, intrinsics=intrinsics, height=size, width=size)


def place_square(square: np.ndarray, view: View, reach: float, longest: int) -> np.ndarray:
    """The canvas, at most `longest` pixels along its longer side, with a square picture in its middle, on white."""
    shrink = min(1.0, longest / max(view.width, view.height))
    width, height = (max(round(side * shrink), 1) for side in (view.width, view.height))
    side = max(round(max(width, height) * reach / _covering(view)), 1)
    canvas = Image.new("RGB", (width, height), "white")
    scaled = Image.fromarray(square).resize((side, side), Image.Resampling.BICUBIC)
    canvas.paste(scaled, ((width - side) // 2, (height - side) // 2))
    return np.asarray(canvas)


def _covering(view: View) -> float:
    """The reach of the square that covers the canvas."""
    return float(np.tan(view.field_of_view / 2) * max(view.width / view.height, 1.0))


def read_numbers(values: Any, *shape: int) -> np.ndarray | None:
    """Values of a browser as finite numbers of a shape; None if they are anything else."""
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.shape == shape and np.isfinite(array).all() else None


def display_name(name: str) -> str:
    """The last part of a browser's file name, without characters that matter to Markdown or paths."""
    last = PurePath(name.replace("\\", "/")).name
    return "".join(c if c.isalnum() or c in "._- " else "_" for c in last)[-LONGEST_NAME:].strip() or "file"


def read_upload(name: str, content: bytes, read: Callable[[Path], Read]) -> Read:
    """The result of `read` for a file's bytes; ValueError, with the displayed name, if it cannot be read."""
    shown = display_name(name)
    with tempfile.TemporaryDirectory(prefix="spnr-view-") as folder:
        path = Path(folder) / f"upload{PurePath(shown).suffix.lower()}"
        path.write_bytes(content)
        try:
            return read(path)
        except ValueError as error:
            raise UserError(str(error).replace(str(path), shown)) from None
