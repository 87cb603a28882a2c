"""The server behind `spnr view`: loads the network and a cloud, and gives each browser its own controls.

Every control submits a change to the render loop of its browser.  Quick callbacks are coroutines, which viser runs in
the order of the browser's messages, so the last value of a slider wins; slow ones (reading a file) are plain functions,
which run in threads.

The server listens only on this machine unless `--host` says otherwise, and serves only its own page.  Any web page that
is open in the same browser can connect to a local server, and viser has no authentication.  So the path of the viewer's
address begins with a random token; without it, no page is served and no WebSocket is opened.  The page's own connection
takes the token from its address.  If a browser sends an origin, it must be the host that was requested or, behind a
proxy, `reached_at`.  viser's tunnel to a public address, which any browser could request, is disabled.
"""

import contextlib
import dataclasses
import hmac
import io
import secrets
import socket
import threading
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from http import HTTPStatus
from typing import Any, Generic, TypeVar

import numpy as np
import viser
import websockets.asyncio.server
from websockets.http11 import Request

from spnr_jax.errors import UserError
from spnr_jax.formats import clouds, images
from spnr_jax.method.model import FIELD_OF_VIEW, Model
from spnr_jax.methods import method_of
from spnr_jax.tools import frame
from spnr_jax.tools.commands import View
from spnr_jax.tools.frame import State
from spnr_jax.tools.pictures import check_takes_light
from spnr_jax.training.weights import load

LENGTH = 16  # bytes of a token
CLOSED = "Open the address that `spnr view` printed, whole: it holds a token.\n"
FOREIGN = "This page is not that of the viewer.\n"
DEFAULT_PORTS = {"http": ":80", "https": ":443"}  # omitted by browsers in an origin
_guarding = threading.Lock()
Shown = TypeVar("Shown")

RequestHook = Callable[[Any, Request], Any]


def check_request(request: Request, token: str, reached_at: str | None = None) -> Request | str:
    """The request with the path after the token, or why it is refused."""
    first, _, rest = request.path.removeprefix("/").partition("/")
    if not hmac.compare_digest(first.partition("?")[0].encode(), token.encode()):
        return CLOSED
    origins, hosts = request.headers.get_all("Origin"), request.headers.get_all("Host")
    if not all(_is_own(origin, hosts, reached_at) for origin in origins):
        return FOREIGN
    return dataclasses.replace(request, path="/" + rest)


def _is_own(origin: str, hosts: list[str], reached_at: str | None) -> bool:
    """Whether an origin is the requested host or reached_at; "null" (a file, a sandbox) is neither."""
    scheme, _, address = origin.lower().partition("://")
    if scheme not in DEFAULT_PORTS:
        return False
    known = (reached_at or "").lower().removesuffix(DEFAULT_PORTS[scheme])
    return [address] == [host.lower() for host in hosts] or (known != "" and address == known)


@contextlib.contextmanager
def require_token(token: str, reached_at: str | None = None) -> Iterator[list[Any]]:
    """WebSocket servers that are opened meanwhile, in any thread, require the token; yields their list.

    viser opens its server in its own thread and has no hook for authentication, so a function is replaced.
    """
    original: Any = websockets.asyncio.server.serve
    opened: list[Any] = []

    def serve(*arguments: Any, process_request: RequestHook | None = None, **options: Any) -> Any:
        def ask(connection: Any, request: Request) -> Any:
            answer = check_request(request, token, reached_at)
            if isinstance(answer, str):
                return connection.respond(HTTPStatus.FORBIDDEN, answer)
            return process_request and process_request(connection, answer)

        opened.append(original(*arguments, process_request=ask, **options))
        return opened[-1]

    with _guarding:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield opened
        finally:
            websockets.asyncio.server.serve = original  # type: ignore[misc]


# --- one browser ------------------------------------------------------------------------------------------------------


REST = 0.2  # seconds without a change after which the picture at rest is rendered


class Loop(Generic[Shown]):
    """Calls `show(state, moving)` after changes (moving), and after `rest` seconds without one (not moving)."""

    def __init__(self, state: Shown, show: Callable[[Shown, bool], None], rest: float = REST) -> None:
        self.state, self.stopped = state, False
        self._show, self._rest = show, rest
        self._changes: list[Callable[[Shown], Shown]] = []
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.start, self.join = self._thread.start, self._thread.join

    def submit(self, change: Callable[[Shown], Shown]) -> None:
        """Queue a change that is applied before the next picture."""
        with self._wake:
            self._changes.append(change)
            self._wake.notify()

    @property
    def is_superseded(self) -> bool:
        """Whether a change is queued, so that a picture of the current state would be outdated."""
        return bool(self._changes) or self.stopped

    def stop(self) -> None:
        """End the thread after its current picture, without waiting: the caller may be a browser's callback."""
        with self._wake:
            self.stopped = True
            self._wake.notify()

    def _run(self) -> None:
        moving = True
        while not self.stopped:
            self._show(self.state, moving)
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
SETTLED = 0.5  # seconds after which a new page has its size and looks from EYE; before, programs are compiled in vain
PATIENCE = 1.0  # seconds of drawing after which the page says why it waits
PREPARING = "Drawing. The first picture of a new size takes longer: its programs are compiled."
ONE_LIGHT = "This network knows the light of its training alone; `--run surfels` draws in any."


