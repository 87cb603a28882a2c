"""The controls of one browser, bound to its session: every control submits a change to the loop that draws.

Quick callbacks are coroutines: viser runs those one after another, in the order of the browser's messages, so the last
value of a slider wins.  Slow ones (reading a file, a film) are plain functions, which viser gives to its threads.
"""

import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import viser

from spnr_jax.errors import UserError
from spnr_jax.kernels.cleaning import Clean
from spnr_jax.method.model import Model, Quality
from spnr_jax.tools.chosen_light import takes_light
from spnr_jax.viewer import lights, scene, session, uploads, viewpoint
from spnr_jax.viewer.light_controls import ONE_LIGHT, LightControls
from spnr_jax.viewer.loop import Loop
from spnr_jax.viewer.picture import LAYERS
from spnr_jax.viewer.scene import Material, Scene
from spnr_jax.viewer.session import State
from spnr_jax.viewer.splats import SplatControls

LONGEST_NOTE = 500  # characters
MOVING_JPEG, RESTING_JPEG = 75, 92  # qualities of the pictures sent
HELP = "Drop a file anywhere on the page. Drag to orbit; Shift+drag selects points, Ctrl+Shift+drag adds to them."


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """How files are read: points kept of bigger clouds, the upward axis, and how scans are cleaned."""

    num_points: int
    up: str
    clean: Clean


