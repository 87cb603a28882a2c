"""The controls of one browser, bound to what it sees: every control submits a change to the loop that draws.

Quick callbacks are coroutines, which viser runs in the order of the browser's messages, so the last value of a slider
wins; slow ones (reading a file) are plain functions, which it runs in threads.
"""

import dataclasses
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Generic, TypeVar

import viser

from spnr_jax.errors import UserError
from spnr_jax.formats import clouds, images, light_files
from spnr_jax.method.model import Model
from spnr_jax.tools.pictures import takes_light
from spnr_jax.viewer import frame
from spnr_jax.viewer.frame import State

Shown = TypeVar("Shown")
REST = 0.2  # seconds without a change after which the better picture is drawn


class Loop(Generic[Shown]):
    """Draws `show(state, moving)` after changes (moving), and when none came for `rest` seconds (not moving)."""

    def __init__(self, state: Shown, show: Callable[[Shown, bool], Shown], rest: float = REST) -> None:
        self.state, self.stopped = state, False
        self._show, self._rest = show, rest
        self._changes: list[Callable[[Shown], Shown]] = []
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.start, self.join = self._thread.start, self._thread.join

    def submit(self, change: Callable[[Shown], Shown]) -> None:
        """Have a change applied before the next picture."""
        with self._wake:
            self._changes.append(change)
            self._wake.notify()

    @property
    def is_superseded(self) -> bool:
        """Whether a change waits: a picture of the state as it is would be old before it is seen."""
        return bool(self._changes) or self.stopped

    def stop(self) -> None:
        """End the thread after the picture that it draws, without waiting: that may be a browser's callback."""
        with self._wake:
            self.stopped = True
            self._wake.notify()

    def _run(self) -> None:
        moving = True
        while not self.stopped:
            self.state = self._show(self.state, moving)
            with self._wake:
                self._wake.wait_for(lambda: self.is_superseded, self._rest if moving else None)
                changes, self._changes = self._changes, []
            moving = bool(changes)
            for change in changes:
                self.state = change(self.state)


# A file dropped anywhere on the page goes into the file input of the upload button.
DROP = """<img alt="" style="display:none" src="data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAAC" onload="
document.body.ondragover = event => event.preventDefault();
document.body.ondrop = event => {
  if (!event.dataTransfer.files.length) return;
  event.preventDefault();
  const input = document.querySelector('input[type=file]');
  input.files = event.dataTransfer.files;
  input.dispatchEvent(new Event('change', {bubbles: true})); };">"""
TITLE = "{}: {:,} points"
LONGEST_NOTE = 500  # characters
MOVING_JPEG, RESTING_JPEG = 75, 92  # qualities of the pictures sent
WIDEST_EXPOSURE = 4.0  # stops
PREPARING = "The network is being prepared."
ONE_LIGHT = "This network knows the light of its training alone; `--run surfels` draws in any."