class Browser:
    """One browser: controls and render loop; `network` is a lock on rendering, `reading` are options for files."""

    def __init__(
        self, client: viser.ClientHandle, model: Model, first: State, reading: dict[str, Any], network: threading.Lock
    ) -> None:
        self._client, self._model, self._reading, self._network = client, model, reading, network
        self._light: dict[str, Any] = {}
        self._opened, self._newest = 0, 0  # files opened, and the number of the one that is shown
        self.loop = Loop(first, lambda state, moving: self._try(lambda: self._draw(state, moving)))
        gui = client.gui
        self._title = gui.add_markdown(TITLE.format(first.name, len(first.cloud.positions)))
        self._status = gui.add_markdown("")
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
        threading.Timer(SETTLED, self.loop.start).start()

    def _look(self, camera: viser.CameraHandle) -> None:
        view = frame.read_view(camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height)
        if view is not None:
            self._replace(view=view)

    def _draw(self, state: State, moving: bool) -> None:
        with self._explain_wait(), self._network:
            canvas = frame.draw(self._model, state, moving)
        if canvas is not None and not self.loop.stopped and (moving or not self.loop.is_superseded):
            quality = MOVING_JPEG if moving else RESTING_JPEG
            self._client.scene.set_background_image(canvas, format="jpeg", jpeg_quality=quality)

    @contextlib.contextmanager
    def _explain_wait(self) -> Iterator[None]:
        """Says on the page why a picture takes longer than PATIENCE, until it is drawn."""
        lock, drawing = threading.Lock(), True

        def say(text: str) -> None:
            if not self.loop.stopped and self._status.content != text:
                self._status.content = text

        def tell() -> None:
            with lock:  # a timer that has fired cannot be cancelled
                say(PREPARING if drawing else "")

        waiting = threading.Timer(PATIENCE, tell)
        waiting.daemon = True
        waiting.start()
        try:
            yield
        finally:
            waiting.cancel()
            with lock:
                drawing = False
                say("")

    def _replace(self, **fields: Any) -> None:
        self.loop.submit(lambda state: dataclasses.replace(state, **fields))

    def _try(self, work: Callable[[], None]) -> None:
        """Draw, or run the callback of a control; errors of the user and a want of memory become a notification."""
        try:
            work()
        except (ValueError, OSError, MemoryError, RuntimeError) as error:
            message = " ".join(str(error).split())[:LONGEST_NOTE]
            self._client.add_notification("That did not work", message, auto_close_seconds=10, color="red")

    def _add_picture(self, gui: viser.GuiApi) -> None:
        names, hint = tuple(frame.qualities(self._model)), "While things move: draft, half the pixels"
        quality = gui.add_dropdown("Quality", names, initial_value=self.loop.state.quality, hint=hint)

        @quality.on_update
        async def _(_: Any) -> None:
            if quality.value in names:
                self._replace(quality=quality.value)

    def _add_light(self, gui: viser.GuiApi) -> None:
        if not method_of(self._model.config).takes_light:
            gui.add_markdown(ONE_LIGHT)
            return
        state, options = self.loop.state, self.loop.state.lighting
        widest = max(WIDEST_EXPOSURE, abs(options.exposure))
        self._light = {
            "choice": gui.add_dropdown("Light", state.lights, initial_value=state.light_name),
            "yaw": gui.add_slider("Turned", 0.0, 360.0, 1.0, options.light_yaw % 360),
            "exposure": gui.add_slider("Exposure", -widest, widest, 0.25, options.exposure),
        }

        def relight() -> None:
            lighting = frame.read_lighting(self.loop.state, **{name: x.value for name, x in self._light.items()})
            self.loop.submit(lambda state: frame.relight(state, lighting))

        async def move(event: viser.GuiEvent) -> None:
            if event.client is not None:  # not when the program itself chooses a new map
                self._try(relight)

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
            canvas = frame.draw(self._model, state, moving=False)
        if canvas is not None:
            name = f"{state.name.rpartition('.')[0] or 'view'}.png"
            self._client.send_file_download(name, images.png(canvas), save_immediately=True)

    def _open(self, file: viser.UploadedFile) -> None:
        name, notes = frame.display_name(file.name), list[str]()
        if name.lower().endswith(tuple(images.ENDINGS)):
            if not self._light:
                raise UserError(ONE_LIGHT)
            light = frame.read_upload(file.name, file.content, images.read_light)
            self.loop.submit(lambda state: self._show_choice(frame.add_map(state, name, light)))
            return
        self._opened += 1
        number = self._opened
        read = partial(clouds.read_cloud, **self._reading, report=notes.append)
        opening = self._client.add_notification("Opening", name, loading=True, with_close_button=False)
        try:
            cloud = frame.read_upload(file.name, file.content, read)
            volume = self._model.encode(cloud)
        finally:
            opening.remove()
        if number > self._newest:  # the file that was opened last stays
            self._newest = number
            self._replace(name=name, cloud=cloud, volume=volume)
            self._title.content = "; ".join([TITLE.format(name, len(cloud.positions)), *notes])

    def _show_choice(self, state: State) -> State:
        self._light["choice"].options, self._light["choice"].value = state.lights, state.light_name
        return state