class Browser:
    """One browser: its controls, and the loop that draws for it.  `network` keeps two from drawing at once."""

    def __init__(
        self, client: viser.ClientHandle, model: Model, first: State, reading: Reading, network: threading.Lock
    ) -> None:
        self._client, self._model, self._reading, self._network = client, model, reading, network
        self._measured: dict[tuple[Quality, int], float] = {}
        self._outlined = False
        self._playing = threading.Event()
        available = session.sizes(model)
        self.loop = Loop(first, self._draw)
        gui = client.gui
        with gui.add_folder("View"):
            self._add_view(gui, available)
        with gui.add_folder("Materials"):
            self._add_materials(gui)
        self._light: LightControls | None = None
        with gui.add_folder("Light"):
            self._add_light(gui)
        with gui.add_folder("Splats"):
            self._splats = SplatControls(client, model, self.loop, network, self._slowly)
        with gui.add_folder("Camera path"):
            self._add_path(gui)
        with gui.add_folder("File"):
            self._add_files(gui)
        self._bind_camera()
        self.loop.start()

    def _draw(self, state: State, moving: bool) -> State:
        if state.view is None:
            return state
        if not self._outlined and (outline := session.outline(self._model, state)) is not None:
            self._outlined = True
            self._send(outline, MOVING_JPEG)
        with self._network:
            state, drawn = session.draw(self._model, state, moving)
        self._splats.follow(state)
        if drawn is not None and not self.loop.stopped and (moving or not self.loop.superseded):
            self._send(drawn.image, MOVING_JPEG if moving else RESTING_JPEG)
            if drawn.quality is not None and drawn.milliseconds is not None:
                self._measured = {key: ms for key, ms in self._measured.items() if key[0] != drawn.quality}
                self._measured[drawn.quality, drawn.size] = drawn.milliseconds
                self._table.content = session.pace(self._measured)
        return state

    def _send(self, canvas: np.ndarray, jpeg_quality: int) -> None:
        self._client.scene.set_background_image(canvas, format="jpeg", jpeg_quality=jpeg_quality)

    def _replace(self, **fields: Any) -> None:
        self.loop.submit(lambda state: dataclasses.replace(state, **fields))

    def _change_scene(self, change: Callable[[Scene], Scene]) -> None:
        self.loop.submit(lambda state: dataclasses.replace(state, scene=change(state.scene)))

    def _slowly(self, work: Callable[[], None]) -> None:
        """Do the work of a button; what a person can mend becomes a note in the browser."""
        try:
            work()
        except (ValueError, OSError) as error:
            self._note("That did not work", " ".join(str(error).split())[:LONGEST_NOTE], color="red")

    def _note(self, title: str, body: str, **options: Any) -> None:
        self._client.add_notification(title, body, auto_close_seconds=10, **options)

    def _bind_camera(self) -> None:
        camera = self._client.camera

        @camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            self._look(camera)

        for modifier, add in (("shift", False), ("cmd/ctrl+shift", True)):
            self._client.scene.on_rect_select(modifier=cast(Any, modifier))(self._selector(add))
        self._look(camera)

    def _look(self, camera: viser.CameraHandle) -> None:
        view = viewpoint.from_browser(camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height)
        if view is not None:
            self._replace(view=view)

    def _selector(self, add: bool) -> Callable[[viser.SceneRectSelectEvent], Any]:
        async def select(event: viser.SceneRectSelectEvent) -> None:
            self.loop.submit(lambda state: session.select(state, event.screen_min, event.screen_max, add))
            self.loop.submit(self._show_materials)

        return select

    def _add_view(self, gui: viser.GuiApi, available: tuple[int, ...]) -> None:
        left = gui.add_dropdown("Left", LAYERS, initial_value="points")
        right = gui.add_dropdown("Right", (*LAYERS, "none"), initial_value="picture")
        quality = gui.add_dropdown(
            "At rest", session.QUALITIES, initial_value="best", hint="While the camera moves: draft"
        )
        size = gui.add_dropdown("Pixels", [str(n) for n in available], initial_value=str(available[1]))
        self._table = gui.add_markdown(session.pace({}))
        controls = (left, right, quality, size)

        async def changed(_: Any) -> None:
            self._slowly(
                lambda: self._replace(
                    **session.chosen(self._model, (left.value, right.value), quality.value, size.value)
                )
            )

        for control in controls:
            control.on_update(changed)

    def _add_materials(self, gui: viser.GuiApi) -> None:
        self._selection = gui.add_markdown("")
        self._color: Any = gui.add_rgb("Base colour", (128, 128, 128))
        self._roughness: Any = gui.add_slider("Roughness", 0.0, 1.0, 0.01, 0.5)
        self._metallic: Any = gui.add_slider("Metallic", 0.0, 1.0, 0.01, 0.0)
        buttons = gui.add_button_group("Points", ("select all", "restore"))
        self._show_materials(self.loop.state)
        self._color.on_update(self._editor("base_color", lambda: tuple(c / 255 for c in self._color.value)))
        self._roughness.on_update(self._editor("roughness", lambda: self._roughness.value))
        self._metallic.on_update(self._editor("metallic", lambda: self._metallic.value))

        @buttons.on_click
        async def _(_: Any) -> None:
            self._change_scene(scene.select_all if buttons.value == "select all" else scene.restored)
            self.loop.submit(self._show_materials)

    def _editor(self, material: Material, value: Callable[[], Any]) -> Callable[[viser.GuiEvent], Any]:
        async def edit(event: viser.GuiEvent) -> None:
            if event.client is not None:  # not when the program itself moves the slider
                self._slowly(lambda: self._edit(material, value()))

        return edit

    def _edit(self, material: Material, value: Any) -> None:
        now = scene.material_value(material, value)  # here, where an error has a person to tell it to
        self._change_scene(lambda old: scene.edited(old, material, now))

    def _show_materials(self, state: State) -> State:
        """Has the controls show the materials of the affected points; the state as it is."""
        self._color.value, self._roughness.value, self._metallic.value = scene.mean_materials(state.scene)
        selected, count = int(state.scene.selected.sum()), len(state.scene.selected)
        self._selection.content = f"{state.scene.name}: edits change " + (
            f"{selected} selected of {count} points" if selected else f"all {count} points"
        )
        return state

    def _add_light(self, gui: viser.GuiApi) -> None:
        if not takes_light(self._model):
            gui.add_markdown(ONE_LIGHT)
            return
        self._light = LightControls(gui, self.loop.state.lights, self._change_lights, self._slowly)
        self._add_upload(gui, "Open a map (.hdr .exr)")

    def _change_lights(self, change: Callable[[lights.Lights], lights.Lights]) -> None:
        self.loop.submit(lambda state: dataclasses.replace(state, lights=change(state.lights)))

    def _add_path(self, gui: viser.GuiApi) -> None:
        keyframes = gui.add_button_group("Keyframes", ("add", "clear"))
        count = gui.add_markdown("no keyframes")
        seconds = gui.add_slider("Seconds between", 0.25, 10.0, 0.25, 2.0)
        play, stop = gui.add_button("Play"), gui.add_button("Stop", visible=False)
        kind = gui.add_dropdown("Film", session.FILMS, initial_value="mp4")
        export = gui.add_button("Export film")

        def recorded(state: State) -> State:
            count.content = f"{len(state.keyframes)} keyframes" if state.keyframes else "no keyframes"
            return state

        @keyframes.on_click
        async def _(_: Any) -> None:
            target = self._client.camera.look_at
            self.loop.submit(session.record(target) if keyframes.value == "add" else session.without_keyframes)
            self.loop.submit(recorded)

        @play.on_click
        def _(_: Any) -> None:
            self._slowly(lambda: self._play(session.path_poses(self.loop.state, seconds.value), play, stop))

        @stop.on_click
        async def _(_: Any) -> None:
            self._playing.clear()

        @export.on_click
        def _(_: Any) -> None:
            self._slowly(lambda: self._export(seconds.value, kind.value, export))

    def _play(self, poses: list, play: viser.GuiButtonHandle, stop: viser.GuiButtonHandle) -> None:
        if self._playing.is_set():
            return
        self._playing.set()
        play.visible, stop.visible = False, True
        camera, start = self._client.camera, time.monotonic()
        for i, (position, rotation) in enumerate(poses):
            with self._client.atomic():
                camera.position, camera.wxyz = position, viewpoint.to_browser(rotation)
            time.sleep(max(start + (i + 1) / session.FRAMES_PER_SECOND - time.monotonic(), 0))
            if self.loop.stopped or not self._playing.is_set():
                break
        self._playing.clear()
        play.visible, stop.visible = True, False

    def _export(self, seconds: float, kind: Any, button: viser.GuiButtonHandle) -> None:
        button.disabled = True
        state, label = self.loop.state, button.label

        def progress(share: float) -> None:
            button.label = f"{100 * share:.0f} %"

        try:
            name, content, reason = session.film(self._model, state, seconds, kind, state.panes[-1], progress)
        finally:
            button.disabled, button.label = False, label
        if reason:
            self._note("Film", reason)
        self._client.send_file_download(name, content, save_immediately=True)

    def _add_files(self, gui: viser.GuiApi) -> None:
        gui.add_markdown(HELP)
        gui.add_html(uploads.DROP)
        self._add_upload(gui, "Open a file")
        snapshot = gui.add_button("Snapshot")

        @snapshot.on_click
        def _(_: Any) -> None:
            self._slowly(self._snapshot)

    def _add_upload(self, gui: viser.GuiApi, label: str) -> None:
        """A button that opens files, clouds and maps alike: which one gets a dropped file is the page's choice."""
        upload = gui.add_upload_button(label)

        @upload.on_upload
        def _(event: viser.GuiEvent) -> None:
            self._slowly(lambda: self._open(upload.value))

    def _snapshot(self) -> None:
        state = self.loop.state
        name = f"{state.scene.name.rpartition('.')[0] or 'view'}.png"
        self._client.send_file_download(name, session.snapshot(self._model, state), save_immediately=True)

    def _open(self, file: viser.UploadedFile) -> None:
        if uploads.is_map(file.name):
            self._open_map(file)
            return
        notes: list[str] = []
        cloud = uploads.read_upload(file.name, file.content, **dataclasses.asdict(self._reading), report=notes.append)
        opened = scene.open_scene(self._model, cloud, uploads.display_name(file.name))
        self._change_scene(lambda old: opened)
        self._splats.drop()
        self.loop.submit(self._show_materials)
        self._note(opened.name, "; ".join(notes) or f"{len(opened.selected)} points")

    def _open_map(self, file: viser.UploadedFile) -> None:
        if self._light is None:
            raise UserError(ONE_LIGHT)
        name, light = uploads.display_name(file.name), uploads.read_uploaded_map(file.name, file.content)
        self._change_lights(lambda old: lights.with_map(old, name, light))
        self.loop.submit(self._light.show)
        self._note(name, "is the light now")
