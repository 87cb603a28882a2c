"""The object of one browser as Gaussian splats, beside the picture: what an export of it will look like.

The browser draws them, between the panes that the server draws.  viser gives a splat one colour for all directions,
the mean of what an export has, and widens those smaller than a pixel without making them fainter.
"""

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from spnr_jax.errors import UserError
from spnr_jax.gaussians.drawing import rotations
from spnr_jax.gaussians.harmonics import C0
from spnr_jax.kernels.records import Gaussians
from spnr_jax.method.model import Model
from spnr_jax.tools.splat_making import drawn_views, fitting_cameras, splats_in_box
from spnr_jax.viewer.loop import Loop
from spnr_jax.viewer.session import State, prepared
from spnr_jax.viewer.viewpoint import numbers

VIEWS, RESOLUTION = 24, 384  # of the network's pictures: fewer and smaller than an export's, since a person waits
MOST, DEGREE = 60_000, 1
SECONDS, LONGEST = 10.0, 60.0
LARGER = 100.0  # times, before numbers of 16 bits hold the squares of the splats' widths
DRAWING = 0.5  # share of the progress when the pictures are drawn

Progress = Callable[[float], None]


class StoppedError(Exception):
    """The browser has gone while its splats were made."""


def make(model: Model, state: State, network: threading.Lock, seconds: Any, progress: Progress) -> Gaussians:
    """Splats, in the box, of a prepared state's object in its light; `network` is free between the pictures.

    `progress` gets the share that is done, and ends it all by an exception.
    """
    time = numbers([seconds], 1)
    if time is None or not 0 <= time[0] <= LONGEST:
        raise UserError(f"splats are refined for 0 to {LONGEST:g} seconds")
    volume, views = state.scene.volume, []
    for i, camera in enumerate(fitting_cameras(model, volume, VIEWS, RESOLUTION)):
        progress(DRAWING * i / VIEWS)
        with network:
            views += drawn_views(model, volume, [camera], state.lights.light)

    def refining(share: float | int) -> None:
        progress(DRAWING + (1 - DRAWING) * share)

    refining(0.0)
    return splats_in_box(views, volume, state.scene.cloud, DEGREE, MOST, float(time[0]), watch=refining)


def for_browser(splats: Gaussians) -> dict[str, Any]:
    """Arguments of viser's `add_gaussian_splats`."""
    axes = np.asarray(rotations(splats.rotation)) * (LARGER * np.asarray(splats.scale))[:, None, :]
    return {
        "centers": LARGER * np.asarray(splats.position, np.float32),
        "covariances": np.einsum("nij,nkj->nik", axes, axes),
        "rgbs": np.clip(0.5 + C0 * np.asarray(splats.harmonics)[:, 0], 0, 1),
        "opacities": np.asarray(splats.opacity)[:, None],
        "scale": 1 / LARGER,
    }


class SplatControls:
    """A button that makes splats, a box that shows them; `slowly` tells a person what is refused."""

    def __init__(
        self,
        client: viser.ClientHandle,
        model: Model,
        loop: Loop[State],
        network: threading.Lock,
        slowly: Callable[[Callable[[], None]], None],
    ) -> None:
        self._client, self._model, self._loop, self._network = client, model, loop, network
        self._handle: Any = None
        self._of: State | None = None
        gui = client.gui
        self._seconds = gui.add_slider("Refined, seconds", 0.0, LONGEST, 1.0, SECONDS)
        self._button = gui.add_button("Make splats")
        self._shown: Any = gui.add_checkbox("Show splats", False, disabled=True)
        self._said = gui.add_markdown("")

        @self._button.on_click
        def _(_: Any) -> None:
            slowly(self._make)

        @self._shown.on_update
        async def _(_: Any) -> None:
            self._show(self._handle is not None and bool(self._shown.value))

    def follow(self, state: State) -> None:
        """Says so when the splats are of the object as it was before a change."""
        of = self._of
        if of and (of.scene.cloud is not state.scene.cloud or of.lights.options != state.lights.options):
            self._of = None
            self._said.content = "The splats show the object as it was before the last change."

    def drop(self) -> None:
        """Takes the splats away: another object is shown."""
        if self._handle is not None:
            self._handle.remove()
        self._handle, self._of = None, None
        self._shown.value, self._shown.disabled, self._said.content = False, True, ""
        self._show(False)

    def _show(self, shown: bool) -> None:
        if self._handle is not None:
            self._handle.visible = shown
        self._loop.submit(lambda state: dataclasses.replace(state, splats=shown))

    def _progress(self, share: float) -> None:
        if self._loop.stopped:
            raise StoppedError
        if self._button.label != (now := f"{100 * share:.0f} %"):
            self._button.label = now

    def _make(self) -> None:
        label, self._button.disabled = self._button.label, True
        try:
            with self._network:
                state = prepared(self._model, self._loop.state)
            splats = make(self._model, state, self._network, self._seconds.value, self._progress)
        except StoppedError:
            return
        finally:
            self._button.disabled, self._button.label = False, label
        if self._loop.state.scene.original is not state.scene.original:
            return  # another file was opened meanwhile
        self._handle = self._client.scene.add_gaussian_splats("/splats", **for_browser(splats), visible=True)
        self._of = state
        self._said.content = f"{len(splats.opacity):,} splats"
        self._shown.disabled, self._shown.value = False, True
        self._show(True)
