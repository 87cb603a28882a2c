"""The server behind `spnr view`: loads the network and a cloud, and gives every browser that comes its own session.

It listens on this machine alone unless `--host` says otherwise, and talks to its own page alone (gate.py): the address
that is printed holds a token.  viser's tunnel to a public address, which any browser could ask for, is closed.
"""

import contextlib
import dataclasses
import errno
import io
import socket
import threading
import warnings
from pathlib import Path

import numpy as np
import viser

from spnr_jax.errors import UserError
from spnr_jax.formats import clouds
from spnr_jax.formats.cut import Cut
from spnr_jax.kernels.cleaning import Clean
from spnr_jax.method.model import FIELD_OF_VIEW, Model
from spnr_jax.tools.chosen_light import check_takes_light
from spnr_jax.tools.light_options import Lighting
from spnr_jax.training.weights import load, suited_to
from spnr_jax.viewer import gate, lights, session, uploads
from spnr_jax.viewer.gui import Browser, Reading
from spnr_jax.viewer.scene import open_scene
from spnr_jax.viewer.session import State
from spnr_jax.viewer.viewpoint import View

LOOPBACK = ("127.0.0.1", "localhost", "::1")
EYE = (1.7, 1.2, 2.9)  # in the box: where a browser looks from at first, at its middle
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
    """A running server; `url` is its page, with the token, `lines` what a person should know about it."""

    def __init__(self, model: Model, first: State, reading: Reading, host: str, port: int) -> None:
        _check_free(host, port)
        self._model, self._first, self._reading = model, first, reading
        self._network = threading.Lock()
        self._browsers: dict[int, Browser] = {}
        token = gate.new_token()
        with gate.guarded(token) as opened, contextlib.redirect_stdout(io.StringIO()):  # viser's banner names addresses
            self._server = Server(host=host, port=port, label="spnr view", verbose=False)
        if not opened:
            self.stop()
            raise UserError(UNGUARDED.format(version=viser.__version__))
        if port not in (0, self._server.get_port()):
            self.stop()
            raise UserError(_in_use(host, port))  # taken in the moment since it was found free
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}/{token}/"
        self.lines = [f"{self.url} shows {first.scene.name} (Ctrl-C stops)"]
        if host not in LOOPBACK:
            self.lines.append(EXPOSED.format(host=host, port=self._server.get_port(), name=first.scene.name))
        self._server.gui.configure_theme(show_share_button=False, show_logo=False)
        self._server.gui.main_panel.dock_right()
        self._server.scene.set_up_direction("+y")
        self._set_first_camera()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        threading.Thread(target=self._warm_up, daemon=True).start()

    def wait(self) -> None:
        """Serve until Ctrl-C."""
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a browser left while one was drawn
        try:
            threading.Event().wait()
        finally:
            self.stop()

    def stop(self) -> None:
        """Close the server and end what draws."""
        for browser in tuple(self._browsers.values()):
            browser.loop.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _set_first_camera(self) -> None:
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.fov = np.array(EYE), np.zeros(3), float(FIELD_OF_VIEW)

    def _warm_up(self) -> None:
        """Compile what the first browser will ask for while it still loads the page."""
        view = View(position=np.array([0.0, 0.0, 3.0]), rotation=np.eye(3), field_of_view=1.0, width=64, height=64)
        state = dataclasses.replace(self._first, view=view, panes=("picture",))
        for moving in (True, False):
            with self._network:
                session.draw(self._model, state, moving)

    def _connected(self, client: viser.ClientHandle) -> None:
        self._browsers[client.client_id] = Browser(client, self._model, self._first, self._reading, self._network)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        if (browser := self._browsers.pop(client.client_id, None)) is not None:
            browser.loop.stop()


def open_viewer(
    cloud: Path,
    run: Path | None,
    *,
    host: str,
    port: int,
    num_points: int,
    up: str,
    clean: Clean,
    cut: Cut,
    lighting: Lighting,
) -> tuple[Viewer, list[str]]:
    """A running viewer of a file with a run's network, and what was assumed about the file, a line each.

    ValueError for a port that is in use, a host that is not of this machine, and whatever cannot be read.
    """
    _check_free(host, port)  # before the seconds that reading takes
    named = load(run) if run else None
    if named:
        check_takes_light(named, lighting.asked, run)
    shining = lights.given(lighting)
    notes: list[str] = []
    points = clouds.read_cloud(cloud, num_points=num_points, up=up, clean=clean, cut=cut, report=notes.append)
    model = named or load("surfels" if lighting.asked else suited_to(len(points.positions)))
    scene = open_scene(model, points, uploads.display_name(cloud.name))
    first = State(scene=scene, size=session.sizes(model)[1], lights=shining)
    return Viewer(model, first, Reading(num_points=num_points, up=up, clean=clean), host, port), notes


def _check_free(host: str, port: int) -> None:
    """ValueError unless a server can listen there; viser itself would take another port, and wait for no host."""
    if not 0 <= port < 2**16:
        raise UserError(f"--port must be from 0 (any free one) to 65535, got {port}")
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, port), family=family).close()
    except socket.gaierror:
        raise UserError(
            f"--host {host}: no such address; 127.0.0.1 is this machine alone, 0.0.0.0 all networks"
        ) from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise UserError(_in_use(host, port)) from None
        raise UserError(f"--host {host} --port {port}: {error.strerror}") from None


def _in_use(host: str, port: int) -> str:
    return f"--port {port} is in use on {host}; choose another, or 0 for any free one"
