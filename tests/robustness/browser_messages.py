"""What a browser sends to `spnr view`, damaged: cameras, controls of the light, files.

viser turns messages into calls of spnr_jax/viewer; here those are made as viewer/gui.py makes them, with the values of
a JSON document.  The network is left out: its picture of a sound view is the affair of other tests.
"""

import functools
import json
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import valid_files
from damage import Files

from spnr_jax.formats import clouds
from spnr_jax.kernels.records import PointCloud, Volume
from spnr_jax.viewer import frame
from spnr_jax.viewer.frame import State

CAMERA = {"wxyz": [1, 0, 0, 0], "position": [0, 0, -3], "fov": 0.7, "image_width": 60, "image_height": 40}
LIGHT = {"choice": "studio", "yaw": 90.0, "exposure": -0.5}
SQUARE = np.zeros((16, 16, 3), np.uint8)  # what the network would have drawn


def messages() -> list[Files]:
    """One document with every kind of message."""
    return [{"message.json": json.dumps({"camera": CAMERA, "light": LIGHT}).encode()}]


def sent_files() -> list[Files]:
    """Files that a browser sends, with the name that it gives them."""
    found = []
    for files in (*valid_files.plys()[:2], *valid_files.glbs(), *valid_files.npys()[:1]):
        name, content = next(iter(files.items()))
        found.append({"name.json": json.dumps([name]).encode(), "content": content})
    return found


@functools.cache
def _state() -> State:
    """What a browser that has just come sees; nothing of it needs a network."""
    positions = valid_files.numbers(30, 3)
    cloud = PointCloud(
        positions=positions, base_color=positions, roughness=positions[:, 0], metallic=positions[:, 1],
        mask=np.ones(30, bool),
    )  # fmt: skip
    volume = Volume(scene=None, centre=jnp.full(3, 0.5), scale=jnp.asarray(1.2))  # nothing of it is drawn
    return State(name="a", cloud=cloud, volume=volume)


def _document(path: Path) -> Any:
    """The values that viser would unpack; ValueError for what it cannot."""
    try:
        return json.loads(path.read_text())
    except RecursionError:
        raise ValueError("viser unpacks no message so deep") from None


def read_message(folder: Path, main: str) -> None:
    """What the controls of a browser do with the values of a message."""
    sent = _document(folder / main)
    if not isinstance(sent, dict) or not all(isinstance(sent.get(key), dict) for key in ("camera", "light")):
        raise ValueError("viser passes on named values alone")
    view = frame.read_view(*(sent["camera"].get(name) for name in CAMERA))
    for whole in (False, True):
        if view is not None:
            reach = frame.square_reach(view, whole)
            camera = frame.square_camera(view, _state().volume, reach, len(SQUARE))
            assert np.isfinite(camera.cam_to_world).all()
            assert np.isfinite(camera.intrinsics).all()
            canvas = frame.fill(SQUARE, view, reach, 200)
            assert canvas.dtype == np.uint8
            assert max(canvas.shape) <= 200
    lighting = frame.read_lighting(_state(), **{name: sent["light"].get(name) for name in LIGHT})
    assert lighting.light in _state().lights
    assert np.isfinite([lighting.light_yaw, lighting.exposure]).all()


def read_upload(folder: Path, main: str) -> None:
    """What a browser's file becomes; nothing of it stays on the disk."""
    from file_readers import MOST_POINTS, check_cloud

    names = _document(folder / "name.json")
    if not isinstance(names, list) or len(names) != 1 or not isinstance(names[0], str):
        raise ValueError("a browser's file has one name")
    before = set(folder.iterdir())
    try:
        read = partial(clouds.read_cloud, num_points=MOST_POINTS, up="auto")
        check_cloud(frame.read_upload(names[0], (folder / "content").read_bytes(), read), MOST_POINTS)
    finally:
        assert set(folder.iterdir()) == before, "a file that stays"