class Browser:
    """Its controls, and the loop that draws for it; `network` keeps two from drawing at once, `reading` reads files."""

    def __init__(
        self, client: viser.ClientHandle, model: Model, first: State, reading: dict[str, Any], network: threading.Lock
    ) -> None:
        self._client, self._model, self._reading, self._network = client, model, reading, network
        self._light: dict[str, Any] = {}
        self.loop = Loop(first, self._draw)
        gui = client.gui
        self._title = gui.add_markdown(TITLE.format(first.name, len(first.cloud.positions)))
        self._said = gui.add_markdown(PREPARING)
        with gui.add_folder("Picture"):
            self._add_picture(gui)
        with gui.add_folder("Light"):
            self._add_light(gui)
        with gui.add_folder("File"):
            self._add_files(gui)

        @client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            self._look(camera)

        self._look(client.camera)
        self.loop.start()

    def _look(self, camera: viser.CameraHandle) -> None:
        seen = frame.read_view(camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height)
        if seen is not None:
            self._replace(view=seen)

    def _draw(self, state: State, moving: bool) -> State:
        with self._network:
            state, canvas = frame.draw(self._model, state, moving)
        if canvas is not None and not self.loop.stopped and (moving or not self.loop.is_superseded):
            quality = MOVING_JPEG if moving else RESTING_JPEG
            self._client.scene.set_background_image(canvas, format="jpeg", jpeg_quality=quality)
            self._said.content = self._said.content.replace(PREPARING, "")
        return state

    def _replace(self, **fields: Any) -> None:
        self.loop.submit(lambda state: dataclasses.replace(state, **fields))

    def _try(self, work: Callable[[], None]) -> None:
        """Do the work of a control; what a person can mend becomes a note in the browser."""
        try:
            work()
        except (ValueError, OSError) as error:
            said = " ".join(str(error).split())[:LONGEST_NOTE]
            self._client.add_notification("That did not work", said, auto_close_seconds=10, color="red")

    def _add_picture(self, gui: viser.GuiApi) -> None:
        names, hint = tuple(frame.qualities(self._model)), "While things move: draft, half the pixels"
        quality = gui.add_dropdown("Quality", names, initial_value=self.loop.state.quality, hint=hint)

        @quality.on_update
        async def _(_: Any) -> None:
            if quality.value in names:
                self._replace(quality=quality.value)

    def _add_light(self, gui: viser.GuiApi) -> None:
        if not takes_light(self._model):
            gui.add_markdown(ONE_LIGHT)
            return
        state, options = self.loop.state, self.loop.state.lighting
        widest = max(WIDEST_EXPOSURE, abs(options.exposure))
        self._light = {
            "choice": gui.add_dropdown("Light", state.lights, initial_value=state.light_name),
            "yaw": gui.add_slider("Turned", 0.0, 360.0, 1.0, options.light_yaw % 360),
            "exposure": gui.add_slider("Exposure", -widest, widest, 0.25, options.exposure),
        }

        async def move(event: viser.GuiEvent) -> None:
            if event.client is not None:  # not when the program itself chooses a new map
                said = {name: control.value for name, control in self._light.items()}
                self._try(lambda: self._replace(lighting=frame.read_lighting(self.loop.state, **said), stale=True))

        for control in self._light.values():
            control.on_update(move)

    def _add_files(self, gui: viser.GuiApi) -> None:
        gui.add_html(DROP)
        upload = gui.add_upload_button("Open", hint="A cloud, a mesh or a map of light; or drop it on the page")
        snapshot = gui.add_button("Snapshot", hint="The network's picture as a .png")

        @upload.on_upload
        def _(_: Any) -> None:
            self._try(lambda: self._open(upload.value))

        @snapshot.on_click
        def _(_: Any) -> None:
            self._try(self._save)

    def _save(self) -> None:
        state = self.loop.state
        with self._network:
            canvas = frame.draw(self._model, state, moving=False)[1]
        if canvas is not None:
            name = f"{state.name.rpartition('.')[0] or 'view'}.png"
            self._client.send_file_download(name, images.png(canvas), save_immediately=True)

    def _open(self, file: viser.UploadedFile) -> None:
        name, notes = frame.display_name(file.name), list[str]()
        if name.lower().endswith(tuple(light_files.ENDINGS)):
            if not self._light:
                raise UserError(ONE_LIGHT)
            light = frame.read_upload(file.name, file.content, light_files.read_light)
            self.loop.submit(lambda state: self._show_choice(frame.add_map(state, name, light)))
            return
        read = partial(clouds.read_cloud, **self._reading, report=notes.append)
        cloud = frame.read_upload(file.name, file.content, read)
        self._replace(name=name, cloud=cloud, volume=self._model.encode(cloud))
        self._title.content = "; ".join([TITLE.format(name, len(cloud.positions)), *notes])

    def _show_choice(self, state: State) -> State:
        self._light["choice"].options, self._light["choice"].value = state.lights, state.light_name
        return state