# --- the server -------------------------------------------------------------------------------------------------------


LOOPBACK = ("127.0.0.1", "localhost", "::1")
EYE = (1.7, 1.2, 2.9)  # initial camera position in the box; it looks at the middle
EXPOSED = (
    "--host {host}: whoever reaches this machine on port {port} and knows the token of the address sees {name}, can "
    "send files that this process reads, and makes it compute; there is no encryption: who listens reads the token"
)
UNGUARDED = "spnr view cannot keep other pages out of viser {version}; pip install 'viser==1.1.1'"


class Server(viser.ViserServer):
    """viser's server without its tunnel."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Nothing: the cloud stays on this machine."""


class Viewer:
    """A running server; `url` is its page, with the token; `lines` are messages for the user."""

    def __init__(
        self, model: Model, first: State, reading: dict[str, Any], host: str, port: int, reached_at: str | None = None
    ) -> None:
        self._model, self._first, self._reading = model, first, reading
        self._network = threading.Lock()
        self._browsers: dict[int, Browser] = {}
        token = secrets.token_urlsafe(LENGTH)
        with (
            require_token(token, reached_at) as opened,
            contextlib.redirect_stdout(io.StringIO()),
        ):  # no banner of viser
            self._server = Server(host=host, port=port, label="spnr view", verbose=False)
        if not opened:
            self.stop()
            raise UserError(UNGUARDED.format(version=viser.__version__))
        port = self._server.get_port()  # another where this one was taken just now
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}/{token}/"
        self.lines = [f"{self.url} shows {first.name} (Ctrl-C stops)"]
        self.lines += [f"reached at {reached_at}: http(s)://{reached_at}/{token}/"] if reached_at else []
        self.lines += [EXPOSED.format(host=host, port=port, name=first.name)] if host not in LOOPBACK else []
        self._set_up_page()
        threading.Thread(target=self._warm_up).start()  # no daemon: Python's end crashes of what JAX still compiles

    def wait(self) -> None:
        """Serve until Ctrl-C."""
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a browser left while one was drawn
        try:
            threading.Event().wait()
        finally:
            self.stop()

    def stop(self) -> None:
        """Close the server and end the render loops."""
        for browser in tuple(self._browsers.values()):
            browser.loop.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _set_up_page(self) -> None:
        self._server.gui.configure_theme(show_share_button=False, show_logo=False)
        self._server.gui.main_panel.dock_right()
        self._server.scene.set_up_direction("+y")
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.fov = np.array(EYE), np.zeros(3), float(FIELD_OF_VIEW)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    def _warm_up(self) -> None:
        """Compile the first browser's programs while it loads the page."""
        state = dataclasses.replace(self._first, view=frame.read_view((0, 1, 0, 0), (0, 0, 3), 1.0, 64, 64))
        for moving in (True, False):
            with self._network:
                frame.draw(self._model, state, moving)

    def _connect(self, client: viser.ClientHandle) -> None:
        self._browsers[client.client_id] = Browser(client, self._model, self._first, self._reading, self._network)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        if (browser := self._browsers.pop(client.client_id, None)) is not None:
            browser.loop.stop()


def open_viewer(command: View) -> tuple[Viewer, list[str]]:
    """The running viewer of a command, and the assumptions about its file; ValueError for a bad file."""
    _check_free(command.host, command.port)  # before the seconds that reading takes
    model = load(command.run)
    check_takes_light(model, command.light_options_given, command.run)
    notes: list[str] = []
    reading: dict[str, Any] = {"num_points": command.num_points, "up": command.up, "clean": command.clean}
    points = clouds.read_cloud(command.cloud, **reading, cut=command.cut, report=notes.append)
    name = frame.display_name(command.cloud.name)
    first = frame.open_state(model, points, name, command.lighting, command.background)
    return Viewer(model, first, reading, command.host, command.port, command.reached_at), notes


def _check_free(host: str, port: int) -> None:
    """ValueError unless a server can listen there; viser itself would take another port, and wait for no host."""
    if not 0 <= port < 2**16:
        raise UserError(f"--port must be 0 (any free one) to 65535, got {port}")
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        hint = "127.0.0.1 is this machine alone, 0.0.0.0 all networks; port 0 is any free one"
        raise UserError(f"--host {host} --port {port}: {error.strerror} ({hint})") from None
