"""What a browser sends to `spnr view`, damaged: cameras, controls, selections, keyframes, films, files.

viser turns messages into calls of spnr_jax/viewer; here those are made as viewer/gui.py makes them, with the values of
a JSON document.  The network is left out: its picture of a sound view is the affair of other tests.
"""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import valid_files
from damage import Files

from spnr_jax.kernels.records import PointCloud, Volume
from spnr_jax.method.model import Model
from spnr_jax.presets import tiny
from spnr_jax.viewer import picture, scene, session, uploads, viewpoint
from spnr_jax.viewer.scene import Scene
from spnr_jax.viewer.session import State

NETWORK = Model(config=tiny().model, variables={})  # asked for its sizes alone
CAMERA = {"wxyz": [1, 0, 0, 0], "position": [0, 0, -3], "fov": 0.7, "image_width": 60, "image_height": 40}
CONTROLS = {"left": "points", "right": "none", "quality": "best", "size": "64"}
MESSAGE = {
    "camera": CAMERA, "controls": CONTROLS, "base_color": [10, 200, 30], "roughness": 0.3, "metallic": 0.7,
    "low": [0.1, 0.2], "high": [0.8, 0.9], "look_at": [[0, 0, 0], [0.1, 0, 0]], "seconds": 0.5, "film": "gif",
}  # fmt: skip


def messages() -> list[Files]:
    """One document with every kind of message, in the order in which they are handled."""
    return [{"message.json": json.dumps(MESSAGE).encode()}]


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
    shown = (255 * positions).astype(np.uint8)
    scene = Scene(
        name="a", original=cloud, cloud=cloud, selected=np.zeros(30, bool), shown=shown, volume=volume, radius=0.02
    )
    return State(scene=scene, size=64, panes=("points",))


def _document(path: Path) -> Any:
    """The values that viser would unpack; ValueError for what it cannot."""
    try:
        return json.loads(path.read_text())
    except RecursionError:
        raise ValueError("viser unpacks no message so deep") from None


def read_message(folder: Path, main: str) -> None:
    """What the controls of a browser do with the values of a message."""
    sent = _document(folder / main)
    if not isinstance(sent, dict) or not all(isinstance(sent.get(key), dict) for key in ("camera", "controls")):
        raise ValueError("viser passes on named values alone")
    look, controls, state = sent["camera"], sent["controls"], _state()
    view = viewpoint.from_browser(*(look.get(name) for name in CAMERA))
    state = dataclasses.replace(state, view=view)
    state = session.select(state, sent.get("low"), sent.get("high"), add=True)
    for target in sent["look_at"] if isinstance(sent.get("look_at"), list) else []:
        state = session.record(target)(state)
    if view is not None:
        canvas = picture.draw(NETWORK, state.scene, view, ("points",), None, 64, 200).image
        assert canvas.dtype == np.uint8
        assert canvas.ndim == 3
        assert max(canvas.shape) <= 200
    fields = session.chosen(
        NETWORK, (controls.get("left"), controls.get("right")), controls.get("quality"), controls.get("size")
    )
    state = dataclasses.replace(state, **fields)
    for material in ("base_color", "roughness", "metallic"):
        edited = scene.edited(state.scene, material, sent.get(material))
        state = dataclasses.replace(state, scene=dataclasses.replace(edited, stale=False))  # else the network encodes
    for name in ("base_color", "roughness", "metallic"):
        values = np.asarray(getattr(state.scene.cloud, name))
        assert np.isfinite(values).all(), f"{name} not finite"
        assert 0 <= values.min() <= values.max() <= 1, f"{name} outside [0, 1]"
    try:
        seconds = float(sent.get("seconds", ""))  # as viser does with what moves a slider
    except (TypeError, OverflowError):
        raise ValueError("viser passes on a number of seconds alone") from None
    for position, rotation in session.path_poses(state, seconds):
        assert np.isfinite(position).all(), "a pose that is not finite"
        assert abs(np.linalg.det(rotation) - 1) < 1e-6, "a rotation that is none"
    if state.panes == ("points",):
        name, content, _ = session.film(NETWORK, state, seconds, sent.get("film"), "points")
        assert name == Path(name).name, "a film's name that is a path"
        assert content[:3] == b"GIF" or b"ftyp" in content[:12]


def read_upload(folder: Path, main: str) -> None:
    """What a browser's file becomes; nothing of it stays on the disk."""
    from file_readers import MOST_POINTS, check_cloud

    names = _document(folder / "name.json")
    if not isinstance(names, list) or len(names) != 1 or not isinstance(names[0], str):
        raise ValueError("a browser's file has one name")
    before = set(folder.iterdir())
    try:
        cloud = uploads.read_upload(names[0], (folder / "content").read_bytes(), num_points=MOST_POINTS, up="auto")
        check_cloud(cloud, MOST_POINTS)
    finally:
        assert set(folder.iterdir()) == before, "a file that stays"
